"""A map of some of the images: what the paper calls X' and P'."""

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TypeVar

import pycolmap

from slimsfm.arrays import Image, IndexPairs
from slimsfm.errors import InputError
from slimsfm.features import Features
from slimsfm.mapping.map import GlobalDescriptors, Map, check_has_features

Key = TypeVar("Key")
Value = TypeVar("Value")


def keep_images(map: Map, names: Iterable[str], *, min_track_length: int = 1) -> Map:
    """Keep some reference images and the points they see.

    A point stays if at least `min_track_length` of the kept images observe it; 1 gives the paper's P'. Ids,
    names, cameras, poses and positions stay as they are; tracks lose the observations of dropped images.

    Raises:
        InputError: A name is not that of a reference image, or no name is given.
        MapError: The map was made for direct matching alone.
    """
    check_has_features(map)
    kept = sorted(set(names))
    if not kept:
        raise InputError("no image was chosen to be kept")
    for name in kept:
        if name not in map.images:
            raise InputError(f"image {name!r} is not one of the {len(map.images)} images of the map")
    chosen = frozenset(kept)
    features: Mapping[str, Features] = Selection(map.features, chosen.__contains__)
    matches: Mapping[tuple[str, str], IndexPairs] = Selection(map.matches, chosen.issuperset)
    photos: Mapping[str, Image] = Selection(map.photos, chosen.__contains__)
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


class Selection(Mapping[Key, Value]):
    """The entries of a mapping whose keys are wanted, read from it on access."""

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
    """The observations of a point in some images."""
    return [one for one in map.model.points3D[point3D_id].track.elements if one.image_id in image_ids]


def copy_images(map: Map, names: list[str], *, keypoints: bool = True) -> pycolmap.Reconstruction:
    """A model of some reference images, their cameras and rigs, but no points yet.

    Args:
        map: The map.
        names: The images.
        keypoints: Keep the images' keypoints.
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
    """Add points of a map, by id and with these tracks, to a model of some of its images."""
    points = map.model.points3D
    for point3D_id, track in tracks.items():
        point = points[point3D_id]
        copy = pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error)
        copy.track = pycolmap.Track(track)
        model.add_point3D_with_id(point3D_id, copy)


def _copy_cameras_and_rigs(
    source: pycolmap.Reconstruction, target: pycolmap.Reconstruction, kept: dict[int, pycolmap.Image]
) -> None:
    """Copy what the kept images need; a rig stays whole, with all of its cameras."""
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
    """The frame with only those of its images that are kept."""
    copy = pycolmap.Frame(frame_id=frame.frame_id, rig_id=frame.rig_id)
    for data in frame.data_ids:
        if data.id in kept:
            copy.add_data_id(data)
    copy.rig_from_world = frame.rig_from_world
    return copy
