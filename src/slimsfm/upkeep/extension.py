"""Extend a map by images whose poses are known, without moving anything that it has."""

from collections.abc import Collection, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, replace
from itertools import count
from typing import TypeVar

import numpy as np
import pycolmap
from jaxtyping import UInt8
from scipy.spatial import KDTree

from slimsfm.errors import MapError
from slimsfm.features import Features
from slimsfm.mapping.descriptors import describe_new_images
from slimsfm.mapping.map import Map
from slimsfm.mapping.pairs import Matches
from slimsfm.upkeep.local_sfm import triangulate_and_adjust
from slimsfm.upkeep.shrunk import shrunk_model, take_cameras

Key = TypeVar("Key", str, tuple[str, str])
Value = TypeVar("Value")


@dataclass(frozen=True, kw_only=True, eq=False)
class NewImage:
    """An image that a map is extended by."""

    features: Features
    """Its local features, by the map's extractor."""

    camera: pycolmap.Camera
    """Its intrinsics. A camera of the map with equal `camera_id` is shared; any other
    id makes it another camera, under this id."""

    cam_from_world: pycolmap.Rigid3d
    """Its pose, which is refined."""

    image_id: int | None = None
    """Its id, which must be free. By default the next after all ids of the map, in order of names."""

    colors: UInt8[np.ndarray, "n 3"] | None = None
    """RGB at each keypoint. Without it, new points get the color of the nearest old one."""


def extend_map(
    map: Map,
    new: Mapping[str, NewImage],
    matches: Matches,
    *,
    refined_cameras: Collection[int] = (),
    seed: int = 0,
) -> Map:
    """Extend a map by images of known pose.

    Matched keypoints continue the tracks of points that they agree with; others are triangulated. Poses of
    the new images and positions of the new points are adjusted together; then observations that are more
    than 4 px off are removed (in the pixels in which features were found), and new points of less than 1.5
    degrees. Everything else stays as it is, bit for bit: ids, poses, cameras and keypoints of the old images,
    ids, positions and observations of the old points. Keypoints of old images that saw no point may see a new
    one. Image i of a map without some images, `keep_images(map, others, min_track_length=2)`, is put back
    with `NewImage(image_id=i, ...)`.

    `MapInfo` stays as it is: what it says of quality, cameras and orientations is of the old images.

    Args:
        map: The map. It has features of images, and points with tracks.
        new: The new images by name.
        matches: Verified matches by pair of names in order (a, b), a < b, with at least one new image each.
            Rows are those of the features. Those of the old images among each other are in the map.
        refined_cameras: Ids of cameras that only new images have, whose intrinsics are refined too.
        seed: Seed of the triangulation.

    Returns:
        The larger map. An image that agrees with nothing is in it without observations.

    Raises:
        MapError: The map is no full map of keypoints.
        ValueError: A name or an id is taken, a match is of no new image or in the wrong order, or there is
            no new image.
    """
    _check(map, new, matches)
    if taken := {image.camera_id for image in map.images.values()}.intersection(refined_cameras):
        raise ValueError(f"refined_cameras must be of new images alone, but {min(taken)} is not")
    model = pycolmap.Reconstruction(map.model)
    add_images(model, new)
    work = shrunk_model(model, map.info.extractor_options)
    near = {name for pair in matches for name in pair}
    old_matches = {pair: map.matches[pair] for pair in map.matches if near.issuperset(pair)}
    triangulate_and_adjust(work, new, {**old_matches, **matches}, refined_cameras=refined_cameras, seed=seed)
    _take_over(map, model, work, new)
    take_cameras(work, model, sorted(refined_cameras), map.info.extractor_options)
    _color(map, model, new)
    model.update_point_3d_errors()
    features: Mapping[str, Features] = JoinedMapping(map.features, {name: new[name].features for name in new})
    joined: Matches = JoinedMapping(map.matches, matches)
    extended = replace(map, model=model, features=features, matches=joined)
    return replace(extended, global_descriptors=describe_new_images(map, extended))


def _check(map: Map, new: Mapping[str, NewImage], matches: Matches) -> None:
    if map.point_descriptors is not None or not map.has_keypoints:
        raise MapError(
            "only a full map of keypoints can be extended; use the map that this one was made from"
        )
    if not new:
        raise ValueError("new must hold at least one image")
    names = {image.name for image in map.model.images.values()}
    for name, image in new.items():
        if name in names or map.model.exists_image(image.image_id or 0):
            raise ValueError(f"new images must not be in the map, but {name!r} or its id is")
    for a, b in matches:
        if a >= b or not {a, b} & new.keys() or not {a, b} <= new.keys() | map.images.keys():
            raise ValueError(f"matches must be of a new image each, in order of names, got {a!r} and {b!r}")


