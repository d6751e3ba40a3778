"""Descriptors of points and of whole images, and their compact files: four bits per dimension.

On photos, four bits per dimension lose neither accuracy nor localized queries. Product quantization needs a
table, which is larger than the descriptors of a few hundred points.
"""

import lzma
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from slimsfm.arrays import Descriptors, Mask
from slimsfm.errors import MapError
from slimsfm.features import unit_rows
from slimsfm.features.nearest import learn_words, vlad
from slimsfm.files import contents_of, read_npz, unpacked
from slimsfm.limits import check_bytes
from slimsfm.mapping.map import GlobalDescriptors, Map, PointDescriptors

_LEVELS = 15
_SAMPLE = 500  # descriptors per image that the vocabulary is learned from
_LOG2_LIMITS = -100, 100  # of a size, so that its square is a number too
_INT8_MAX = np.iinfo(np.int8).max
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 9, "lc": 0, "lp": 0, "pb": 0}]  # half bytes lack context


@dataclass(frozen=True, kw_only=True, eq=False)
class Quantized:
    """Descriptors with values rounded to 16 equidistant levels."""

    codes: UInt8[np.ndarray, "n bytes"]
    """Two values per byte, the first in the upper half; the last half byte may be padding."""

    dimensions: int
    """Number of values per descriptor."""

    low: float
    """Value of code 0."""

    high: float
    """Value of code 15."""

    def restore(self) -> Descriptors:
        """Restore the descriptors, rounded and of unit length."""
        halves = np.stack([self.codes >> 4, self.codes & _LEVELS], axis=2).reshape(len(self.codes), -1)
        values = halves[:, : self.dimensions].astype(np.float32)
        return unit_rows(self.low + (self.high - self.low) / _LEVELS * values)


def quantize(descriptors: Descriptors) -> Quantized:
    """Round descriptors to four bits per dimension; at least one descriptor is required."""
    low, high = float(descriptors.min()), float(descriptors.max())
    steps = (descriptors - low) * (_LEVELS / max(high - low, 1e-12))
    codes = np.round(steps).astype(np.uint8)
    if codes.shape[1] % 2:
        codes = np.pad(codes, ((0, 0), (0, 1)))
    packed = codes[:, ::2] << 4 | codes[:, 1::2]
    return Quantized(codes=packed, dimensions=descriptors.shape[1], low=low, high=high)


def pack(rows: Descriptors) -> dict[str, np.ndarray]:
    """Quantize and compress rows of unit length to arrays for a file; at least one row is required."""
    quantized = quantize(rows)
    packed = lzma.compress(quantized.codes.tobytes(), filters=_FILTERS)
    return {
        "codes": np.frombuffer(packed, np.uint8),
        "range": np.array([quantized.low, quantized.high]),
        "dimensions": np.array(quantized.dimensions, np.uint32),
    }


def unpack(arrays: Mapping[str, np.ndarray], count: int) -> Descriptors:
    """Restore `count` rows from the arrays of `pack`.

    Raises:
        ValueError: The arrays hold another number of rows. Damaged arrays raise other errors as well.
        InputError: The rows are larger than the limit.
    """
    (low, high), dimensions = arrays["range"].tolist(), int(arrays["dimensions"])
    if not (dimensions > 0 and np.isfinite(low) and np.isfinite(high)):
        raise ValueError(f"{dimensions} values from {low} to {high} are no descriptors")
    width = (dimensions + 1) // 2
    check_bytes(f"{count} descriptors of {dimensions} values", count * dimensions * np.float32().nbytes)
    codes = np.frombuffer(unpacked(arrays["codes"].tobytes(), count * width), np.uint8)
    return Quantized(codes=codes.reshape(count, width), dimensions=dimensions, low=low, high=high).restore()


def write_point_descriptors(path: Path, points: PointDescriptors) -> None:
    """Write descriptors of points, quantized and compressed; what a point has once is written once."""
    firsts = points.firsts
    steps = np.diff(points.points[firsts], prepend=-1).astype(np.uint32)  # mostly 1, which compresses well
    arrays: dict[str, Any] = pack(points.descriptors)
    arrays["points"] = np.frombuffer(lzma.compress(steps.tobytes()), np.uint8)
    if len(firsts) < len(points.points):
        counts = np.diff(firsts, append=len(points.points)).astype(np.uint8)
        arrays["appearances"] = np.frombuffer(lzma.compress(counts.tobytes()), np.uint8)
    if points.directions is not None:
        arrays["directions"] = np.round(_INT8_MAX * points.directions[firsts]).astype(np.int8)
    if points.distinct is not None:
        arrays["distinct"] = np.packbits(points.distinct[firsts])
    if points.sizes is not None:
        arrays["log2_sizes"] = np.clip(np.log2(points.sizes[firsts]), *_LOG2_LIMITS).astype(np.float16)
    with path.open("wb") as file:
        np.savez(file, **arrays)


def read_point_descriptors(path: Path, num_points: int) -> PointDescriptors:
    """Read descriptors of points of a model with `num_points` points.

    Raises:
        InputError: The file is damaged, or belongs to another model.
    """
    with contents_of(path, "damaged", "reduce the full map again"):
        arrays = read_npz(path)
        most = num_points * np.uint32().nbytes
        steps = np.frombuffer(unpacked(arrays["points"].tobytes(), most), np.uint32)
        points = np.cumsum(steps, dtype=np.int64) - 1
        if not len(points) or points[-1] >= num_points or not steps.all():
            raise ValueError(f"its rows do not belong to {num_points} points")
        counts, count = _unpack_counts(arrays, len(points)), len(points)
        each = PointDescriptors(
            points=points,
            descriptors=np.zeros((count, 0), np.float32),
            directions=_unpack_directions(arrays, count) if "directions" in arrays else None,
            distinct=_unpack_bits(arrays["distinct"], count) if "distinct" in arrays else None,
            sizes=_unpack_sizes(arrays["log2_sizes"], count) if "log2_sizes" in arrays else None,
        )
        rows = np.repeat(np.arange(count), counts)
        return replace(each[rows], descriptors=unpack(arrays, len(rows)))


