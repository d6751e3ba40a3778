"""Maps for direct matching: the chosen points with one descriptor each."""

from dataclasses import replace

import numpy as np
import pycolmap

from slimsfm.mapping.map import Map, PointDescriptors
from slimsfm.mapping.subset import copy_images, copy_points, track_in


def direct_map(map: Map, chosen: PointDescriptors) -> Map:
    """Keep some points for direct matching, and nothing that only serves to match images.

    The images keep name, camera and pose, but lose their keypoints and features; the points keep id, position
    and colour, but lose their tracks.
    """
    model = copy_images(map, list(map.images), keypoints=False)
    copy_points(map, model, {point3D_id: [] for point3D_id in map.point3D_ids[chosen.points].tolist()})
    points = np.arange(len(chosen.points), dtype=np.int64)
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
    """Add points to a map of some of a map's images, for both ways of matching.

    Args:
        slim: The map of some images.
        map: The map it was made of.
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
