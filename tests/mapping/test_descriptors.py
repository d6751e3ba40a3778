"""Descriptors of points on disk."""

import lzma
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes import without_checksums
from slimsfm.errors import InputError, MapError
from slimsfm.features import unit_rows
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.descriptors import quantize, read_point_descriptors, write_point_descriptors
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import PointDescriptors
from slimsfm.mapping.subset import direct_map

SHAPES = {"count": st.integers(1, 12), "dimensions": st.integers(1, 33), "seed": st.integers(0, 10**6)}


def random_descriptors(count, dimensions, seed, *, signed=True):
    values = np.random.default_rng(seed).normal(size=(count, dimensions))
    return unit_rows((values if signed else abs(values)).astype(np.float32))


def values_of(quantized):
    """The values of the codes, decoded by hand."""
    found = np.empty((len(quantized.codes), 2 * quantized.codes.shape[1]))
    found[:, ::2], found[:, 1::2] = np.divmod(quantized.codes, 16)
    step = (quantized.high - quantized.low) / 15
    return quantized.low + step * found[:, : quantized.dimensions]


@given(signed=st.booleans(), **SHAPES)
def test_each_value_is_off_by_half_a_step_at_most(count, dimensions, seed, signed):
    descriptors = random_descriptors(count, dimensions, seed, signed=signed)
    quantized = quantize(descriptors)
    assert (quantized.low, quantized.high) == (descriptors.min(), descriptors.max())
    assert quantized.codes.shape == (count, (dimensions + 1) // 2)
    half_a_step = (quantized.high - quantized.low) / 30
    assert abs(values_of(quantized) - descriptors).max() <= half_a_step + 1e-6


@given(**SHAPES)
def test_restored_descriptors_have_unit_length(count, dimensions, seed):
    quantized = quantize(random_descriptors(count, dimensions, seed))
    restored = quantized.restore()
    assert restored.shape == (count, dimensions)
    assert restored.dtype == np.float32
    values = values_of(quantized)
    known = np.linalg.norm(values, axis=1) > 1e-3
    assert np.linalg.norm(restored[known], axis=1) == pytest.approx(np.ones(known.sum()), abs=1e-5)
    assert restored[known] == pytest.approx(unit_rows(values[known].astype(np.float32)), abs=1e-3)


@pytest.mark.parametrize("value", [-0.25, 0.25])
@pytest.mark.parametrize("dimensions", [15, 16])
def test_constant_descriptors_stay_constant(value, dimensions):
    restored = quantize(np.full((3, dimensions), value, np.float32)).restore()
    assert restored == pytest.approx(np.full((3, dimensions), np.sign(value) / np.sqrt(dimensions)))


@settings(max_examples=25, deadline=None)
@given(chosen=st.sets(st.integers(0, 70_000), min_size=1, max_size=12), **SHAPES)
def test_points_are_read_as_they_were_written(tmp_path_factory, chosen, count, dimensions, seed):
    del count
    points = np.array(sorted(chosen), np.int64)
    descriptors = random_descriptors(len(points), dimensions, seed)
    path = tmp_path_factory.mktemp("points") / "points.npz"
    write_point_descriptors(path, PointDescriptors(points=points, descriptors=descriptors))
    read = read_point_descriptors(path, 70_001)
    assert np.array_equal(read.points, points)
    assert np.array_equal(read.descriptors, quantize(descriptors).restore())


@settings(max_examples=25, deadline=None)
@given(counts=st.lists(st.integers(1, 4), min_size=1, max_size=12), seed=st.integers(0, 10**6))
def test_points_are_read_with_all_of_their_appearances(tmp_path_factory, counts, seed):
    rng = np.random.default_rng(seed)
    points = np.repeat(3 * np.arange(len(counts)) + 1, counts)
    count, each = len(points), (points - 1) // 3
    before = PointDescriptors(
        points=points,
        descriptors=random_descriptors(count, 8, seed),
        directions=rng.uniform(-1, 1, (len(counts), 3)).astype(np.float32)[each],
        distinct=(rng.random(len(counts)) < 0.5)[each],
        sizes=np.exp2(rng.integers(-9, 9, len(counts)).astype(np.float32))[each],
    )
    path = tmp_path_factory.mktemp("points") / "points.npz"
    write_point_descriptors(path, before)
    read = read_point_descriptors(path, 40)
    assert np.array_equal(read.points, points)
    assert np.array_equal(read.descriptors, quantize(before.descriptors).restore())
    assert read.directions == pytest.approx(before.directions, abs=0.5 / 127 + 1e-6)
    assert np.array_equal(read.distinct, before.distinct)
    assert np.array_equal(read.sizes, before.sizes)
    with np.load(path) as file:
        assert len(file["directions"]) == len(counts)
        assert ("appearances" in file) == (max(counts) > 1)


@pytest.fixture
def written(tmp_path):
    points = np.arange(0, 80, 2)
    path = tmp_path / "points.npz"
    found = PointDescriptors(points=points, descriptors=random_descriptors(40, 32, 0))
    write_point_descriptors(path, found)
    return path


def test_equal_points_give_equal_bytes(written, tmp_path):
    again = tmp_path / "again.npz"
    found = PointDescriptors(points=np.arange(0, 80, 2), descriptors=random_descriptors(40, 32, 0))
    write_point_descriptors(again, found)
    assert again.read_bytes() == written.read_bytes()


def test_a_file_cut_short_anywhere_is_refused(written):
    whole = written.read_bytes()
    for end in range(0, len(whole), 37):
        written.write_bytes(whole[:end])
        with pytest.raises(InputError, match=r"points.npz: damaged .*reduce the full map again"):
            read_point_descriptors(written, 80)


def test_a_file_with_a_bad_byte_is_read_correctly_or_refused(written):
    whole, before = written.read_bytes(), read_point_descriptors(written, 80)
    rng = np.random.default_rng(0)
    for place in range(0, len(whole), 3):
        bad = bytearray(whole)
        bad[place] ^= int(rng.integers(1, 256))
        written.write_bytes(bad)
        with suppress(InputError):
            read = read_point_descriptors(written, 80)
            assert np.array_equal(read.points, before.points)
            assert np.array_equal(read.descriptors, before.descriptors)


@pytest.mark.parametrize("num_points", [0, 1, 78])
def test_a_file_of_another_model_is_refused(written, num_points):
    with pytest.raises(InputError, match=r"points.npz: damaged .*(hold more than|do not belong to)"):
        read_point_descriptors(written, num_points)
    assert len(read_point_descriptors(written, 79).points) == 40


def _without(part):
    return lambda parts: parts.pop(part)


def _with(part, value):
    return lambda parts: parts.update({part: value})


@pytest.mark.parametrize(
    "harm",
    [
        *(_without(part) for part in ("points", "codes", "range", "dimensions")),
        _with("dimensions", np.array(31 * 3)),
        _with("dimensions", np.array(0)),
        _with("range", np.zeros(3)),
        _with("range", np.array(["a", "b"])),
        _with("codes", np.zeros(9, np.uint8)),
        _with("appearances", np.frombuffer(lzma.compress(bytes([1] * 39)), np.uint8)),
        _with("appearances", np.frombuffer(lzma.compress(bytes([1] * 39 + [0])), np.uint8)),
        _with("appearances", np.frombuffer(lzma.compress(bytes([1] * 39 + [2])), np.uint8)),
        _with("appearances", np.zeros(9, np.uint8)),
    ],
)
def test_inconsistent_parts_are_refused(written, harm):
    with np.load(written) as file:
        parts = dict(file)
    harm(parts)
    np.savez(written, **parts)
    with pytest.raises(InputError, match=r"points.npz: damaged"):
        read_point_descriptors(written, 80)


@pytest.mark.parametrize("kind", ["text", "nothing", "folder", "array", "cut short"])
def test_a_map_with_damaged_points_names_their_file(exact, tmp_path, kind):
    points = np.arange(0, len(exact.point3D_ids), 2)
    described = PointDescriptors(points=points, descriptors=describe_points(exact).descriptors[points])
    write_map(direct_map(exact, described), tmp_path / "map")
    path = tmp_path / "map" / "points.npz"
    whole = path.read_bytes()
    path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "array":
        with path.open("wb") as file:
            np.save(file, points)
    else:
        path.write_bytes({"text": b"no points here", "nothing": b""}.get(kind, whole[: len(whole) // 2]))
    with pytest.raises(MapError, match=r"points.npz: (damaged|missing).*copy it again"):
        read_map(tmp_path / "map")
    without_checksums(tmp_path / "map")
    with pytest.raises(MapError, match=r"points.npz: damaged .*reduce the full map again") as refusal:
        read_map(tmp_path / "map")
    assert str(path) in str(refusal.value)
