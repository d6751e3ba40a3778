"""Workers that extract and match change no byte of a map, and neither do interruptions among them."""

import logging
import os
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from commands import contents
from scenes import camera
from slimsfm.errors import ImageError
from slimsfm.execution import dask_cluster, processes
from slimsfm.features import Features, runs_on_one_core
from slimsfm.features.nearest import Nearest
from slimsfm.features.store import FeatureFile, FeatureWriter
from slimsfm.mapping.blocks import Workers
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.io import write_map
from slimsfm.mapping.matching import PairMatching, match_and_verify
from slimsfm.mapping.pairs import exhaustive_pairs
from slimsfm.mapping.workspace import FEATURES, Workspace

NAMES = ["a", "b", "c", "d", "e", "f"]


def interrupting(label, after):
    """Progress that interrupts the work with this label after some items."""

    def watch(items, own_label):
        for number, item in enumerate(items):
            if own_label == label and number == after:
                raise KeyboardInterrupt
            yield item

    return watch


def bytes_of(map_, folder):
    write_map(map_, folder, overwrite=True)
    return contents(folder)


@pytest.fixture(scope="module")
def whole(unposed, tmp_path_factory):
    """The bytes of a map that one process built."""
    return bytes_of(unposed.map, tmp_path_factory.mktemp("whole") / "map")


@pytest.mark.parametrize("workers", [2, 3])
def test_processes_give_the_same_bytes(rendered, whole, tmp_path, workers):
    made = build_map(rendered.folder, open_executor=partial(processes, workers), min_seconds=0.0)
    assert bytes_of(made, tmp_path / "map") == whole


