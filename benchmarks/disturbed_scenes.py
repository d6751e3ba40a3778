"""Scenes of disturbed queries, each with a full and a slim map: photos, rendered objects, and a flat scene.

Everything is stored in the output folder and made once. True poses of photos are those of a SIFT map of all
of them; the maps of another extractor are triangulated from these poses.
"""

import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image as PilImage

from slimsfm.cli.output import quiet
from slimsfm.datasets import onepose
from slimsfm.datasets.base import LoadOptions, ObjectSequences, PosedSequence, map_object
from slimsfm.datasets.reconstructed import Images, query_names
from slimsfm.datasets.synthetic import Synthetic
from slimsfm.evaluation.results import PosedQuery, queries_of
from slimsfm.files import replacing
from slimsfm.geometry import Box
from slimsfm.mapping import Map, read_map, write_map
from slimsfm.mapping.build import BuildOptions
from slimsfm.mapping.model import estimate_box
from slimsfm.progress import shown
from slimsfm.reduction import reduce
from slimsfm.synthetic import shapes, texture
from slimsfm.synthetic.objects import OBJECTS
from slimsfm.synthetic.render import Light, Scene
from slimsfm.synthetic.scene import EVENING, Take, eyes, look_at, phone_camera

PHOTOS = ("plush", "fox", "lund")
OFFICE, FLAT = "office", "flat"
NAMES = (*PHOTOS, OFFICE, FLAT, *sorted(OBJECTS))
"""Names of all scenes."""

_WIDTH, _HEIGHT, _SEED = 640, 480, 0
_PLANE, _THICKNESS = 1.2, 0.02  # edge of the flat scene and the height of its box, in meters
_FLAT_FRAMES = {"mapping": 36, "query": 24}
_QUERY_EVERY = 3
_CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class MappedScene:
    """A full and a slim map, and queries that are in neither."""

    name: str
    """Name of the scene, one of `NAMES`."""

    full: Map
    """The map of all references."""

    slim: Map
    """What `reduce` makes of it by default."""

    queries: list[PosedQuery]
    """All queries, with true cameras and poses."""

    folder: Path
    """Folder for everything that is stored of the scene."""


def mapped_scene(name: str, photos: Path, output: Path, extractor: str = "sift") -> MappedScene:
    """One scene; existing files in the output folder are reused.

    Args:
        name: One of `NAMES`.
        photos: Folder with the folders of photos.
        output: Folder for maps and renderings.
        extractor: Name of the extractor of the maps; other ones than SIFT have their own folder for them.
    """
    folder = output if extractor == "sift" else output / extractor
    with quiet():
        made = sequences(name, photos, output)
        full, slim = folder / f"{name}-map", folder / f"{name}-slim"
        if not full.exists():
            write_map(_mapped(name, made, BuildOptions(extractor=extractor)), full)
        if not slim.exists():
            write_map(reduce(read_map(full)).map, slim)
    return MappedScene(
        name=name,
        full=read_map(full),
        slim=read_map(slim),
        queries=queries_of(made.query),
        folder=folder / "disturbed" / name,
    )


def sequences(name: str, photos: Path, output: Path) -> ObjectSequences:
    """References and queries of a scene with their true poses."""
    if name in PHOTOS:
        return Images(path=photos / name).load(name, LoadOptions(folder=output / name, progress=shown))
    if name == OFFICE:
        return _office(photos / OFFICE)
    if name == FLAT:
        return _flat(output / "objects" / FLAT)
    return Synthetic(path=output / "objects").load(name, LoadOptions(folder=output, progress=shown))


def _mapped(name: str, made: ObjectSequences, options: BuildOptions) -> Map:
    with tempfile.TemporaryDirectory() as workspace:
        full = map_object(made, Path(workspace), options, progress=shown)
        if name == OFFICE:  # a room has no box of its own
            full = replace(full, info=replace(full.info, box=estimate_box(full.model)))
        write_map(full, Path(workspace) / "map")
        return read_map(Path(workspace) / "map")


def _office(folder: Path) -> ObjectSequences:
    """Frames of a device that knows its poses in meters, every third a query."""
    listed = json.loads((folder / "transforms.json").read_text())
    params = [listed["fl_x"], listed["fl_y"], listed["cx"] + 0.5, listed["cy"] + 0.5]
    camera = pycolmap.Camera(model="PINHOLE", width=listed["w"], height=listed["h"], params=params)
    poses = {}
    for frame in listed["frames"]:
        cv_from_world = _CV_FROM_GL @ np.linalg.inv(np.array(frame["transform_matrix"]))
        poses[frame["file_path"]] = pycolmap.Rigid3d(cv_from_world[:3])
    queries = set(query_names(list(poses), _QUERY_EVERY))
    split = [[one for one in sorted(poses) if (one in queries) is held] for held in (False, True)]
    mapping, query = (
        PosedSequence(
            folder=folder,
            names=tuple(names),
            cameras=(camera,) * len(names),
            cam_from_world=tuple(poses[one] for one in names),
        )
        for names in split
    )
    return ObjectSequences(name=OFFICE, mapping=mapping, query=query, box=Box(np.zeros(3), np.eye(3)))


def _flat(folder: Path) -> ObjectSequences:
    """A printed plane in OnePose's layout, rendered if it is not there."""
    if not folder.exists():
        with replacing(folder, overwrite=False) as partial:
            onepose.write_box(partial, Box(np.zeros(3), np.diag([_PLANE, _PLANE, _THICKNESS]) / 2))
            for number, kind in enumerate(_FLAT_FRAMES, start=1):
                take, sequence = flat_take(kind), partial / f"{FLAT}-{number}"
                onepose.write_annotation(sequence, take.camera, take.cam_from_object)
                for index in shown(range(len(take.cam_from_object)), f"rendering {FLAT}"):
                    image = PilImage.fromarray(take.frame(index))
                    image.save(onepose.image_path(sequence, index), compress_level=1)
    return onepose.read_object(folder)


def flat_take(kind: str) -> Take:
    """A printed plane from above: every fourth view is nearly frontal, the others 20 to 45 degrees off."""
    frames, is_query = _FLAT_FRAMES[kind], kind == "query"
    print_ = texture.page(np.random.default_rng((_SEED, 7)), 2400, 2400, cell=200)
    key = (_SEED, 7, int(is_query))
    rng = np.random.default_rng(key)
    tilts_deg = np.where(np.arange(frames) % 4 == 0, rng.uniform(2, 8, frames), rng.uniform(20, 45, frames))
    azimuths = 2 * np.pi * (np.arange(frames) * (5**0.5 - 1) / 2 % 1) + 0.2 * is_query
    radii = rng.uniform(0.9, 1.3, frames)
    places = eyes(azimuths, np.radians(90 - tilts_deg), radii)
    targets = np.concatenate([rng.uniform(-0.15, 0.15, (frames, 2)), np.zeros((frames, 1))], axis=1)
    return Take(
        scene=Scene([shapes.ground(_PLANE, print_, 0.0)], EVENING if is_query else Light()),
        camera=phone_camera(_WIDTH, _HEIGHT, 0.02 if is_query else 0.0),
        cam_from_object=tuple(look_at(*one) for one in zip(places, targets, strict=True)),
        seed=key,
    )
