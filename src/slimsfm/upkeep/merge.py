"""Merge two maps of one place that overlap."""

import hashlib
from collections import defaultdict
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
import pycolmap

from slimsfm.arrays import IndexPairs
from slimsfm.errors import InputError, MapError
from slimsfm.mapping.cameras import camera_key
from slimsfm.mapping.descriptors import with_global_descriptors
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.map import Map
from slimsfm.mapping.model import estimate_box
from slimsfm.mapping.pairs import Matches
from slimsfm.mapping.quality import MIN_COMMON_POINTS
from slimsfm.mapping.support import measure
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.between_maps import MapSimilarity, similarity_between
from slimsfm.upkeep.extension import JoinedMapping, NewImage, add_images
from slimsfm.upkeep.joining import add_points, same_points
from slimsfm.upkeep.origins import focal_origins, over_cameras
from slimsfm.upkeep.refinement import Movement, refined
from slimsfm.upkeep.transform import transformed


@dataclass(frozen=True, kw_only=True, eq=False)
class Merged:
    """A map that two maps were merged into."""

    map: Map
    """The merged map."""

    kept: int
    """Whose frame, ids and names it has: 0 for the first of the two maps, 1 for the second."""

    similarity: MapSimilarity
    """How the other map lay in that frame."""

    names: Mapping[str, str]
    """Name in the merged map of each image of the other map."""

    shared: tuple[str, ...]
    """Names, in the merged map, of the images that both maps have."""

    joined_points: int
    """Number of points that both maps have."""

    movement: Movement | None = None
    """How far the images of the map whose frame was kept moved; None if nothing was refined."""


def merge(first: Map, second: Map, *, refine: bool = False, progress: ProgressBar = silent) -> Merged:
    """Merge two full maps of one place into one.

    Images that both maps have, or else images of the one localized in the other, give the similarity between
    the two; points that both see are joined. The frame is that of the first map, unless only the second one
    knows its unit, or its place on Earth. Poses, points, ids and names of the map whose frame is kept do not
    change unless `refine` is set. An image of the other map whose name is taken by another photo is renamed.

    Args:
        first: A full map of keypoints.
        second: Another one, by the same extractor with the same options.
        refine: Adjust all poses, points and cameras together afterwards.
        progress: Progress callback.

    Raises:
        MapError: A map was reduced, or the maps have different extractors or pixels.
        InputError: The maps are the same, do not overlap, or what they share contradicts itself or is too
            little.
        ReconstructionError: Refining gives an impossible camera.
    """
    _check(first, second)
    kept = int(_rank(second) > _rank(first))
    target, source = (second, first) if kept else (first, second)
    similarity = similarity_between(target, source, progress=progress)
    moved = transformed(source, similarity.target_from_source)
    shared = _same_photos(target, source)
    joined = same_points(target, moved, shared, progress=progress)
    names = _unique_names(target, source, shared)
    model = pycolmap.Reconstruction(target.model)
    cameras = _camera_ids(target, moved)
    add_images(model, _new_images(moved, names, shared, cameras))
    ids = {image.name: image.image_id for image in model.images.values()}
    image_ids = {image.image_id: ids[names[name]] for name, image in moved.images.items()}
    add_points(model, moved, joined, image_ids)
    model.update_point_3d_errors()
    merged = _merged(target, moved, model, names, set(shared.values()), cameras)
    movement = None
    if refine:
        merged, movement = refined(merged, target)
    return Merged(
        map=with_global_descriptors(merged),
        kept=kept,
        similarity=similarity,
        names=names,
        shared=tuple(sorted(shared.values())),
        joined_points=len(joined.first),
        movement=movement,
    )


def _check(first: Map, second: Map) -> None:
    if first.fingerprint == second.fingerprint:
        raise InputError("both are the same map; give two maps that overlap")
    for one, which in ((first, "first"), (second, "second")):
        if one.kind != "full" or one.info.parent is not None:
            raise MapError(
                f"the {which} map was reduced, and full maps are merged: merge the maps that they were made "
                "from, and reduce the result"
            )
        if not one.has_keypoints:
            raise MapError(f"the {which} map was built without a detector, and cannot be merged")
    kinds = [(one.info.extractor, one.info.extractor_options) for one in (first, second)]
    if kinds[0] != kinds[1]:
        raise MapError(
            f"the maps have features of {kinds[0][0]} {kinds[0][1]} and of {kinds[1][0]} {kinds[1][1]}; "
            "build one of them again like the other"
        )
    if first.info.orientation != second.info.orientation:
        raise MapError("one map is of upright images and the other one of stored pixels; build one again")


def _rank(map: Map) -> tuple[bool, bool]:
    return map.info.georeference is not None, map.info.unit != "unknown"


def _same_photos(target: Map, source: Map) -> dict[str, str]:
    """Names in the target of the images of the source that have the same features."""
    known = {_digest(target, name): name for name in reversed(target.images)}
    return {name: known[key] for name in source.images if (key := _digest(source, name)) in known}


def _digest(map: Map, name: str) -> bytes:
    features = map.features[name]
    digest = hashlib.sha256(np.ascontiguousarray(features.keypoints).tobytes())
    digest.update(np.ascontiguousarray(features.descriptors).tobytes())
    return digest.digest()


def _unique_names(target: Map, source: Map, shared: Mapping[str, str]) -> dict[str, str]:
    """A name for each image of the source; where another photo has its own, in a folder of its own."""
    taken = {image.name for image in target.model.images.values()}
    clash = any(name in taken for name in source.images if name not in shared)
    folders = ("other" if number == 1 else f"other{number}" for number in count(1))
    folder = next(one for one in folders if not any(name.startswith(f"{one}/") for name in taken))
    prefix = f"{folder}/" if clash else ""
    return {name: shared.get(name, prefix + name) for name in source.images}


