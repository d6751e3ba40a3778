"""A map of an object's mapping sequence."""

from pathlib import Path

import pycolmap

from slimsfm.datasets.onepose import ObjectSequences
from slimsfm.mapping.build import Build, BuildOptions, KnownPoses, build_map
from slimsfm.progress import ProgressBar, silent


def map_object(
    sequences: ObjectSequences,
    workspace: Path,
    options: BuildOptions = BuildOptions(),
    progress: ProgressBar = silent,
) -> Build:
    """Triangulate a map from an object's mapping sequence and its known poses, in the object's frame."""
    mapping = sequences.mapping
    camera = pycolmap.Camera(mapping.camera.todict())
    camera.camera_id = 1
    names = [path.name for path in mapping.image_paths]
    known = KnownPoses(
        cameras=dict.fromkeys(names, camera),
        cam_from_world=dict(zip(names, mapping.cam_from_world, strict=True)),
        box=sequences.box,
        unit="metre",
    )
    return build_map(mapping.image_paths[0].parent, workspace, options, known, progress)
