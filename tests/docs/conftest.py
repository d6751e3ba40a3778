import importlib.util
import json
import shutil
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pycolmap
import pytest
from PIL import Image

from slimsfm.cli.output import quiet
from slimsfm.features.registry import plugins
from slimsfm.mapping.build import build_map
from slimsfm.mapping.hloc import write_hloc
from slimsfm.mapping.io import write_map
from slimsfm.mapping.map import Map
from slimsfm.synthetic.scene import Take, mapping_take
from slimsfm.tracking.video import write_video

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"

FILM, FRAMES = 160, 15  # frames around the object, and how many of them are rendered
FRAMES_PER_SECOND = 4.0  # two frames per second are the photos
NEW = (5, 11)


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders and a video of a rendered object, as the how-to guides need them."""
    pytest.importorskip("av", reason="needs PyAV, which is not installed")
    folder = tmp_path_factory.mktemp("filmed")
    take = mapping_take("printed_box", FILM, 320, 240, seed=0)
    frames = [take.frame(index) for index in range(FRAMES)]
    for name in ("photos", "new", "photos-2"):
        (folder / name).mkdir()
    for index in range(0, FRAMES, 2):
        Image.fromarray(frames[index]).save(folder / "photos" / f"{index:02d}.png")
    for index in range(6, FRAMES):
        Image.fromarray(frames[index]).save(folder / "photos-2" / f"{index:02d}.png")
    for index in NEW:
        Image.fromarray(frames[index]).save(folder / "new" / f"{index:02d}.png")
    with write_video(folder / "video.mp4", FRAMES_PER_SECOND) as write:
        for frame in frames:
            write(frame)
    _write_transforms(folder / "transforms.json", take)
    focal, *center = take.camera.params[1:]
    (folder / "camera.txt").write_text(f"1 PINHOLE 320 240 {focal} {focal} {' '.join(map(str, center))}\n")
    shutil.copytree(ROOT / "examples" / "own_matcher", folder / "own_matcher")
    return folder


def _write_transforms(path: Path, take: Take) -> None:
    """The poses of the photos in nerfstudio's format."""
    matrix = take.camera.calibration_matrix()
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    turned = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = []
    for index in range(0, FRAMES, 2):
        world_from_cam = np.vstack([take.cam_from_object[index].inverse().matrix(), [0, 0, 0, 1]])
        matrix = (world_from_cam @ turned).tolist()
        frames.append({"file_path": f"photos/{index:02d}.png", "transform_matrix": matrix})
    camera = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": 320, "h": 240}
    path.write_text(json.dumps(camera | {"frames": frames}))


@pytest.fixture(scope="session")
def hook() -> Callable[[str], ModuleType]:
    """Loads a hook of the site by the name of its file, as mkdocs does."""

    def load(name: str) -> ModuleType:
        for needed in ("mkdocs", "latex2mathml"):
            pytest.importorskip(needed, reason=f"needs {needed}: pip install 'slimsfm[docs]'")
        spec = importlib.util.spec_from_file_location(name, DOCS / "hooks" / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture(scope="session")
def projects(filmed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files made from the photos: `map`, COLMAP's `project/`, hloc's `outputs/` and `queries.txt`, a box."""
    folder = tmp_path_factory.mktemp("projects")
    with quiet():
        made = build_map(filmed / "photos", workspace=folder / "work")
    write_map(made, folder / "map")
    shutil.copytree(folder / "map" / "sparse", folder / "project" / "sparse" / "0")
    shutil.copytree(filmed / "photos", folder / "project" / "images")
    _write_database(folder / "work" / "database.db", made, folder / "project" / "database.db")
    write_hloc(made, folder / "outputs")
    (folder / "outputs" / "features.h5").rename(folder / "outputs" / "feats-sift.h5")
    camera = (filmed / "camera.txt").read_text().split()[1:]
    lines = [" ".join([path.name, *camera]) for path in sorted((filmed / "new").iterdir())]
    (folder / "queries.txt").write_text("\n".join(lines) + "\n")
    (folder / "positions.csv").write_text(_positions(made))
    corners = [" ".join(f"{value:.6f}" for value in corner) for corner in made.box.corners]
    (folder / "box3d_corners.txt").write_text("\n".join(corners) + "\n")
    return folder


def _positions(made: Map) -> str:
    """The true positions of the images, as a table."""
    path = mapping_take("printed_box", FILM, 320, 240, seed=0).cam_from_object
    places = {name: path[int(Path(name).stem)].inverse().translation for name in made.images}
    lines = [f"{name},{x},{y},{z}" for name, (x, y, z) in places.items()]
    return "\n".join(["name,x,y,z", *lines]) + "\n"


def _write_database(working: Path, made: Map, path: Path) -> None:
    """The database of a map as COLMAP writes it, with the names of the images."""
    working.rename(path)
    names = {image.image_id: name for name, image in made.images.items()}
    with pycolmap.Database.open(path) as database:
        for image in database.read_all_images():
            image.name = names.get(image.image_id, f"left-out-{image.name}")
            database.update_image(image)


@pytest.fixture
def own_matcher(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """What `pip install ./own_matcher` adds next to the module: the entry points of its project file."""
    source = ROOT / "examples" / "own_matcher"
    project = tomllib.loads((source / "pyproject.toml").read_text())["project"]
    metadata = tmp_path / f"own_matcher-{project['version']}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    (offered,) = project["entry-points"]["slimsfm.matchers"].items()
    (metadata / "entry_points.txt").write_text(f"[slimsfm.matchers]\n{' = '.join(offered)}\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), str(source), *sys.path])
    plugins.cache_clear()
    yield
    plugins.cache_clear()
    sys.modules.pop("own_matcher", None)
