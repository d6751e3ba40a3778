"""What a reference graph depends on, as one string."""

import hashlib
from dataclasses import replace

from slimsfm.graph.source import GraphOptions, resolve
from slimsfm.mapping.map import Map


def graph_key(map: Map, options: GraphOptions) -> str:
    """Equal for equal maps and options: a graph or checkpoint of another key is of other work."""
    relevant = (_relevant(map, options), map.info.extractor, map.info.extractor_options)
    digest = hashlib.sha256(repr(relevant).encode())
    digest.update(map.box.corners.tobytes())
    digest.update(map.point3D_ids.tobytes())
    digest.update(map.points3D_in_world.tobytes())
    digest.update(repr(sorted(map.matches)).encode())
    for name, image in map.images.items():
        digest.update(name.encode())
        digest.update(image.cam_from_world().matrix().tobytes())
        digest.update(map.camera(name).model_name.encode() + map.camera(name).params.tobytes())
        digest.update(map.observations[name].rows.tobytes())
        digest.update(map.observations[name].points.tobytes())
    return digest.hexdigest()


def _relevant(map: Map, options: GraphOptions) -> GraphOptions:
    """The options with the defaults for what the chosen source does not look at."""
    edges, default = resolve(map, options), GraphOptions()
    return replace(
        options,
        edges=edges,
        threshold=options.threshold if edges == "hybrid" else default.threshold,
        candidates=options.candidates if edges == "localize" else default.candidates,
        matching=options.matching if edges in ("localize", "hybrid") else default.matching,
    )