def _unpack_counts(arrays: Mapping[str, np.ndarray], count: int) -> UInt8[np.ndarray, " n"]:
    """Number of descriptors of each point; one where the file does not say."""
    if "appearances" not in arrays:
        return np.ones(count, np.uint8)
    counts = np.frombuffer(unpacked(arrays["appearances"].tobytes(), count), np.uint8)
    if len(counts) != count or not counts.all():
        raise ValueError(f"it does not have descriptors of each of {count} points")
    return counts


def _unpack_directions(arrays: Mapping[str, np.ndarray], count: int) -> Float32[np.ndarray, "n 3"]:
    stored = arrays["directions"]
    if stored.shape != (count, 3) or stored.dtype != np.int8:
        raise ValueError(f"directions of shape {stored.shape} and type {stored.dtype} for {count} points")
    return stored.astype(np.float32) / _INT8_MAX


def _unpack_sizes(stored: np.ndarray, count: int) -> Float32[np.ndarray, " n"]:
    if stored.shape != (count,) or stored.dtype != np.float16:
        raise ValueError(f"sizes of shape {stored.shape} and type {stored.dtype} for {count} points")
    if not np.isfinite(stored).all():
        raise ValueError("sizes that are not finite")
    return np.exp2(np.clip(stored.astype(np.float32), *_LOG2_LIMITS))


def _unpack_bits(packed: UInt8[np.ndarray, " bytes"], count: int) -> Mask:
    if packed.dtype != np.uint8 or packed.shape != ((count + 7) // 8,):
        raise ValueError(
            f"an array of shape {packed.shape} does not hold one bit per point for {count} points"
        )
    return np.unpackbits(packed, count=count).astype(bool)


def descriptor_length(map: Map) -> int | None:
    """Number of values of the map's descriptors; None if images are matched as a whole.

    Raises:
        MapError: The descriptors of its points, images and vocabulary differ in length.
    """
    if not map.has_keypoints:
        return None
    of_images = (one.shape[1] for name in map.features if len(one := map.features[name].descriptors))
    lengths = [next(of_images, None)]
    if map.point_descriptors is not None:
        lengths.append(map.point_descriptors.descriptors.shape[1])
    if map.global_descriptors is not None:
        lengths.append(map.global_descriptors.vocabulary.shape[1])
    known = sorted({length for length in lengths if length is not None})
    if len(known) > 1:
        counts = " and of ".join(str(one) for one in known)
        raise MapError(f"the map has descriptors of {counts} values; build or import it again")
    return known[0] if known else None


def with_global_descriptors(map: Map) -> Map:
    """Add a global descriptor per reference image to a map."""
    return replace(map, global_descriptors=describe_images(map))


def describe_images(map: Map, seed: int = 0) -> GlobalDescriptors:
    """Compute a global descriptor (VLAD) per reference image.

    The vocabulary is learned from the map's own descriptors. Only keypoints that observe a point count, so
    that background outside the map does not make images similar. O(observations).
    """
    words = learn_words(np.concatenate([_seen(map, name)[:_SAMPLE] for name in map.images]), seed)
    rows = np.stack([vlad(_seen(map, name), words) for name in map.images])
    return GlobalDescriptors(vocabulary=words, descriptors=rows)


def describe_new_images(map: Map, larger: Map) -> GlobalDescriptors | None:
    """Global descriptors of a map that was extended: old ones stay, new images are described by its words.

    Args:
        map: The map before.
        larger: The map with new images.

    Returns:
        One row per image of the larger map; None if the map has no global descriptors.
    """
    if map.global_descriptors is None:
        return None
    words = map.global_descriptors.vocabulary
    old = dict(zip(map.images, map.global_descriptors.descriptors, strict=True))
    rows = [old[name] if name in old else vlad(_seen(larger, name), words) for name in larger.images]
    return GlobalDescriptors(vocabulary=words, descriptors=np.stack(rows))


def _seen(map: Map, name: str) -> Descriptors:
    return unit_rows(map.features[name].descriptors[map.observations[name].rows])


def write_global_descriptors(path: Path, global_descriptors: GlobalDescriptors) -> None:
    """Write global descriptors, quantized and compressed like those of points."""
    with path.open("wb") as file:
        arrays: dict[str, Any] = {
            "words": global_descriptors.vocabulary,
            **pack(global_descriptors.descriptors),
        }
        np.savez(file, **arrays)


def read_global_descriptors(path: Path, num_images: int) -> GlobalDescriptors:
    """Read global descriptors of `num_images` images.

    Raises:
        InputError: The file is damaged, or belongs to another map.
    """
    with contents_of(path, "damaged", "build or import the map again"):
        arrays = read_npz(path)
        words, rows = arrays["words"].astype(np.float32), unpack(arrays, num_images)
        if words.ndim != 2 or not words.size or rows.shape[1] != words.size or not np.isfinite(words).all():
            raise ValueError(f"rows of {rows.shape[1]} values do not match words of shape {words.shape}")
        return GlobalDescriptors(vocabulary=words, descriptors=rows)
