"""A map of an object's mapping sequence."""

from pathlib import Path

import pycolmap

from slimsfm.datasets.base import ObjectSequences, PosedSequence
from slimsfm.datasets.images import hold_out
from slimsfm.mapping.build import BuildOptions, KnownPoses, build_map
from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent


def map_object(
    sequences: ObjectSequences,
    workspace: Path,
    options: BuildOptions = BuildOptions(),
    progress: ProgressBar = silent,
) -> Map:
    """Map an object by its mapping sequence, in its own frame.

    Points are triangulated from the known poses; where these come from a map with the features that are
    wanted, that map without the queries is taken.
    """
    truth = sequences.truth
    if truth is not None and truth.info.extractor == options.extractor:
        return hold_out(truth, list(sequences.query.names))
    known = KnownPoses(
        cameras=_numbered_cameras(sequences.mapping),
        cam_from_world=dict(zip(sequences.mapping.names, sequences.mapping.cam_from_world, strict=True)),
        box=sequences.box,
        unit=sequences.unit,
    )
    folder = sequences.mapping.folder
    return build_map(folder, options, known=known, workspace=workspace, progress=progress)


def _numbered_cameras(sequence: PosedSequence) -> dict[str, pycolmap.Camera]:
    """The camera of each image; equal ones have one number."""
    numbers: dict[tuple, int] = {}
    cameras = {}
    for name, camera in zip(sequence.names, sequence.cameras, strict=True):
        key = (camera.model_name, camera.width, camera.height, camera.params.tobytes())
        number = numbers.setdefault(key, len(numbers) + 1)
        cameras[name] = pycolmap.Camera(camera.todict() | {"camera_id": number})
    return cameras
