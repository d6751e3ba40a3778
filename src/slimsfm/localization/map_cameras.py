"""Which camera of a map took a query, by its size and by what EXIF says of its device."""

from collections.abc import Iterator
from typing import NamedTuple

import pycolmap

from slimsfm.devices import Device, is_possible_focal
from slimsfm.errors import ModelError
from slimsfm.exif import Exif
from slimsfm.mapping.cameras import MapCamera, camera_key
from slimsfm.mapping.map import Map
from slimsfm.mapping.orientation import turned_camera, turns_between

_SAME_FOCAL = 0.1  # relative difference below which EXIF means the map's camera, whose calibration is better


def scaled_camera(camera: pycolmap.Camera, width: int, height: int) -> pycolmap.Camera | None:
    """The camera of an image resized to this size; None if the aspect ratio differs."""
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        return None
    scaled = pycolmap.Camera(camera.todict())
    scaled.rescale(width, height)
    return scaled


def camera_of_size(map: Map, width: int, height: int) -> pycolmap.Camera | None:
    """The one camera of a map that an image of this size may be of; None if none is or several differ."""
    sized = (_Fitting.of(one, Device(), (width, height), 0) for one in map.cameras)
    return _only([one for one in sized if one])


def camera_by_exif(map: Map, exif: Exif) -> pycolmap.Camera | None:
    """The one camera of a map that took a photo, in its pixels.

    Nothing in EXIF may contradict it: make, model, focal lengths and digital zoom are those of the photos
    that the camera was made with, where both are known. Where no focal lengths can be compared, that in EXIF
    is within 10 % of the camera's.

    Returns:
        The camera; None if there is none, if several differ, or if the photo is a crop.
    """
    if exif.is_crop:
        return None
    return _only([one for one in _fitting(map, exif) if one.is_of(exif)])


def zoomed_camera(map: Map, exif: Exif) -> pycolmap.Camera | None:
    """The one camera of a map that took a photo with another zoom, which only enlarged the center.

    Returns:
        The camera with the focal length for this zoom; None as in `camera_by_exif`.
    """
    if exif.is_crop:
        return None
    same_lens = [one for one in _fitting(map, exif) if one.device.is_lens_of(exif.device)]
    zoomed = [one._replace(camera=_zoomed(one, exif.device)) for one in same_lens]
    longer_side = max(exif.stored_size)
    return _only([one for one in zoomed if is_possible_focal(one.camera.mean_focal_length(), longer_side)])


def _zoomed(fitting: "_Fitting", device: Device) -> pycolmap.Camera:
    zoom, zoomed = device.zoom_over(fitting.device), pycolmap.Camera(fitting.camera.todict())
    params = zoomed.params.tolist()
    for index in zoomed.focal_length_idxs():
        params[index] *= zoom
    for index, side in zip(zoomed.principal_point_idxs(), (zoomed.width, zoomed.height), strict=True):
        params[index] = side / 2 + zoom * (params[index] - side / 2)
    zoomed.params = params
    return zoomed


class _Fitting(NamedTuple):
    """A camera of a map that an image may be of by its size."""

    camera: pycolmap.Camera  # in the pixels of the image
    device: Device
    rank: tuple[bool, bool, bool]  # whether model of the device and size are those of the image, and unturned

    @classmethod
    def of(
        cls, one: MapCamera, device: Device, size: tuple[int, int], turns: int | None
    ) -> "_Fitting | None":
        made_with = one.device or Device()
        is_same_model = bool(device.model) and device.model == made_with.model
        camera = scaled_camera(one.camera, *size)
        is_unturned = camera is not None
        if camera is None and (turns in (1, 3) or is_same_model):
            # Editors may have dropped the orientation. To which side does not matter in the center.
            camera = _turned(one.camera, size, turns if turns in (1, 3) else 1)
        if camera is None:
            return None
        is_same_size = sorted(size) == sorted((one.camera.width, one.camera.height))
        return cls(camera, made_with, (is_same_model, is_same_size, is_unturned))

    def is_of(self, exif: Exif) -> bool:
        """Whether EXIF does not contradict the camera."""
        if self.device.is_known and not exif.device.is_known:
            return True
        if self.device.differs(exif.device):
            return False
        if self.device.shares_focal_length(exif.device):
            return True
        focal = exif.focal_px
        return focal is None or abs(focal / self.camera.mean_focal_length() - 1) < _SAME_FOCAL


def _fitting(map: Map, exif: Exif) -> Iterator[_Fitting]:
    is_upright = map.info.orientation == "upright"
    for one in map.cameras:
        turns = turns_between(one.orientation, exif.orientation) if is_upright else 0
        if found := _Fitting.of(one, exif.device, exif.size(map.info.orientation), turns):
            yield found


def _turned(camera: pycolmap.Camera, size: tuple[int, int], turns: int) -> pycolmap.Camera | None:
    try:
        return scaled_camera(turned_camera(camera, turns), *size)
    except ModelError:
        return None


def _only(found: list[_Fitting]) -> pycolmap.Camera | None:
    """The camera of the highest rank, unless several differ."""
    highest = max((one.rank for one in found), default=None)
    cameras = {camera_key(one.camera): one.camera for one in found if one.rank == highest}
    return cameras.popitem()[1] if len(cameras) == 1 else None
