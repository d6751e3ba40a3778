"""The cameras of a map, told apart by what they are, and the devices that its photos were taken with."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import pycolmap

from slimsfm.devices import Device

_CLEAR_MAJORITY = 0.8  # of the photos of a camera
_DIGITS = 6  # of a parameter; formats of text write few


@dataclass(frozen=True, kw_only=True, eq=False)
class MapCamera:
    """A camera of a map, under however many ids."""

    camera: pycolmap.Camera
    """The calibrated intrinsics."""

    device: Device | None
    """What EXIF says of the photos it was made with; None if that is unknown or they do not agree."""

    orientation: int
    """EXIF orientation of most of these photos, if the map is of upright ones."""


def camera_key(camera: pycolmap.Camera) -> tuple:
    """A key that is equal for equal intrinsics, whatever their ids."""
    return camera.model_name, camera.width, camera.height, *(f"{one:.{_DIGITS}g}" for one in camera.params)


def distinct_cameras(
    images: Iterable[pycolmap.Image],
    cameras: Mapping[int, pycolmap.Camera],
    devices: Mapping[int, Device],
    exif_orientations: Mapping[str, int],
) -> tuple[MapCamera, ...]:
    """The cameras of images that differ, in order of their first image.

    Args:
        images: The images.
        cameras: Their cameras by id.
        devices: Devices by id of a camera; ids may be missing.
        exif_orientations: EXIF orientations by name of an image, where they are not 1.
    """
    groups: dict[tuple, list[pycolmap.Image]] = defaultdict(list)
    keys = {camera_id: camera_key(camera) for camera_id, camera in cameras.items()}
    for image in images:
        groups[keys[image.camera_id]].append(image)
    found = []
    for members in groups.values():
        known = {devices[image.camera_id] for image in members if image.camera_id in devices}
        tags = Counter(exif_orientations.get(image.name, 1) for image in members)
        found.append(
            MapCamera(
                camera=cameras[members[0].camera_id],
                device=known.pop() if len(known) == 1 else None,
                orientation=tags.most_common(1)[0][0],
            )
        )
    return tuple(found)


def devices_by_camera(model: pycolmap.Reconstruction, devices: Mapping[str, Device]) -> dict[int, Device]:
    """The device of each camera of a model on which a clear majority of its photos agrees, by its id.

    Args:
        model: The model.
        devices: Devices by name of an image; names may be missing.
    """
    by_camera: dict[int, list[Device]] = defaultdict(list)
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        by_camera[image.camera_id].append(devices.get(image.name, Device()))
    found = {}
    for camera_id, members in sorted(by_camera.items()):
        device, count = Counter(members).most_common(1)[0]
        if device.is_known and count >= _CLEAR_MAJORITY * len(members):
            found[camera_id] = device
    return found
