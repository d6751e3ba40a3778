"""Files of others are only read, and whatever `import` accepts works with every other command."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pycolmap
import pytest

from commands import slimsfm, state
from databases import write_features
from slimsfm.mapping.hloc import write_hloc
from slimsfm.mapping.io import read_map


@dataclass(frozen=True)
class Project:
    """Everything of others that a command may read, in one folder."""

    folder: Path

    def __truediv__(self, name: str) -> Path:
        return self.folder / name


@pytest.fixture(scope="module")
def whole(boulder, tmp_path_factory) -> Project:
    folder = tmp_path_factory.mktemp("foreign") / "project"
    map_ = read_map(boulder.map_path)
    write_hloc(map_, folder)
    (folder / "sparse").mkdir()
    (folder / "sfm").rename(folder / "sparse" / "0")
    shutil.copytree(boulder.photos, folder / "images")
    write_features(folder / "database.db", map_)
    np.savetxt(folder / "box3d_corners.txt", map_.box.corners)
    shutil.copytree(boulder.queries, folder / "queries")
    (folder / "queries.txt").write_text("night.png\nday.png\n")
    camera = map_.shared_camera
    assert camera is not None
    values = " ".join(map(str, camera.params))
    (folder / "camera.txt").write_text(f"1 {camera.model_name} {camera.width} {camera.height} {values}\n")
    (folder / "few").mkdir()
    (folder / "masks").mkdir()
    for path in sorted((folder / "images").iterdir())[:3]:
        shutil.copy(path, folder / "few")
        shutil.copy(path, folder / "masks" / f"{path.name}.png")
    return Project(folder)


@pytest.fixture
def project(whole, tmp_path) -> Project:
    return Project(Path(shutil.copytree(whole.folder, tmp_path / "project")))


READERS = {
    "import, database": ("import", "sparse/0"),
    "import, hloc": ("import", "sparse/0", "--features", "features.h5", "--matches", "matches.h5"),
    "import, images": ("import", "sparse/0", "--images", "images", "--box", "box3d_corners.txt"),
    "build": ("build", "few", "--masks", "masks", "--box", "box3d_corners.txt"),
    "localize": ("localize", "MAP", "queries", "--camera", "camera.txt"),
    "export": ("export", "hloc", "MAP", "--queries", "queries.txt"),
}


@pytest.mark.parametrize("reader", READERS.values(), ids=READERS.keys())
def test_commands_change_no_byte_time_or_folder_of_what_they_read(project, boulder, tmp_path, reader):
    """Also where everything is read-only, which matters to users other than root."""
    paths = sorted(project.folder.rglob("*"), reverse=True)
    for path in [*paths, project.folder]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    before = state(project.folder)
    words = [str(project / word) if (project / word).exists() else word for word in reader]
    output = tmp_path / ("out.json" if reader[0] == "localize" else "out")
    outcome = slimsfm(*[boulder.map_path if word == "MAP" else word for word in words], "-o", output)
    assert state(project.folder) == before
    for path in [project.folder, *reversed(paths)]:
        path.chmod(0o755 if path.is_dir() else 0o644)
    assert outcome.code == 0 or reader[0] == "build", outcome.err  # three photos may be too few for a map


@pytest.mark.parametrize(
    "source", ["database.db", "features.h5", "matches.h5", "images", "box3d_corners.txt", "sparse"]
)
def test_no_output_may_replace_what_an_import_reads(project, source):
    before = state(project.folder)
    options = {
        "database.db": (),
        "images": ("--images", project / "images"),
        "box3d_corners.txt": ("--box", project / "box3d_corners.txt"),
    }.get(source, ("--features", project / "features.h5", "--matches", project / "matches.h5"))
    for output in (project / source, project.folder):
        outcome = slimsfm("import", project / "sparse/0", *options, "-o", output, "--overwrite")
        assert outcome.code == 2
        assert "is or contains the input" in outcome.err
        assert state(project.folder) == before


OPTIONS = {
    "--masks": ("build", "few", "masks"),
    "--box": ("build", "few", "box3d_corners.txt"),
    "--camera": ("localize", "MAP", "camera.txt"),
    "--graph": ("reduce", "MAP", "queries.txt"),
}


@pytest.mark.parametrize("option", OPTIONS)
def test_no_output_may_replace_what_an_option_names(project, boulder, option):
    before = state(project.folder)
    command, first, source = OPTIONS[option]
    arguments = [boulder.map_path if first == "MAP" else project / first]
    if command == "localize":
        arguments.append(project / "queries")
    outcome = slimsfm(command, *arguments, option, project / source, "-o", project / source, "--overwrite")
    assert (outcome.code, "is or contains the input" in outcome.err) == (2, True)
    assert state(project.folder) == before


def damage(project):
    """Unusual names, an image without keypoints, and values that are not finite."""
    model = pycolmap.Reconstruction(project / "sparse/0")
    images = sorted(model.images.values(), key=lambda image: image.name)
    new = [
        f"{start}{image.name}"
        for start, image in zip(["/abs/", "./", "a//", "b/./c/"] * 9, images, strict=False)
    ]
    bare = images[4]
    with h5py.File(project / "features.h5", "r+") as file:
        for name, image in zip(new, images, strict=True):
            if not name.startswith("./"):  # for HDF5, that is no other name
                file.move(image.name, name)
            image.name = name
        file[new[0]]["descriptors"][3, 5] = np.nan
        file[new[1]]["keypoints"][7] = np.inf
    for row in list(bare.get_observation_point2D_idxs()):
        model.delete_observation(bare.image_id, row)
    for image in images[6:9]:
        for point in list(image.points2D)[::7]:
            point.xy = np.full(2, np.nan)
    model.write_text(project / "sparse/0")
    for path in (project / "sparse/0").glob("*.bin"):
        path.unlink()
    path = project / "sparse/0/images.txt"
    lines = path.read_text().split("\n")
    row = next(i for i, line in enumerate(lines) if line.endswith(f" {bare.name}"))
    lines[row + 1] = ""
    path.write_text("\n".join(lines))
    return bare.name


def test_what_import_accepts_works_with_every_command(project, tmp_path):
    bare = damage(project)
    map_, small, poses = tmp_path / "map", tmp_path / "small", tmp_path / "poses.json"

    def works(*arguments):
        outcome = slimsfm(*arguments)
        assert (outcome.err, outcome.code) == ("", 0)
        return outcome.out

    told = works("import", project / "sparse/0", "-o", map_, "--features", project / "features.h5")
    assert f"note: 1 image ({bare!r}) have no keypoints in the model" in told
    assert "in the model have no finite position" in told
    assert "note: features.h5: 2 features of 2 images" in told
    assert "no finite position" in works("info", map_, "--images")
    works("reduce", map_, "-o", small, "--solver", "greedy", "--edges", "tracks")
    for path in (map_, small):
        camera = ("--camera", project / "camera.txt")
        assert "localized in" in works(
            "localize", path, project / "queries", "-o", poses, "--overwrite", *camera
        )
    works("export", "hloc", map_, "-o", tmp_path / "hloc")
    works(
        "import", tmp_path / "hloc/sfm", "-o", tmp_path / "back", "--features", tmp_path / "hloc/features.h5"
    )
    assert read_map(tmp_path / "back").fingerprint == read_map(map_).fingerprint
