"""From the bytes of an image to the answer of `POST /v1/localize`. All that computes is the library's."""

from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

from slimsfm.localization import Localization, MultiLocalizer
from slimsfm.localization.cameras import QueryCamera, UnknownIntrinsicsError, guess_camera, query_camera
from slimsfm.photos import Orientation, Photo
from slimsfm.serve.errors import ApiError
from slimsfm.serve.images import image_file, read_upright_or_stored
from slimsfm.serve.maps import ServedMap
from slimsfm.serve.queries import CameraChoice, Intrinsics, LocalizeQuery
from slimsfm.serve.replies import Json, localization_reply


def localize_bytes(maps: Sequence[ServedMap], query: LocalizeQuery, data: bytes) -> Json:
    """Search an image for the objects of some maps.

    Returns:
        The answer for the map of the most confident pose, with those of all maps as `maps` where there are
        several.

    Raises:
        ApiError: The image or its intrinsics cannot be used.
    """
    start = perf_counter()
    with image_file(data) as path:
        photos: dict[Orientation, Photo] = {}
        for served in maps:
            orientation = served.localizer.map.info.orientation
            if orientation not in photos:
                photos[orientation] = read_upright_or_stored(path, orientation)
        cameras = {one.id: _camera(one, query.camera, path, photos) for one in maps}
    decoded = perf_counter()
    found = _localize(maps, query, photos, cameras)
    replies = [localization_reply(one, found[one.id]) for one in maps]
    stages = {
        stage: round(1e3 * sum(getattr(one.seconds, stage) for one in found.values()), 3)
        for stage in ("extract", "match", "pose")
    }
    end = perf_counter()
    best = max(replies, key=lambda one: (one["found"], one["confidence"] or 0.0))
    ms = {"decode": round(1e3 * (decoded - start), 3), **stages, "work": round(1e3 * (end - start), 3)}
    return {**best, "ms": ms, **({"maps": replies} if len(replies) > 1 else {})}


def _localize(
    maps: Sequence[ServedMap],
    query: LocalizeQuery,
    photos: dict[Orientation, Photo],
    cameras: dict[str, QueryCamera],
) -> dict[str, Localization]:
    """The outcome by id; near the prior pose first, where one is given."""
    found: dict[str, Localization] = {}
    if query.prior is not None:
        for one in maps:
            image = photos[one.localizer.map.info.orientation].image
            near = one.localizer.localize_near(image, cameras[one.id], query.prior)
            if near.pose:
                found[one.id] = near
    for orientation, photo in photos.items():
        left = {one.id: one.localizer for one in maps if one.id not in found}
        alike = {key: one for key, one in left.items() if one.map.info.orientation == orientation}
        if alike:
            multi = MultiLocalizer(alike)
            found |= multi.localize(photo.image, cameras, query.gravity, photo.visible)
    return found


def _camera(
    served: ServedMap, choice: CameraChoice, path: Path, photos: dict[Orientation, Photo]
) -> QueryCamera:
    map_ = served.localizer.map
    height, width = photos[map_.info.orientation].image.shape[:2]
    if choice == "unknown":
        return QueryCamera(camera=guess_camera(width, height), source="unknown")
    if isinstance(choice, Intrinsics):
        return QueryCamera(camera=choice.camera(width, height), source="given")
    try:
        return query_camera(map_, path, None, served.localizer.options.focal)
    except UnknownIntrinsicsError as error:
        raise ApiError(422, "unknown_camera", "the intrinsics are unknown: give fx, fy, cx and cy") from error
