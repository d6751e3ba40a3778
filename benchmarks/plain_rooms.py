"""Rendered rooms with repeating carpet, mapped by plain pycolmap, and which poses are really wrong."""

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image as PilImage

from deception import patterned_room
from lookalikes import repeating_room
from slimsfm.cli.output import quiet
from slimsfm.mapping import ImportOptions, Map, import_colmap, read_map, write_map
from slimsfm.progress import shown
from slimsfm.synthetic.scene import Take

FRAMES, WIDTH, HEIGHT, SEED = 60, 640, 480, 0
ROOMS = {"patterned_room": patterned_room, "repeating_room": repeating_room}
"""Takes of rooms."""

_RIGHT_DEG, _RIGHT = 5.0, 0.05  # largest errors of a right pose; of the position, over the spread of cameras
_TRIPLES = 3000  # alignments that are tried


@dataclass(frozen=True, kw_only=True)
class PlainRoom:
    """A map of a room."""

    map: Map
    """By plain pycolmap: SIFT, all pairs, incremental mapping of one camera, the largest model."""

    wrong: frozenset[str]
    """Images that are really wrong: outside of the largest set that one similarity aligns with the truth."""

    take: Take
    """The rendered photos with their true poses."""

    @property
    def true_poses(self) -> dict[str, pycolmap.Rigid3d]:
        """Where the images of the map really stand."""
        return {name: self.take.cam_from_object[int(name[5:8])] for name in self.map.images}


def plain_room(name: str, output: Path) -> PlainRoom:
    """Render and map a room; existing files in the output folder are reused."""
    take = ROOMS[name](FRAMES, WIDTH, HEIGHT, SEED)
    folder, path = output / name / "images", output / name / "map"
    folder.mkdir(parents=True, exist_ok=True)
    for index in shown(range(FRAMES), f"render {name}"):
        if not (folder / f"frame{index:03d}.png").exists():
            PilImage.fromarray(take.frame(index)).save(folder / f"frame{index:03d}.png", compress_level=1)
    if not path.exists():
        write_map(_mapped(folder, output / name), path)
    made = read_map(path)
    return PlainRoom(map=made, wrong=really_wrong(made, take), take=take)


def _mapped(images: Path, folder: Path) -> Map:
    database = folder / "database.db"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features, extraction.sift.first_octave = 2048, 0
    with quiet():
        pycolmap.extract_features(
            database, images, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=extraction
        )
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, images, folder)
    best = max(models, key=lambda i: models[i].num_reg_images())
    return import_colmap(folder / str(best), options=ImportOptions(database=database))


def really_wrong(map: Map, take: Take) -> frozenset[str]:
    """The images outside of the largest set that one similarity aligns with the true poses."""
    names = list(map.images)
    true = [take.cam_from_object[int(name[5:8])] for name in names]
    true_centers = np.array([pose.inverse().translation for pose in true])
    poses = [image.cam_from_world() for image in map.images.values()]
    centers = np.array([pose.inverse().translation for pose in poses])
    spread = float(np.linalg.norm(true_centers - np.median(true_centers, axis=0), axis=1).max())
    best = np.zeros(len(names), bool)
    triples = list(combinations(range(len(names)), 3))
    for place in np.random.default_rng(SEED).permutation(len(triples))[:_TRIPLES]:
        some = list(triples[place])
        true_from_map = pycolmap.estimate_sim3d(centers[some], true_centers[some])
        if true_from_map is None:
            continue
        near = np.linalg.norm(true_from_map * centers - true_centers, axis=1) < _RIGHT * spread
        turned = [
            np.degrees((one.rotation * true_from_map.rotation * pose.rotation.inverse()).angle())
            for one, pose in zip(true, poses, strict=True)
        ]
        right = near & (np.array(turned) < _RIGHT_DEG)
        best = max(best, right, key=np.sum)
    return frozenset(name for name, one in zip(names, best, strict=True) if not one)