def _camera_ids(target: Map, source: Map) -> dict[int, int]:
    """Ids in the merged map of the cameras of the source; equal cameras of a device are shared."""
    used = sorted({image.camera_id for image in target.images.values()})
    known = {_camera_key(target, camera_id): camera_id for camera_id in reversed(used)}
    following = count(1 + max(target.model.cameras))
    wanted = sorted({image.camera_id for image in source.images.values()})
    return {one: known.get(_camera_key(source, one)) or next(following) for one in wanted}


def _camera_key(map: Map, camera_id: int) -> tuple:
    return camera_key(map.model.camera(camera_id)), repr(map.info.devices.get(camera_id))


def _new_images(
    source: Map, names: Mapping[str, str], shared: Mapping[str, str], cameras: Mapping[int, int]
) -> dict[str, NewImage]:
    made = {}
    for name, image in source.images.items():
        if name not in shared:
            camera = copy(source.camera(name))
            camera.camera_id = cameras[image.camera_id]
            pose = image.cam_from_world()
            made[names[name]] = NewImage(features=source.features[name], camera=camera, cam_from_world=pose)
    return made


def _merged(
    target: Map,
    source: Map,
    model: pycolmap.Reconstruction,
    names: Mapping[str, str],
    shared: set[str],
    cameras: Mapping[int, int],
) -> Map:
    added = {names[name]: source.features[name] for name in source.images if names[name] not in shared}
    renamed = _renamed(source, names)
    crossing = _crossing(model, set(target.images), set(added))
    matches: Matches = JoinedMapping(JoinedMapping(renamed, crossing), target.matches)
    merged = replace(
        target,
        model=model,
        features=JoinedMapping(target.features, added),
        matches=matches,
        global_descriptors=None,
        unregistered=tuple(
            sorted(
                {*target.unregistered, *source.unregistered} - {image.name for image in model.images.values()}
            )
        ),
        info=_info(target, source, model, names, cameras),
    )
    if target.info.quality is None and source.info.quality is None:
        return merged
    quality = measure(model, matches, list(merged.images)).with_origins(
        _focal_origins(merged, target, source, names)
    )
    quality = replace(quality, given=len(merged.images) + len(merged.unregistered))
    return replace(merged, info=replace(merged.info, quality=quality))


def _focal_origins(merged: Map, target: Map, source: Map, names: Mapping[str, str]) -> dict[str, str]:
    """First guess of the focal length of each image. Poses stay known only if those of the target are."""
    kept, others = focal_origins(target), focal_origins(source)
    others = {names[name]: origin for name, origin in others.items() if name in names}
    if "given" not in kept.values():
        others = {name: "model" if origin == "given" else origin for name, origin in others.items()}
    return over_cameras(merged, {**others, **kept})


def _renamed(source: Map, names: Mapping[str, str]) -> dict[tuple[str, str], IndexPairs]:
    """The matches of the source by new names."""
    found = {}
    for a, b in source.matches:
        if a in names and b in names and names[a] != names[b]:
            rows = source.matches[a, b]
            key, rows = _ordered(names[a], names[b], rows)
            found[key] = rows
    return found


def _ordered(a: str, b: str, rows: IndexPairs) -> tuple[tuple[str, str], IndexPairs]:
    if a > b:
        a, b, rows = b, a, rows[:, ::-1]
    return (a, b), rows[np.argsort(rows[:, 0], kind="stable")]


def _crossing(
    model: pycolmap.Reconstruction, old: set[str], added: set[str]
) -> dict[tuple[str, str], IndexPairs]:
    """Matches between images of the two maps: keypoints that see one point."""
    rows: dict[tuple[str, str], list[tuple[int, int]]] = defaultdict(list)
    for point_id in sorted(model.point3D_ids()):
        seen = sorted(
            (model.image(one.image_id).name, one.point2D_idx)
            for one in model.point3D(point_id).track.elements
        )
        for a, row_a in seen:
            for b, row_b in seen:
                if a in old and b in added:
                    rows[a, b].append((row_a, row_b))
    found = {}
    for a, b in sorted(rows):
        if len(rows[a, b]) >= MIN_COMMON_POINTS:
            key, pairs = _ordered(a, b, np.array(rows[a, b], np.int64))
            found[key] = pairs
    return found


def _info(
    target: Map,
    source: Map,
    model: pycolmap.Reconstruction,
    names: Mapping[str, str],
    cameras: Mapping[int, int],
) -> MapInfo:
    """What both maps say of themselves; the box is estimated again unless that of the target was given."""
    one, other = target.info, source.info
    given = one if one.box_source == "given" else other if other.box_source == "given" else None
    tags = {names[name]: tag for name, tag in other.exif_orientations.items() if name in names}
    devices = {cameras[key]: device for key, device in other.devices.items() if key in cameras}
    wrong = {*one.wrong_poses, *(names[name] for name in other.wrong_poses if name in names)}
    return replace(
        one,
        box=given.box if given else estimate_box(model),
        box_source="given" if given else "estimated",
        origin=f"merged from a map {one.origin} and a map {other.origin}",
        notes=tuple(dict.fromkeys((*one.notes, *other.notes))),
        exif_orientations={**tags, **one.exif_orientations},
        devices={**devices, **one.devices},
        wrong_poses=tuple(sorted(wrong)),
    )
