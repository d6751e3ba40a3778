"""Cameras, local features and colors of a folder of photos."""

from collections import Counter
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import UInt8

from slimsfm.errors import ImageError, InputError
from slimsfm.exif import Exif
from slimsfm.features import Extractor, Features, image_colors, runs_on_one_core
from slimsfm.features.store import FeatureFile, FeatureWriter
from slimsfm.mapping.blocks import Workers
from slimsfm.mapping.masked_photos import MaskedPhotos
from slimsfm.mapping.workspace import FEATURES, Arrays, Workspace, load_arrays, resumed, save_arrays
from slimsfm.photos import Orientation
from slimsfm.progress import ProgressBar, silent
from slimsfm.skipping import SkippedPhotos

CameraSharing = Literal["auto", "shared", "per-image"]

Colors = Mapping[str, UInt8[np.ndarray, "n 3"]]
"""RGB at each keypoint, by image name."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GuessedCameras:
    """Cameras of images, guessed from EXIF."""

    by_name: Mapping[str, pycolmap.Camera]
    """The camera of each image in its own pixels; images with equal `camera_id` share a camera."""

    turned: Mapping[str, pycolmap.Camera] = field(default_factory=dict)
    """Images taken with the camera of others, held turned by 90°: the camera of the others."""


def guess_cameras(
    exifs: Mapping[str, Exif], sharing: CameraSharing, orientation: Orientation = "upright"
) -> GuessedCameras:
    """Guess the camera of each image from its EXIF data, by name.

    With "auto", images of equal size, focal length and device share a camera; with "shared" all do, with
    "per-image" none. Pictures of swapped width and height are of one camera, held upright and sideways.

    Raises:
        InputError: Images of different sizes share a camera.
    """
    guesses = {name: exif.camera(orientation) for name, exif in exifs.items()}
    if sharing == "shared":
        _check_equal_sizes(guesses)
    groups: dict[tuple, list[str]] = {}
    for name, camera in guesses.items():
        groups.setdefault(_key(name, exifs[name], camera, sharing), []).append(name)
    by_name, turned = {}, {}
    for names in groups.values():
        first: dict[int, pycolmap.Camera] = {}  # by width
        for name in names:
            guesses[name].camera_id = 1 + len({camera.camera_id for camera in by_name.values()})
            by_name[name] = first.setdefault(guesses[name].width, guesses[name])
        widths = Counter(by_name[name].width for name in names)
        usual = max(widths, key=lambda width: (widths[width], width))
        turned |= {name: first[usual] for name in names if by_name[name].width != usual}
    return GuessedCameras(by_name={name: by_name[name] for name in exifs}, turned=turned)


def _key(name: str, exif: Exif, camera: pycolmap.Camera, sharing: CameraSharing) -> tuple:
    if sharing == "shared":
        return ()
    if sharing == "per-image":
        return (name,)
    return (*sorted(exif.stored_size), round(camera.focal_length, 2), exif.device)


def _check_equal_sizes(guesses: Mapping[str, pycolmap.Camera]) -> None:
    sizes = {tuple(sorted((camera.width, camera.height))): name for name, camera in guesses.items()}
    if len(sizes) > 1:
        a, b = (guesses[name] for name in list(sizes.values())[:2])
        name_a, name_b = list(sizes.values())[:2]
        raise InputError(
            f"{name_a} has {a.width}x{a.height} pixels, {name_b} {b.width}x{b.height}; "
            "images that share a camera must have the same size, so use `camera='auto'`"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Extracted:
    """What was extracted from the photos that could be read."""

    features: FeatureFile
    """Features by image name."""

    colors: Colors
    """Color of each feature."""


def extract_features(
    photos: MaskedPhotos,
    names: list[str],
    extractor: Extractor,
    workspace: Workspace,
    skipped: SkippedPhotos,
    workers: Workers = Workers(),
    progress: ProgressBar = silent,
) -> Extracted:
    """Extract the features of the photos that can be read, except of those that an interrupted build had.

    Raises:
        ImageError: No photo can be read or, if `skipped` is strict, one or its mask cannot.
    """
    left = [name for name in names if not _recall(photos, name, workspace)]
    workers = workers if runs_on_one_core(extractor.name) else Workers()
    with closing(workers.in_order(partial(_extract, photos.absolute(), extractor), left)) as found:
        for name in progress(left, resumed("extract features", len(names) - len(left))):
            with skipped.skipping(name):
                if isinstance(arrays := next(found), str):
                    raise photos.error(name, arrays)
                save_arrays(workspace.extracted(name), arrays)
                _recall(photos, name, workspace)
    colors, output = {}, workspace.folder / FEATURES
    with FeatureWriter(output) as writer:
        for name in skipped.left(names):
            saved = load_arrays(workspace.extracted(name)) or {}
            colors[name] = saved["colors"]
            writer.write(name, _features(saved))
    return Extracted(features=FeatureFile(output), colors=colors)


def _extract(photos: MaskedPhotos, extractor: Extractor, name: str) -> Arrays | str:
    """The features of a photo, or why it cannot be read: a task that raises an error would be tried again."""
    try:
        photo = photos.read(name)
    except ImageError as error:
        return photos.reason(name, error)
    found = extractor.extract(photo.image, photo.mask)
    arrays = {
        "keypoints": found.keypoints,
        "descriptors": found.descriptors,
        "scores": found.scores,
        "image_size": np.array(found.image_size),
        "colors": image_colors(photo.image, found.keypoints),
        "said": np.array(list(photos.said(name).items()), str).reshape(-1, 2),
    }
    if found.frames is not None:
        arrays["frames"] = found.frames
    return arrays


def _recall(photos: MaskedPhotos, name: str, workspace: Workspace) -> bool:
    """Whether an interrupted build has the features of a photo; then also takes over what it said."""
    saved = load_arrays(workspace.extracted(name))
    if saved is None:
        return False
    photos.recall(name, dict(saved["said"].tolist()))
    return True


def _features(saved: Mapping[str, np.ndarray]) -> Features:
    width, height = saved["image_size"].tolist()
    return Features(
        keypoints=saved["keypoints"],
        descriptors=saved["descriptors"],
        scores=saved["scores"],
        image_size=(width, height),
        frames=saved.get("frames"),
    )


def check_readable(photos: MaskedPhotos, names: list[str], skipped: SkippedPhotos) -> None:
    """Skip the photos that cannot be read, for extractors that read them several times.

    Raises:
        ImageError: As in `extract_features`.
    """
    for name in names:
        with skipped.skipping(name):
            photos.read(name)
    skipped.left(names)


def color_points(model: pycolmap.Reconstruction, colors: Colors) -> None:
    """Set the color of each point to the mean color of its observations."""
    names = {image_id: image.name for image_id, image in model.images.items()}
    for point in model.points3D.values():
        seen = [colors[names[element.image_id]][element.point2D_idx] for element in point.track.elements]
        point.color = np.mean(seen, axis=0).round().astype(np.uint8)
