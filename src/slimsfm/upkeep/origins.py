"""Where a map and its focal lengths come from, after changes."""

import re
from collections.abc import Mapping

from slimsfm.mapping.map import Map


def with_count(origin: str, count: int, what: str) -> str:
    """The origin of a map after a change, over all changes: "..., 12 added" becomes "..., 15 added"."""
    ending = re.compile(rf", (\d+) {re.escape(what)}$")
    before = ending.search(origin)
    total = count + (int(before[1]) if before else 0)
    rest = ending.sub("", origin)
    return f"{rest}, {total} {what}" if total else rest


def focal_origins(map: Map) -> dict[str, str]:
    """First guess of the focal length of each image, as far as the map says so of its camera."""
    return over_cameras(map, map.info.quality.focal_origins if map.info.quality else {})


def over_cameras(map: Map, origins: Mapping[str, str]) -> dict[str, str]:
    """The origins that are given for some images, for all images of their cameras; later ones count."""
    of_camera = {map.images[name].camera_id: origin for name, origin in origins.items() if name in map.images}
    return {
        name: of_camera[image.camera_id] for name, image in map.images.items() if image.camera_id in of_camera
    }