def test_a_dask_cluster_gives_the_same_bytes_after_interruptions(
    rendered, whole, tmp_path, scheduler, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # the workers have another working folder
    build = partial(
        build_map,
        os.path.relpath(rendered.folder),
        workspace="work",
        open_executor=partial(dask_cluster, scheduler, 2),
        min_seconds=0.0,
    )
    for label, after in (("extract features", 3), ("match pairs", 15)):
        with pytest.raises(KeyboardInterrupt):
            build(progress=interrupting(label, after))
    assert list((tmp_path / "work" / "matched").iterdir())
    assert bytes_of(build(), tmp_path / "map") == whole


def test_broken_photos_among_workers_are_skipped_in_order_of_name(rendered, whole, tmp_path, caplog):
    folder = shutil.copytree(rendered.folder, tmp_path / "images")
    broken = ["a.png", "take 1/frame 3.jpg", "z.png"]
    for name in broken:
        (folder / name).write_bytes(b"not an image")
    with caplog.at_level(logging.WARNING):
        made = build_map(folder, open_executor=partial(processes, 2), min_seconds=0.0)
    assert [message.split(": ")[0] for message in caplog.messages] == broken
    assert [note.split(" (")[0] for note in made.info.notes] == [f"3 photos skipped: {', '.join(broken)}"]
    assert bytes_of(replace(made, info=replace(made.info, notes=())), tmp_path / "map") == whole
    strict = BuildOptions(strict=True)
    with pytest.raises(ImageError, match=r"images/a\.png: not a readable image"):
        build_map(folder, strict, open_executor=partial(processes, 2), min_seconds=0.0)


def test_short_work_starts_no_process(rendered, whole, tmp_path):
    def never():
        raise AssertionError("started a process")

    made = build_map(rendered.folder, open_executor=never, min_seconds=1000.0)
    assert bytes_of(made, tmp_path / "map") == whole


class InThisProcess:
    """A matcher that cannot travel to another process, as networks on a GPU cannot."""

    def match(self, features1, features2):
        return Nearest().match(features1, features2)

    def __reduce__(self):
        raise AssertionError("sent to another process")


def matching_of(images, **changes):
    given = {
        "features": images / FEATURES,
        "turns": {},
        "factors": dict.fromkeys(NAMES, 1.0),
        "cameras": dict.fromkeys(NAMES, camera()),
        "matcher": Nearest(),
        "one_thread": True,
        "seed": 0,
    }
    return PairMatching(**{**given, **changes})


@pytest.fixture
def images(tmp_path):
    """Images that show the same points from the same place, each with some points of its own."""
    rng = np.random.default_rng(0)
    common, descriptors = rng.uniform(50, 400, (80, 2)), rng.uniform(0, 255, (80, 128))
    tmp_path.joinpath("work").mkdir()
    Workspace(tmp_path / "work", {})
    with FeatureWriter(tmp_path / "work" / FEATURES) as writer:
        for name in NAMES:
            own, others = rng.uniform(50, 400, (40, 2)), rng.uniform(0, 255, (40, 128))
            writer.write(
                name,
                Features(
                    keypoints=np.concatenate([common + rng.normal(0, 0.3, common.shape), own]).astype(
                        np.float32
                    ),
                    descriptors=np.concatenate([descriptors, others]).astype(np.uint8),
                    scores=np.ones(120, np.float32),
                    image_size=(640, 480),
                ),
            )
    return tmp_path / "work"


@pytest.mark.parametrize("one_thread", [True, False])
def test_matches_are_verified_wherever_the_matcher_runs(images, one_thread):
    matcher = Nearest() if one_thread else InThisProcess()
    matching = matching_of(images, matcher=matcher, one_thread=one_thread)
    workers = Workers(open_executor=partial(processes, 2), min_seconds=0.0)
    found = match_and_verify(matching, exhaustive_pairs(NAMES), Workspace(images, {}), workers)
    assert list(found) == exhaustive_pairs(NAMES)
    for geometry in found.values():
        assert len(geometry.inlier_matches) >= 75
        assert np.array_equal(*geometry.inlier_matches.T)
    again = match_and_verify(matching, exhaustive_pairs(NAMES), Workspace(images, {}))
    for pair, geometry in found.items():
        assert again[pair].config == geometry.config
        assert np.array_equal(again[pair].inlier_matches, geometry.inlier_matches)


def test_unsure_pairs_are_left_out_unless_their_largest_features_match(images):
    read = FeatureFile(images / FEATURES)
    everything = exhaustive_pairs(NAMES)
    with FeatureWriter(images / "others.h5") as writer:
        for number, name in enumerate(NAMES):
            found = read[name]  # in the last three images, what they have in common is small
            sizes = np.where(np.arange(120) < 80, 1.0 if number < 3 else 0.1, 0.5)
            frames = np.stack([sizes, np.zeros(120)], axis=1).astype(np.float32)
            writer.write(name, repeated(replace(found, frames=frames), 40 if number < 3 else 400))
    matching = matching_of(images, features=images / "others.h5")
    sure = frozenset({("a", "f")})
    found = match_and_verify(matching, everything, Workspace(images, {}), unsure=frozenset(everything) - sure)
    assert list(found) == [("a", "b"), ("a", "c"), ("a", "f"), ("b", "c")]


def repeated(features, count):
    """Features with other ones of their own size, which match nothing."""
    rng = np.random.default_rng(int(features.keypoints.sum()))
    others = Features(
        keypoints=rng.uniform(50, 400, (count, 2)).astype(np.float32),
        descriptors=rng.uniform(0, 255, (count, 128)).astype(np.uint8),
        scores=np.ones(count, np.float32),
        image_size=features.image_size,
        frames=np.full((count, 2), 0.5, np.float32),
    )
    parts = ("keypoints", "descriptors", "scores", "frames")
    joined = {part: np.concatenate([getattr(features, part), getattr(others, part)]) for part in parts}
    return replace(features, **joined)


def test_networks_stay_in_one_process():
    assert runs_on_one_core("sift")
    assert runs_on_one_core("nearest")
    assert not any(map(runs_on_one_core, ("aliked", "lightglue", "loftr")))
