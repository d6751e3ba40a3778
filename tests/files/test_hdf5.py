import os
import time
import zlib
from contextlib import suppress

import h5py
import numpy as np
import pytest

from mutations import mutations
from slimsfm.errors import InputError
from slimsfm.features.base import Features
from slimsfm.features.store import FeatureFile, FeatureWriter, MatchFile, write_matches
from slimsfm.files.hdf5 import datasets_of, opened, read_array
from slimsfm.limits import Limits, use_limits

COUNTS = {"a/1.jpg": 12, "a/2.jpg": 20, "3.jpg": 9}


@pytest.fixture
def folder(tmp_path):
    """Features of a few images, and their matches."""
    rng = np.random.default_rng(0)
    with FeatureWriter(tmp_path / "features.h5") as writer:
        for name, count in COUNTS.items():
            writer.write(name, features_of(count, rng))
    pairs = {
        (a, b): np.stack([np.arange(5), rng.permutation(9)[:5]], axis=1)
        for a in COUNTS
        for b in COUNTS
        if a < b
    }
    write_matches(tmp_path / "matches.h5", pairs, COUNTS)
    return tmp_path


def features_of(count, rng):
    return Features(
        keypoints=rng.uniform(0, 500, (count, 2)).astype(np.float32),
        descriptors=rng.integers(0, 255, (count, 32)).astype(np.uint8),
        scores=rng.uniform(0, 1, count).astype(np.float32),
        image_size=(640, 480),
        frames=rng.uniform(0, 3, (count, 2)).astype(np.float32),
    )


def read_features(path):
    found = FeatureFile(path, COUNTS)
    return [(found.count(name), found[name]) for name in found]


def read_matches(path):
    found = MatchFile(path, list(COUNTS), COUNTS)
    return [found[pair] for pair in found]


@pytest.mark.parametrize(("part", "read"), [("features", read_features), ("matches", read_matches)])
def test_a_damaged_file_is_read_within_bounds_or_refused_by_name(folder, part, read):
    path = folder / f"{part}.h5"
    whole = path.read_bytes()
    for name, damaged in mutations(whole, seed=1, count=150):
        path.write_bytes(damaged)
        start = time.perf_counter()
        with suppress(InputError):
            for one in read(path):
                check(one)
        assert time.perf_counter() - start < 5, name


def check(one):
    if isinstance(one, tuple):
        count, features = one
        assert len(features) == count
        assert np.isfinite(features.keypoints).all()
        assert np.isfinite(features.frames).all() if features.frames is not None else True
    else:
        assert (one >= 0).all()
        assert (one < max(COUNTS.values())).all()


def replaced(path, name, values):
    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = values


@pytest.mark.parametrize(
    ("part", "values"),
    [
        ("keypoints", np.full((12, 2), np.nan)),
        ("keypoints", np.full((12, 2), 1e300)),
        ("keypoints", np.zeros((12, 2), "S4")),
        ("scores", np.full(12, np.inf)),
        ("scores", np.zeros((12, 1))),
        ("scales", np.full(12, -np.inf)),
        ("oris", np.full(12, np.nan)),
        ("image_size", np.full(2, np.nan)),
        ("image_size", np.zeros(1)),
        ("descriptors", np.zeros((16, 12), np.uint8)),
        ("descriptors", np.zeros((32, 12), np.float32)),
        ("descriptors", np.full((32, 12), np.nan, np.float16)),
        ("descriptors", np.zeros((32, 11), np.uint8)),
    ],
)
def test_features_that_cannot_be_are_refused(folder, part, values):
    replaced(folder / "features.h5", f"a/1.jpg/{part}", values)
    with pytest.raises(InputError, match=r"features\.h5: .*'a/\d\.jpg' are damaged"):
        read_features(folder / "features.h5")


@pytest.mark.parametrize(
    "targets", [np.full(9, 12), np.zeros(10, int), np.zeros(9), np.zeros((9, 1), int), np.full(9, 2**62)]
)
def test_matches_beyond_the_keypoints_are_refused(folder, targets):
    replaced(folder / "matches.h5", "3.jpg/a-1.jpg/matches0", targets)
    with pytest.raises(InputError, match=r"matches\.h5: the matches of \('3\.jpg', 'a/1\.jpg'\) are damaged"):
        read_matches(folder / "matches.h5")


LINKS = h5py.SoftLink("/a/2.jpg/keypoints"), h5py.ExternalLink("other.h5", "/a/1.jpg/keypoints")


@pytest.mark.parametrize("link", LINKS, ids=["inside", "to another file"])
def test_links_are_not_followed(folder, link):
    (folder / "other.h5").write_bytes((folder / "features.h5").read_bytes())
    replaced(folder / "features.h5", "a/1.jpg/keypoints", link)
    with pytest.raises(InputError, match=r"features\.h5: damaged .*'a/1\.jpg/keypoints' is a link"):
        FeatureFile(folder / "features.h5")


def external(file, tmp_path):
    (tmp_path / "secret").write_bytes(bytes(800))
    file.create_dataset("x", (100,), np.float64, external=[(str(tmp_path / "secret"), 0, 800)])


def virtual(file, tmp_path):
    layout = h5py.VirtualLayout((100,), np.float64)
    layout[:] = h5py.VirtualSource(str(tmp_path / "secret.h5"), "x", (100,))
    file.create_virtual_dataset("x", layout)


def huge(file, _):
    file.create_dataset("x", (10**12,), np.uint8, chunks=(10**6,), compression="gzip")


def one_chunk_of_much(file, _):
    file.create_dataset("x", (2,), np.uint8, chunks=(2**31,), maxshape=(None,), compression="gzip")
    file["x"].id.write_direct_chunk((0,), zlib.compress(bytes(2)))


@pytest.mark.parametrize("make", [external, virtual, huge, one_chunk_of_much])
def test_an_array_that_the_file_does_not_hold_is_not_read(tmp_path, make):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        make(file, tmp_path)
    with pytest.raises(ValueError, match=r"in other files|more than .* bytes of the file can hold"):
        read_array(opened(tmp_path / "a.h5"), "x")


def test_a_chunk_that_unpacks_to_more_than_it_should_is_refused(tmp_path):
    bomb = zlib.compress(bytes(10**8), 1)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", (10**6,), np.uint8, chunks=(10**6,), compression="gzip")
        file["x"].id.write_direct_chunk((0,), bomb)
    with pytest.raises(ValueError, match="unpacks to more than its 1000000 bytes"):
        read_array(opened(tmp_path / "a.h5"), "x")


def test_arrays_beyond_the_limit_are_refused_with_its_name(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = np.zeros(10**5)
    with use_limits(Limits(max_file_gb=1e-4)), pytest.raises(InputError, match="SLIMSFM_MAX_FILE_GB"):
        read_array(opened(tmp_path / "a.h5"), "x")


def test_names_of_datasets_are_found_in_any_depth(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["keypoints/a/keypoints"] = file["b"] = [1]
    assert sorted(datasets_of(opened(tmp_path / "a.h5"))) == ["b", "keypoints/a/keypoints"]


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_file_is_refused_without_waiting(tmp_path, make):
    make(tmp_path / "a.h5")
    with pytest.raises(InputError, match=r"a\.h5: is not a file"):
        opened(tmp_path / "a.h5")
