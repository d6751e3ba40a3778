"""Move a map into another frame."""

from dataclasses import replace

import numpy as np
import pycolmap

from slimsfm.geometry import Box
from slimsfm.mapping.map import Map, PointDescriptors


def transformed(map: Map, new_from_old: pycolmap.Sim3d) -> Map:
    """Turn, scale and shift a map of any kind, with all that depends on its frame and unit.

    Poses, points, box, the viewing directions and sizes of points, and the georeference change; features,
    matches, photos, names, ids and `info.unit` do not. Localized poses change as the map's own poses do. A
    reference graph of the map would stay right, because its errors are over the diagonal, but it belongs to
    the fingerprint of the old map, and so is computed again.

    Args:
        map: The map; it is not changed.
        new_from_old: From the frame of the map to the new one.

    Raises:
        ValueError: The scale is not positive, or a value is not finite.
    """
    if not np.all(np.isfinite(new_from_old.params)) or new_from_old.scale <= 0:
        raise ValueError(f"new_from_old must be finite, with a positive scale, got {new_from_old.params}")
    model = pycolmap.Reconstruction(map.model)
    model.transform(new_from_old)
    turn = new_from_old.scale * new_from_old.rotation.matrix()
    box = Box(new_from_old * map.box.center, map.box.half_edges @ turn.T)
    place = map.info.georeference
    info = replace(map.info, box=box, georeference=place and place.moved(new_from_old))
    described = map.point_descriptors
    moved = described and _moved(described, new_from_old)
    return replace(map, model=model, info=info, point_descriptors=moved)


def _moved(described: PointDescriptors, new_from_old: pycolmap.Sim3d) -> PointDescriptors:
    directions, sizes = described.directions, described.sizes
    if directions is not None:
        directions = (directions @ new_from_old.rotation.matrix().T).astype(np.float32)
    if sizes is not None:
        sizes = (sizes * new_from_old.scale).astype(np.float32)
    return replace(described, directions=directions, sizes=sizes)
