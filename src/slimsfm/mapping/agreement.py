"""Whether features are those of a model: keypoint i of an image must be row i of its features.

Rows are compared one by one, never as a set. Where all rows differ by one smooth map of the image, the
features were computed on another version of it (distorted, resized, shifted), and the model's positions are
taken.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool

from slimsfm.arrays import Mask, Points2D
from slimsfm.errors import ModelError
from slimsfm.features import Features
from slimsfm.mapping.lens import PixelMap, fit_pixel_map
from slimsfm.mapping.model import camera_of, positions

_EXACT_PX = 0.05  # single floats round by 0.001, text files by 0.005
_ROUNDED_PX = 2.0  # whole pixels, rounded down, and an origin half a pixel away
_EXPLAINED = 0.2  # a map explains distances if it leaves less than this part of them
_FIT = 0.005  # largest error of a map over the longer side
_MARGIN = 0.1  # around an image, over its sides
_RESIZED = 0.02  # change of size that is worth a word
_MOST, _NEARLY_ALL = 90, 99  # percent of the rows
_MOST_NAMED = 20

Masks = Mapping[str, Bool[np.ndarray, " _"]]
"""Masks of keypoints, by image name."""


def listed(names: Collection[str]) -> str:
    """Names in quotes; of many, the first."""
    shown = ", ".join(repr(name) for name in sorted(names)[:_MOST_NAMED])
    more = len(names) - _MOST_NAMED
    return f"{shown} and {more} more" if more > 0 else shown


def counted(names: Collection[str], total: int = 0) -> str:
    """Number and names of images: "2 images ('a.png', 'b.png')", or "all 9 images" of 9."""
    if len(names) == total:
        return f"all {total} images"
    return f"{len(names)} image{'s' * (len(names) != 1)} ({listed(names)})"


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pixels:
    """The keypoints of an image in the features and in the model, row by row."""

    image: pycolmap.Image
    stored: Points2D
    modeled: Points2D
    usable: Mask
    """Rows whose positions are finite."""

    compared: Mask
    """Of these, rows in the image or near it: beyond, undistortion may move keypoints anywhere."""

    size_px: int

    @property
    def distances(self) -> np.ndarray:
        return np.linalg.norm(self.stored - self.modeled, axis=1)[self.compared]

    @property
    def differ(self) -> bool:
        return bool(len(self.distances) and np.percentile(self.distances, _NEARLY_ALL) > _EXACT_PX)

    def fit(self) -> PixelMap | None:
        return fit_pixel_map(self.stored[self.compared], self.modeled[self.compared])

    def is_explained_by(self, pixel_map: PixelMap | None) -> bool:
        if pixel_map is None:
            return False
        mapped, modeled = pixel_map(self.stored[self.compared]), self.modeled[self.compared]
        errors = np.linalg.norm(mapped - modeled, axis=1)
        return (
            bool(errors.mean() < _EXPLAINED * self.distances.mean()) and _most(errors) < _FIT * self.size_px
        )


def place_features(
    images: list[pycolmap.Image], features: Mapping[str, Features], unusable: Masks, source: Path
) -> tuple[dict[str, Features], list[str]]:
    """Check the positions of all features, and take those of the model where they differ smoothly.

    Args:
        images: The images of the model.
        features: Features by image name.
        unusable: By image name, keypoints of the model without a position.
        source: File or folder of the features, for messages.

    Returns:
        Features of finite values, and notes on what was changed.

    Raises:
        ModelError: Keypoints of an image are not those of the model. All such images are named.
    """
    _check_counts(images, features, source)
    pixels = [_pixels(image, features[image.name], unusable[image.name]) for image in images]
    maps = _maps(pixels)
    if wrong := {p.image.name: reason for p in pixels if (reason := _fault(p, maps.get(p.image.name)))}:
        raise disagreement(wrong, len(images), source)
    placed = {
        one.image.name: _cleaned(one, features[one.image.name], maps.get(one.image.name)) for one in pixels
    }
    return placed, _notes(pixels, maps, features, source)


def _check_counts(images: list[pycolmap.Image], features: Mapping[str, Features], source: Path) -> None:
    counts = {image.name: (image.num_points2D(), len(features[image.name])) for image in images}
    wrong = {
        name: f"has {count} keypoints in the model but {described} in the features"
        for name, (count, described) in counts.items()
        if count != described
    }
    if wrong:
        raise disagreement(wrong, len(images), source)


def disagreement(reasons: dict[str, str], num_images: int, source: Path) -> ModelError:
    """The error that names all images that do not fit a model, and the reason of the first."""
    name, reason = min(reasons.items())
    return ModelError(
        f"{source}: of other images or another run than {counted(reasons, num_images)} of the model: "
        f"image {name!r} {reason}; give what the model was made from"
    )


def _pixels(image: pycolmap.Image, features: Features, unusable: Mask) -> _Pixels:
    modeled, stored = positions(image), features.keypoints.astype(np.float64)
    usable = np.isfinite(stored).all(axis=1) & ~unusable
    camera = camera_of(image)
    size = np.array([camera.width, camera.height])
    near = ((modeled > -_MARGIN * size) & (modeled < (1 + _MARGIN) * size)).all(axis=1) & usable
    return _Pixels(
        image=image,
        stored=stored,
        modeled=modeled,
        usable=usable,
        compared=near if near.sum() >= usable.sum() / 4 else usable,
        size_px=max(camera.width, camera.height),
    )


def _maps(pixels: list[_Pixels]) -> dict[str, PixelMap]:
    """The smooth map of each image that has one; images of few keypoints share that of their camera."""
    found, of_camera = {}, {}
    differing = [one for one in pixels if one.differ]
    for one in sorted(differing, key=lambda one: -len(one.distances)):
        candidates = (one.fit(), of_camera.get(one.image.camera_id))
        pixel_map = next((candidate for candidate in candidates if one.is_explained_by(candidate)), None)
        if pixel_map is not None:
            found[one.image.name] = pixel_map
            of_camera.setdefault(one.image.camera_id, pixel_map)
    return found


def _most(values: np.ndarray) -> float:
    return float(np.percentile(values, _MOST)) if len(values) else 0.0


def _fault(pixels: _Pixels, pixel_map: PixelMap | None) -> str | None:
    """Why the keypoints of an image are not those of the model, or None."""
    if pixels.usable.sum() < len(pixels.usable) / 2:
        return "has no finite position of most of its keypoints"
    if pixel_map is not None:
        return None if pixel_map.is_upright else f"is turned by {pixel_map.turn_deg:.0f}° or mirrored"
    if _most(pixels.distances) <= _ROUNDED_PX:
        return None
    from scipy.spatial import KDTree  # slow to import, and only needed here

    nearest, _ = KDTree(pixels.stored[pixels.usable]).query(pixels.modeled[pixels.compared])
    if _most(np.asarray(nearest)) <= _ROUNDED_PX / 2:
        return "has the same keypoints in another order"
    return f"has its keypoints elsewhere ({np.median(pixels.distances):.0f} px away in the median)"


def _cleaned(pixels: _Pixels, features: Features, pixel_map: PixelMap | None) -> Features:
    """Features of finite values at the right positions; a row without a position matches nothing."""
    modeled = ~pixels.usable if pixel_map is None else np.ones_like(pixels.usable)
    keypoints = np.where(modeled[:, None], pixels.modeled, pixels.stored).astype(np.float32)
    descriptors, frames = features.descriptors, features.frames
    silent = _damaged(features) | ((pixels.modeled == 0).all(axis=1) & ~pixels.usable)
    if silent.any():
        descriptors = np.where(silent[:, None], np.zeros((), descriptors.dtype), descriptors)
    if frames is not None:
        scale = np.array([pixel_map.scale if pixel_map else 1.0, 1.0], np.float32)
        frames = np.nan_to_num(frames * scale, posinf=0.0, neginf=0.0)
    camera = camera_of(pixels.image)
    return Features(
        keypoints=keypoints,
        descriptors=descriptors,
        scores=np.nan_to_num(features.scores, posinf=0.0, neginf=0.0),
        image_size=(camera.width, camera.height),
        frames=frames,
    )


def _damaged(features: Features) -> Mask:
    """Rows whose descriptor is not finite."""
    if not np.issubdtype(features.descriptors.dtype, np.floating):
        return np.zeros(len(features), bool)
    return ~np.asarray(np.isfinite(features.descriptors).all(axis=1))


def _notes(
    pixels: list[_Pixels], maps: Mapping[str, PixelMap], features: Mapping[str, Features], source: Path
) -> list[str]:
    total = len(pixels)
    notes = [_note_on_maps(pixels, maps, source)] if maps else []
    rounded = {
        one.image.name: float(one.distances.max())
        for one in pixels
        if one.image.name not in maps and one.differ
    }
    if rounded:
        notes.append(
            f"{source.name}: the model has the keypoints of {counted(rounded, total)} up to "
            f"{max(rounded.values()):.2g} px elsewhere, as by rounding; those of the features are used"
        )
    damaged = {one.image.name: _num_damaged(one, features[one.image.name]) for one in pixels}
    damaged = {name: count for name, count in damaged.items() if count}
    if damaged:
        notes.append(
            f"{source.name}: {sum(damaged.values())} features of {counted(damaged, total)} are not finite; "
            "positions are taken from the model, and such descriptors match nothing"
        )
    return notes


def _note_on_maps(pixels: list[_Pixels], maps: Mapping[str, PixelMap], source: Path) -> str:
    most = max(float(one.distances.max()) for one in pixels if one.image.name in maps)
    scale = float(np.median([pixel_map.scale for pixel_map in maps.values()]))
    how = f"scaled by {scale:.3g}" if abs(scale - 1) > _RESIZED else "as by undistortion, a crop or a shift"
    return (
        f"{source.name}: the keypoints of {counted(maps, len(pixels))} lie up to {most:.3g} px elsewhere in "
        f"the model, {how}; its positions are used, and its cameras hold for photos that were changed alike"
    )


def _num_damaged(pixels: _Pixels, features: Features) -> int:
    return int(np.sum(_damaged(features) | ~np.isfinite(pixels.stored).all(axis=1)))
