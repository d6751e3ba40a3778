"""Read COLMAP models and check them; read or estimate the box of the object.

pycolmap trusts the counts in a binary file: a truncated file makes it run out of memory or abort the process.
So each binary file is first walked record by record, as COLMAP's "Output Format" describes. Damage that
pycolmap does not notice is searched for in the model that it returns.
"""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Ids, Points3D
from slimsfm.errors import InputError, ModelError
from slimsfm.geometry import Box

_CAMERA, _POSE, _POINT2D = 24, 56, 24  # bytes: id, model, width, height; quaternion and translation; x, y, id
_TRACK_ELEMENT, _SENSOR, _DATA = 8, 8, 16
_MOST_PIXELS = 1_000_000  # along a side


def read_model(path: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model, binary or text, with or without rigs and frames.

    Raises:
        ModelError: The folder holds no model, or the model is damaged.
    """
    suffix = next((s for s in (".bin", ".txt") if (path / f"cameras{s}").is_file()), None)
    if suffix is None:
        raise ModelError(f"{path}: no COLMAP model here (no cameras.bin or cameras.txt)")
    for part in ("images", "points3D"):
        if not (path / f"{part}{suffix}").is_file():
            raise ModelError(
                f"{path / part}{suffix}: missing; a COLMAP model has cameras, images and points3D"
            )
    if suffix == ".bin":
        for part, walk in _WALKS.items():
            _check_binary(path / f"{part}.bin", walk)
    try:
        model = pycolmap.Reconstruction()
        (model.read_binary if suffix == ".bin" else model.read_text)(path)
        if suffix == ".txt":
            _name_images(model, path / "images.txt")
        fault = _fault(model)
    except (RuntimeError, ValueError, IndexError) as error:
        raise ModelError(f"{path}: pycolmap cannot read this model: {_first_line(error)}") from error
    if fault:
        raise ModelError(f"{path}: {fault}; export the model again")
    return model


def _name_images(model: pycolmap.Reconstruction, file: Path) -> None:
    """Set the full names of images; pycolmap reads only their first word from text."""
    lines = iter(file.read_text().split("\n"))
    for line in lines:
        if line.strip() and not line.strip().startswith("#"):
            words = line.split(maxsplit=9)
            model.image(int(words[0])).name = words[9].strip()
            next(lines, None)  # its keypoints


def _fault(model: pycolmap.Reconstruction) -> str | None:
    """The first fault found in a model that pycolmap could read, or None."""
    if not model.num_reg_images():
        return "the model has no image with a pose"
    for camera_id, camera in sorted(model.cameras.items()):
        if camera.is_spherical():
            return f"camera {camera_id} is spherical ({camera.model_name}), which is not supported"
        if not _is_camera(camera):
            return f"camera {camera_id} has an impossible size or focal length"
    if not model.is_valid() or _num_track_elements(model) != model.compute_num_observations():
        return "its points and images do not belong together"
    if len({image.name for image in model.images.values()}) < model.num_images():
        return "several of its images have the same name"
    poses = [model.image(image_id).cam_from_world().matrix() for image_id in model.reg_image_ids()]
    positions = np.array([point.xyz for point in model.points3D.values()])
    if not np.isfinite(poses).all() or not np.isfinite(positions).all():
        return "a pose or a point in it is not finite"
    return None


def _is_camera(camera: pycolmap.Camera) -> bool:
    sizes_are_possible = 0 < camera.width < _MOST_PIXELS and 0 < camera.height < _MOST_PIXELS
    focal_lengths = camera.params[camera.focal_length_idxs()]
    return sizes_are_possible and bool(np.isfinite(camera.params).all() and (focal_lengths > 0).all())


def _num_track_elements(model: pycolmap.Reconstruction) -> int:
    return sum(point.track.length() for point in model.points3D.values())


def camera_of(image: pycolmap.Image) -> pycolmap.Camera:
    """The camera of an image of a model.

    Raises:
        ModelError: The image has no camera in the model.
    """
    if image.camera is None:
        raise ModelError(f"image {image.name!r} has no camera in the model")
    return image.camera


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _check_binary(file: Path, walk: "Walk") -> None:
    if not file.is_file():
        return  # models from before rigs and frames lack these two files
    data = memoryview(file.read_bytes())
    try:
        (count,) = struct.unpack_from("<Q", data, 0)
        position = 8
        for _ in range(count):
            position = walk(data, position)
            if position > len(data):
                raise ValueError
    except (struct.error, ValueError, IndexError, KeyError):
        raise ModelError(
            f"{file}: damaged or cut short ({len(data)} bytes); copy or export the model again"
        ) from None
    if position != len(data):
        raise ModelError(f"{file}: {len(data) - position} bytes too long; copy or export the model again")


def _walk_camera(data: memoryview, position: int) -> int:
    model = pycolmap.CameraModelId(struct.unpack_from("<i", data, position + 4)[0])
    params = pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params
    return position + _CAMERA + 8 * len(params)


def _walk_image(data: memoryview, position: int) -> int:
    end = position + 4 + _POSE + 4
    while data[end] != 0:
        end += 1
    (num_points2D,) = struct.unpack_from("<Q", data, end + 1)
    return end + 9 + _POINT2D * num_points2D


def _walk_point3D(data: memoryview, position: int) -> int:
    (track_length,) = struct.unpack_from("<Q", data, position + 43)
    return position + 51 + _TRACK_ELEMENT * track_length


def _walk_rig(data: memoryview, position: int) -> int:
    (num_sensors,) = struct.unpack_from("<I", data, position + 4)
    position += 8 + (_SENSOR if num_sensors else 0)
    for _ in range(num_sensors - 1):
        position += _SENSOR + 1 + (_POSE if data[position + _SENSOR] else 0)
    return position


def _walk_frame(data: memoryview, position: int) -> int:
    (num_data,) = struct.unpack_from("<I", data, position + 8 + _POSE)
    return position + 12 + _POSE + _DATA * num_data


Walk = Callable[[memoryview, int], int]
"""Takes the bytes of a file and the start of a record, and returns the start of the next record."""

_WALKS: dict[str, Walk] = {
    "cameras": _walk_camera,
    "rigs": _walk_rig,
    "frames": _walk_frame,
    "images": _walk_image,
    "points3D": _walk_point3D,
}


_ROUNDS = 50  # of trimming; it converges in fewer
_REACH = 2.0  # points beyond this many times the root mean square distance are background
_SPREAD = 0.25  # of the Gaussian, over the shorter side of the image
_TAIL = 0.01  # share of the weight outside either end of the box


def read_box(path: str | Path) -> Box:
    """Read a box from JSON (`{"corners": [[x, y, z], ...]}` or the list alone) or `box3d_corners.txt`.

    Raises:
        InputError: The file is missing, or does not hold the 8 corners of a box.
    """
    path = Path(path)
    try:
        if path.suffix.lower() == ".json":
            data = json.loads(path.read_text())
            corners = np.array(data["corners"] if isinstance(data, dict) else data, np.float64)
        else:
            lines = [line.split() for line in path.read_text().splitlines() if line.strip()]
            corners = np.array(lines, np.float64)
        return Box.from_corners(corners)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such box file") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: must hold the 8 corners of a box, each a line or list of x y z ({error})"
        ) from error


def estimate_box(model: pycolmap.Reconstruction) -> Box:
    """Estimate the box of the object that the images look at.

    The weight of a point grows with the number of its observations and with how close they are to the image
    centers. Points farther from the weighted mean than twice the root mean square distance are background;
    they are removed until nothing changes. The box is aligned with the principal axes of the remaining points
    and leaves out 1 % of their weight at each of its sides.

    With masks, all features and points lie on the object, and the same rule works.
    """
    ids = sorted(model.point3D_ids())
    points = np.array([model.point3D(i).xyz for i in ids], np.float64).reshape(-1, 3)
    weights = _centrality(model, np.array(ids, np.int64))
    inside = np.ones(len(points), dtype=bool)
    for _ in range(_ROUNDS):
        mean = np.average(points[inside], axis=0, weights=weights[inside])
        squared = ((points - mean) ** 2).sum(axis=1)
        kept = squared <= _REACH**2 * np.average(squared[inside], weights=weights[inside])
        if np.array_equal(kept, inside):
            break
        inside = kept
    return _box_around(points[inside], weights[inside])


def _centrality(model: pycolmap.Reconstruction, ids: Ids) -> Float64[np.ndarray, " n"]:
    """Weight per point: a Gaussian of the distance to the image center, summed over its observations."""
    weights = np.zeros(len(ids))
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        seen = image.get_observation_points2D()
        pixels = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
        camera = model.camera(image.camera_id)
        size = np.array([camera.width, camera.height])
        squared = (((pixels - size / 2) / (_SPREAD * size.min())) ** 2).sum(axis=1)
        rows = np.searchsorted(ids, np.array([point.point3D_id for point in seen], np.int64))
        weights[rows] += np.exp(-squared / 2)
    return weights + 1e-12


def _box_around(points: Points3D, weights: Float64[np.ndarray, " n"]) -> Box:
    mean = np.average(points, axis=0, weights=weights)
    covariance = ((points - mean).T * weights) @ (points - mean)
    axes = np.linalg.eigh(covariance)[1].T
    axes *= np.where(axes[np.arange(3), np.abs(axes).argmax(axis=1)] < 0, -1.0, 1.0)[:, None]
    coordinates = (points - mean) @ axes.T
    low, high = np.array([_weighted_range(coordinates[:, i], weights) for i in range(3)]).T
    half = np.maximum((high - low) / 2, max(1e-3 * (high - low).max(), 1e-9))
    return Box(mean + (low + high) / 2 @ axes, half[:, None] * axes)


def _weighted_range(values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weights[order]) / weights.sum()
    low, high = np.searchsorted(share, (_TAIL, 1 - _TAIL))
    return float(values[order[low]]), float(values[order[min(high, len(order) - 1)]])
