"""Parts of a map: some of its images (the paper's X' and P'), or some of its points for direct matching."""

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pycolmap

from slimsfm.arrays import Image, IndexPairs
from slimsfm.errors import InputError
from slimsfm.features import Features
from slimsfm.mapping.map import GlobalDescriptors, Map, PointDescriptors, check_has_features

Key = TypeVar("Key")
Value = TypeVar("Value")


def keep_images(map: Map, names: Iterable[str], *, min_track_length: int = 1) -> Map:
    """Keep some reference images and the points that they observe.

    A point stays if at least `min_track_length` of the kept images observe it; 1 gives the paper's P'. Ids,
    names, cameras, poses and positions do not change; tracks lose the observations of dropped images.

    Raises:
        InputError: `names` is empty or contains a name that is not in the map.
        MapError: The map is for direct matching only.
    """
    check_has_features(map)
    kept = sorted(set(names))
    if not kept:
        raise InputError("no image to keep was given")
    for name in kept:
        if name not in map.images:
            raise InputError(f"image {name!r} is not one of the {len(map.images)} images of the map")
    chosen = frozenset(kept)
    features: Mapping[str, Features] = FilteredMapping(map.features, chosen.__contains__)
    matches: Mapping[tuple[str, str], IndexPairs] = FilteredMapping(map.matches, chosen.issuperset)
    photos: Mapping[str, Image] = FilteredMapping(map.photos, chosen.__contains__)
    model = _subset_model(map, kept, min_track_length)
    return replace(
        map,
        model=model,
        features=features,
        matches=matches,
        photos=photos,
        global_descriptors=_global_descriptors_of(map, chosen),
        point_descriptors=None,
    )


def _global_descriptors_of(map: Map, chosen: frozenset[str]) -> GlobalDescriptors | None:
    if map.global_descriptors is None:
        return None
    rows = [row for row, name in enumerate(map.images) if name in chosen]
    return GlobalDescriptors(
        vocabulary=map.global_descriptors.vocabulary, descriptors=map.global_descriptors.descriptors[rows]
    )


def direct_map(map: Map, chosen: PointDescriptors) -> Map:
    """Keep some points for direct matching, and drop everything that only serves to match images.

    Images keep their name, camera and pose but lose their keypoints and features. Points keep their id,
    position and color but lose their tracks.
    """
    model = copy_images(map, list(map.images), keypoints=False)
    copy_points(map, model, {point3D_id: [] for point3D_id in map.point3D_ids[chosen.points].tolist()})
    _, points = np.unique(chosen.points, return_inverse=True)
    descriptors = replace(chosen, points=points)
    return replace(
        map,
        model=model,
        features={},
        matches={},
        photos={},
        global_descriptors=None,
        point_descriptors=descriptors,
    )


def with_points(slim: Map, map: Map, chosen: PointDescriptors) -> Map:
    """Add points for direct matching to a map of some images, so that it serves both ways of matching.

    Args:
        slim: A map of some of the images of `map`.
        map: The full map.
        chosen: The points to add, as rows of `map`.
    """
    kept = {image.image_id for image in slim.images.values()}
    wanted = map.point3D_ids[chosen.points]
    model = pycolmap.Reconstruction(slim.model)
    missing = np.setdiff1d(wanted, slim.point3D_ids)
    copy_points(map, model, {i: track_in(map, i, kept) for i in missing.tolist()})
    joined = replace(slim, model=model)
    rows = np.searchsorted(joined.point3D_ids, wanted)
    return replace(joined, point_descriptors=replace(chosen, points=rows))


class FilteredMapping(Mapping[Key, Value]):
    """A view of the entries of a mapping whose keys are wanted; values are read on access."""

    def __init__(self, source: Mapping[Key, Value], wanted: Callable[[Key], bool]) -> None:
        self._source = source
        self._keys = {key: None for key in source if wanted(key)}

    def __getitem__(self, key: Key) -> Value:
        if key not in self._keys:
            raise KeyError(key)
        return self._source[key]

    def __contains__(self, key: object) -> bool:
        return key in self._keys

    def __iter__(self) -> Iterator[Key]:
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)


def _subset_model(map: Map, names: list[str], min_track_length: int) -> pycolmap.Reconstruction:
    model = copy_images(map, names)
    kept = {map.images[name].image_id for name in names}
    tracks = {point3D_id: track_in(map, point3D_id, kept) for point3D_id in map.point3D_ids.tolist()}
    copy_points(map, model, {i: track for i, track in tracks.items() if len(track) >= min_track_length})
    return model


def track_in(map: Map, point3D_id: int, image_ids: Container[int]) -> list[pycolmap.TrackElement]:
    """The observations of a point by some images."""
    return [one for one in map.model.points3D[point3D_id].track.elements if one.image_id in image_ids]


def copy_images(map: Map, names: list[str], *, keypoints: bool = True) -> pycolmap.Reconstruction:
    """Copy some reference images, their cameras and rigs to a model without points.

    Args:
        map: The map.
        names: Names of the images.
        keypoints: Copy the keypoints as well.
    """
    model = pycolmap.Reconstruction()
    kept = {map.images[name].image_id: map.images[name] for name in names}
    _copy_cameras_and_rigs(map.model, model, kept)
    for image_id in sorted(kept):
        image = kept[image_id]
        copy = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image_id)
        if keypoints:
            copy.points2D = pycolmap.Point2DList([pycolmap.Point2D(p.xy) for p in image.points2D])
        copy.frame_id = image.frame_id
        model.add_image(copy)
    return model


def copy_points(
    map: Map, model: pycolmap.Reconstruction, tracks: Mapping[int, list[pycolmap.TrackElement]]
) -> None:
    """Copy points of a map, given by id with their new tracks, to a model of some of its images."""
    points = map.model.points3D
    for point3D_id, track in tracks.items():
        point = points[point3D_id]
        copy = pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error)
        copy.track = pycolmap.Track(track)
        model.add_point3D_with_id(point3D_id, copy)


def _copy_cameras_and_rigs(
    source: pycolmap.Reconstruction, target: pycolmap.Reconstruction, kept: dict[int, pycolmap.Image]
) -> None:
    """Copy the cameras, rigs and frames of the kept images; a rig keeps all of its cameras."""
    frames = {image.frame_id: source.frame(image.frame_id) for image in kept.values()}
    rigs = {frame.rig_id: source.rig(frame.rig_id) for frame in frames.values()}
    sensors = {sensor.id for rig in rigs.values() for sensor in rig.sensor_ids()}
    for camera_id in sorted(sensors & set(source.cameras)):
        target.add_camera(source.camera(camera_id))
    for rig_id in sorted(rigs):
        target.add_rig(rigs[rig_id])
    for frame_id in sorted(frames):
        target.add_frame(_frame_of(frames[frame_id], kept))


def _frame_of(frame: pycolmap.Frame, kept: dict[int, pycolmap.Image]) -> pycolmap.Frame:
    """A copy of the frame with only the kept images."""
    copy = pycolmap.Frame(frame_id=frame.frame_id, rig_id=frame.rig_id)
    for data in frame.data_ids:
        if data.id in kept:
            copy.add_data_id(data)
    copy.rig_from_world = frame.rig_from_world
    return copy
