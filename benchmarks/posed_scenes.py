"""Scenes whose images have known poses, in nerfstudio's layout: a `transforms.json` beside the images.

    python benchmarks/posed_scenes.py FOLDER -o OUT

Maps the images that are no queries by triangulation from their poses, stores the map in OUT/NAME-full and
what `reduce` makes of it by default in OUT/NAME-slim, and prints the scores of both.
"""

import argparse
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pycolmap

from benchmark_scenes import Scene
from slimsfm.cli.output import quiet
from slimsfm.datasets.base import PosedSequence
from slimsfm.datasets.reconstructed import query_names
from slimsfm.evaluation.results import evaluate, prepare_queries, queries_of
from slimsfm.evaluation.scores import score
from slimsfm.files import contents_of, read_json
from slimsfm.geometry import Box
from slimsfm.mapping import KnownPoses, Map, build_map, read_map, write_map
from slimsfm.mapping.io import bytes_by_part
from slimsfm.mapping.model import estimate_box
from slimsfm.progress import shown
from slimsfm.reduction import reduce

_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])  # axes of the camera: y and z point the other way
_HALF_PIXEL = 0.5  # from the center of the top-left pixel at (0, 0) to COLMAP's convention
_QUERY_EVERY = 3


def posed(folder: Path, output: Path) -> Scene:
    """Map a folder from its known poses; every third image by name, starting with the first, is a query.

    The map is stored in the output folder, where the next call reads it.
    """
    mapping, query = split(folder)
    path = output / f"{folder.resolve().name}-full"
    if not path.exists():
        with quiet(), tempfile.TemporaryDirectory() as workspace:
            write_map(_triangulated(mapping, Path(workspace)), path)
    references = read_map(path)
    queries = prepare_queries(references, queries_of(query))
    return Scene(
        name=folder.resolve().name,
        references=references,
        bytes=bytes_by_part(path)["total"],
        queries=queries,
    )


def split(folder: Path) -> tuple[PosedSequence, PosedSequence]:
    """The images for mapping and the queries, with cameras and poses."""
    camera, poses = read_transforms(folder / "transforms.json")
    queries = set(query_names(list(poses), _QUERY_EVERY))
    kinds = [[name for name in sorted(poses) if (name in queries) is held] for held in (False, True)]
    mapping, query = (
        PosedSequence(
            folder=folder,
            names=tuple(names),
            cameras=(camera,) * len(names),
            cam_from_world=tuple(poses[name] for name in names),
        )
        for names in kinds
    )
    return mapping, query


def read_transforms(path: Path) -> tuple[pycolmap.Camera, dict[str, pycolmap.Rigid3d]]:
    """The camera that all images share, and their poses by file relative to the folder.

    Raises:
        InputError: The file is damaged or has another camera model than PINHOLE.
    """
    with contents_of(path, "must be nerfstudio's, of one PINHOLE camera"):
        data = read_json(path)
        if data["camera_model"] != "PINHOLE":
            raise ValueError(f"its camera model is {data['camera_model']}")
        center = [data["cx"] + _HALF_PIXEL, data["cy"] + _HALF_PIXEL]
        camera = pycolmap.Camera(
            model="PINHOLE",
            width=int(data["w"]),
            height=int(data["h"]),
            params=[data["fl_x"], data["fl_y"], *center],
            camera_id=1,
        )
        poses = {
            frame["file_path"]: _cam_from_world(np.array(frame["transform_matrix"], np.float64))
            for frame in data["frames"]
        }
    return camera, poses


def _cam_from_world(world_from_opengl: np.ndarray) -> pycolmap.Rigid3d:
    rotation = pycolmap.Rotation3d(world_from_opengl[:3, :3] @ _FROM_OPENGL)
    return pycolmap.Rigid3d(rotation, world_from_opengl[:3, 3]).inverse()


def _triangulated(mapping: PosedSequence, workspace: Path) -> Map:
    known = KnownPoses(
        cameras=dict(zip(mapping.names, mapping.cameras, strict=True)),
        cam_from_world=dict(zip(mapping.names, mapping.cam_from_world, strict=True)),
        box=Box(np.zeros(3), np.eye(3)),  # nothing but its own entry depends on it
        unit="metre",
    )
    made = build_map(mapping.folder, known=known, workspace=workspace, progress=shown)
    return replace(made, info=replace(made.info, box=estimate_box(made.model), box_source="estimated"))


def slim(scene: Scene, output: Path) -> Map:
    """What `reduce` makes of a scene's map by default, stored in the output folder."""
    path = output / f"{scene.name}-slim"
    if not path.exists():
        with quiet():
            write_map(reduce(scene.references, progress=shown).map, path)
    return read_map(path)


def main() -> None:
    """Map, reduce, localize and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", required=True, type=Path)
    arguments = parser.parse_args()
    scene = posed(arguments.folder, arguments.output)
    for name, references, strategy in (
        ("full", scene.references, "exhaustive"),
        ("full", scene.references, "progressive"),
        ("slim", slim(scene, arguments.output), "direct"),
    ):
        outcomes = evaluate(references, scene.queries, strategy)
        print(scene.name, name, strategy, asdict(score(outcomes, metric=True)))


if __name__ == "__main__":
    main()
