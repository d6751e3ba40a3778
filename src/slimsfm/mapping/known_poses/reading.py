"""Read the known poses of photos, whatever their format."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from slimsfm.errors import InputError
from slimsfm.exif import Exif
from slimsfm.geometry import resized_camera
from slimsfm.image_files import named
from slimsfm.lenses import camera_fault
from slimsfm.mapping.extraction import CameraSharing
from slimsfm.mapping.known_poses import colmap, nerfstudio, onepose, trajectory
from slimsfm.mapping.known_poses.given import GivenPoses, Unit
from slimsfm.mapping.known_poses.intrinsics import find_intrinsics
from slimsfm.mapping.known_poses.matching import PhotosToPose, match_photos
from slimsfm.mapping.work import KnownPoses
from slimsfm.photos import Orientation

_FEWEST = 2  # photos of a map
_LITTLE = 0.01  # relative difference of shapes that are the same


@dataclass(frozen=True)
class PoseFormat:
    """A format of files of poses."""

    recognizes: Callable[[Path], bool]
    """Whether a path is of this format."""

    read: Callable[[Path], GivenPoses]
    """Reads the poses."""


FORMATS = {
    "nerfstudio": PoseFormat(nerfstudio.recognizes, nerfstudio.read),
    "colmap": PoseFormat(colmap.recognizes, colmap.read),
    "onepose": PoseFormat(onepose.recognizes, onepose.read),
    "trajectory": PoseFormat(trajectory.recognizes, trajectory.read),
}
"""Formats of poses, in the order in which a path is tried."""


def read_given(path: Path) -> GivenPoses:
    """Read poses; the path itself says in which format.

    Raises:
        InputError: The path does not exist, is of no known format, or the file is damaged or has no pose.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder of poses")
    for one in FORMATS.values():
        if one.recognizes(path):
            given = one.read(path)
            if not given.cam_from_world:
                raise InputError(f"{path}: holds no pose")
            return given
    raise InputError(
        f"{path}: holds no poses in a known format: transforms.json, a COLMAP model, OnePose's folder "
        "of a sequence, a text file of TUM or KITTI"
    )


def pose_photos(
    given: GivenPoses,
    photos: PhotosToPose,
    read_exifs: Callable[[list[str]], Mapping[str, Exif]],
    *,
    sharing: CameraSharing,
    orientation: Orientation,
    unit: Unit | None,
) -> KnownPoses:
    """Find the poses and cameras of photos. Photos without a pose are left out and named in the notes.

    Args:
        given: Poses of a file.
        photos: The photos.
        read_exifs: Reads EXIF data of these photos, without those that cannot be read.
        sharing: Which photos share a camera, if the intrinsics are from EXIF.
        orientation: Which pixels of the photos are used.
        unit: Unit of the poses; None: what the file says.

    Raises:
        InputError: Fewer than two photos have a pose, or the intrinsics are missing or of other photos.
    """
    keys = match_photos(given, photos)
    names = sorted(keys)
    if len(names) < _FEWEST:
        some = ", ".join(list(given.cam_from_world)[:2])
        raise InputError(
            f"{given.source}: has {len(given.cam_from_world)} poses, of {some}, ..., but "
            f"{'only one is' if names else 'none is'} of a photo in {photos.folder} "
            f"({len(photos.names)} photos: {', '.join(photos.names[:2])}, ...); a map needs at least two"
        )
    exifs = read_exifs(names)
    names = [name for name in names if name in exifs]
    notes = list(given.notes) if unit is None else []
    poses = {name: given.cam_from_world[keys[name]] for name in names}
    if given.cameras is None:
        found = find_intrinsics(given.source, photos.folder, exifs, sharing, orientation)
        cameras, note = found.cameras, found.note
        poses = {name: found.cam_from_posed * pose for name, pose in poses.items()}
        notes.append(note)
    else:
        cameras = {name: given.cameras[keys[name]] for name in names}
    sizes = {name: exif.size(orientation) for name, exif in exifs.items()}
    return KnownPoses(
        cameras=_fitted(cameras, sizes, given.source),
        cam_from_world=poses,
        unit=unit or given.unit,
        convention=given.convention,
        source=str(given.source),
        notes=(*notes, *_left_out(given, photos, keys)),
    )


def _left_out(given: GivenPoses, photos: PhotosToPose, keys: Mapping[str, str]) -> list[str]:
    without = [name for name in photos.names if name not in keys]
    used = set(keys.values())
    unused = [key for key in given.cam_from_world if key not in used]
    notes = [named("photo(s) without a pose left out", without)] if without else []
    return notes + ([named("pose(s) without a photo ignored", unused)] if unused else [])


def _fitted(
    cameras: Mapping[str, pycolmap.Camera], sizes: Mapping[str, tuple[int, int]], source: Path
) -> dict[str, pycolmap.Camera]:
    """Cameras of the sizes of their photos; equal ones have equal ids."""
    ids: dict[tuple, int] = {}
    fitted = {}
    for name, size in sizes.items():
        camera = _of_size(cameras[name], size, f"{source}: {name}")
        if fault := camera_fault(camera):
            raise InputError(f"{source}: the camera of {name} is impossible: {fault}")
        key = (camera.model_name, *size, camera.params.tobytes())
        camera.camera_id = ids.setdefault(key, len(ids) + 1)
        fitted[name] = camera
    return fitted


def _of_size(camera: pycolmap.Camera, size: tuple[int, int], source: str) -> pycolmap.Camera:
    made = pycolmap.Camera(camera.todict())
    if 0 in (camera.width, camera.height):
        made.width, made.height = size
        return made
    stated = camera.width, camera.height
    factor = size[0] / stated[0]
    if abs(size[1] / stated[1] / factor - 1) < _LITTLE:
        made = resized_camera(made, factor) if size != stated else made
        made.width, made.height = size
        return made
    turned = abs(size[1] / stated[0] / (size[0] / stated[1]) - 1) < _LITTLE
    advice = "; if the poses are of photos as they are stored, use `orientation='stored'`" if turned else ""
    raise InputError(
        f"{source} has {size[0]}x{size[1]} pixels, but its intrinsics are of {stated[0]}x{stated[1]}{advice}"
    )