def add_images(model: pycolmap.Reconstruction, new: Mapping[str, NewImage]) -> None:
    """Add images with keypoints that observe nothing to a model, in order of names."""
    following = count(1 + max(model.images))
    frames = count(1 + max(model.frames))
    for name in sorted(new):
        one = new[name]
        rig_id = _rig_of(model, one.camera)
        image = pycolmap.Image(
            name=name,
            keypoints=one.features.keypoints.astype(np.float64),
            camera_id=model.rig(rig_id).ref_sensor_id.id,
            image_id=next(following) if one.image_id is None else one.image_id,
        )
        frame = pycolmap.Frame(frame_id=next(frames), rig_id=rig_id)
        frame.add_data_id(image.data_id)
        frame.rig_from_world = one.cam_from_world
        model.add_frame(frame)
        image.frame_id = frame.frame_id
        model.add_image(image)


def _rig_of(model: pycolmap.Reconstruction, camera: pycolmap.Camera) -> int:
    """The rig that consists of a camera alone; new if there is none."""
    for rig_id in sorted(model.rigs):
        rig = model.rig(rig_id)
        if rig.num_sensors() == 1 and rig.is_ref_sensor(camera.sensor_id):
            return rig_id
    own = copy(camera)
    if model.exists_camera(camera.camera_id):  # as a part of a rig of several
        own.camera_id = 1 + max(model.cameras)
    model.add_camera(own)
    rig = pycolmap.Rig(rig_id=own.camera_id)
    if model.exists_rig(rig.rig_id):
        rig.rig_id = 1 + max(model.rigs)
    rig.add_ref_sensor(own.sensor_id)
    model.add_rig(rig)
    return rig.rig_id


def _take_over(
    map: Map, model: pycolmap.Reconstruction, work: pycolmap.Reconstruction, new: Mapping[str, NewImage]
) -> None:
    """Copy poses of new images, observations by them and new points from an adjusted copy of a model."""
    new_ids = {image.image_id for image in model.images.values() if image.name in new}
    for image_id in sorted(new_ids):
        frame_id = model.image(image_id).frame_id
        model.frame(frame_id).rig_from_world = work.frame(frame_id).rig_from_world
    old = set(map.point3D_ids.tolist())
    following = count(1 + max(old, default=0))
    for point_id in sorted(work.point3D_ids()):
        point = work.point3D(point_id)
        if point_id not in old:
            made = pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error)
            made.track = pycolmap.Track(_sorted(point.track.elements))
            model.add_point3D_with_id(next(following), made)
            continue
        for element in _sorted(point.track.elements):
            if element.image_id in new_ids:
                model.add_observation(point_id, element)


def _sorted(elements: list[pycolmap.TrackElement]) -> list[pycolmap.TrackElement]:
    return sorted(elements, key=lambda one: (one.image_id, one.point2D_idx))


def _color(map: Map, model: pycolmap.Reconstruction, new: Mapping[str, NewImage]) -> None:
    """Color new points by the mean of the new images that see them, or like the nearest old point."""
    made = sorted(set(model.point3D_ids()) - set(map.point3D_ids.tolist()))
    if not made:
        return
    _, nearest = KDTree(map.points3D_in_world).query([model.point3D(i).xyz for i in made])
    for point_id, like in zip(made, np.asarray(nearest).tolist(), strict=True):
        point = model.point3D(point_id)
        seen = [
            colors[element.point2D_idx]
            for element in point.track.elements
            if (one := new.get(model.image(element.image_id).name)) and (colors := one.colors) is not None
        ]
        mean = np.mean(seen, axis=0).round().astype(np.uint8) if seen else map.colors[like]
        point.color = mean


class JoinedMapping(Mapping[Key, Value]):
    """The entries of two mappings, sorted by key and read on access; those of the second have precedence."""

    def __init__(self, first: Mapping[Key, Value], second: Mapping[Key, Value]) -> None:
        self._first, self._second = first, second
        self._keys = dict.fromkeys(sorted({*first, *second}))

    def __getitem__(self, key: Key) -> Value:
        return self._second[key] if key in self._second else self._first[key]

    def __contains__(self, key: object) -> bool:
        return key in self._keys

    def __iter__(self) -> Iterator[Key]:
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)
