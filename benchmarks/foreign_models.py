"""Import the models, databases and features that other tools and slips leave, and show what becomes of each.

    python benchmarks/foreign_models.py [PHOTOS] [--only WORDS]

COLMAP reconstructs the photos; without any, nine frames of an object are rendered through a distorting lens.
Each row changes a copy of that project in one way and imports it. The columns say what `import` answered, how
many of three photos its map localizes within 5 % of the box, and whether all files of the copy have the bytes
and times that they had before.
"""

import argparse
import hashlib
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import closing, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
from PIL import Image

from slimsfm.cli import run
from slimsfm.features import unit_rows
from slimsfm.features.store import stored_name
from slimsfm.geometry import corner_error
from slimsfm.localization import Localizer
from slimsfm.mapping.io import read_map
from slimsfm.photos import list_images, read_image
from slimsfm.synthetic.scene import mapping_take

DISTORTION = -0.12
SIZE, NUM_FRAMES = (640, 480), 9
Arguments = list[str | Path]


class Project:
    """A COLMAP project in a folder: images, database.db, sparse/0, and hloc's files of the same features."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.images, self.database = folder, folder / "images", folder / "database.db"
        self.sparse, self.features, self.matches = (
            folder / name for name in ("sparse/0", "feats.h5", "matches.h5")
        )

    @property
    def model(self) -> pycolmap.Reconstruction:
        """A fresh copy of the model."""
        return pycolmap.Reconstruction(self.sparse)

    @property
    def names(self) -> list[str]:
        """Names of the images with a pose."""
        model = self.model
        return sorted(model.image(i).name for i in model.reg_image_ids())

    def write(self, model: pycolmap.Reconstruction, form: str = "binary") -> None:
        """Replace the model."""
        shutil.rmtree(self.sparse)
        self.sparse.mkdir()
        (model.write_text if form == "text" else model.write_binary)(self.sparse)

    def execute(self, *commands: str) -> None:
        """Run SQL on the database."""
        with closing(sqlite3.connect(self.database)) as database:
            for command in commands:
                database.execute(command)
            database.commit()

    @property
    def hloc(self) -> Arguments:
        """Options to import hloc's files."""
        return ["--features", self.features, "--matches", self.matches]


CASES: dict[str, Callable[[Project], Arguments | None]] = {}


def case(name: str) -> Callable[[Callable[[Project], Arguments | None]], None]:
    """Register a change of the project; it returns options of `import`, if any."""

    def register(change: Callable[[Project], Arguments | None]) -> None:
        CASES[name] = change

    return register


def keypoints_of(image: pycolmap.Image) -> np.ndarray:
    """Positions of the keypoints of an image."""
    return np.array([point.xy for point in image.points2D], np.float64).reshape(-1, 2)


def move_keypoints(model: pycolmap.Reconstruction, move: Callable[[np.ndarray], np.ndarray]) -> None:
    """Move all keypoints of a model."""
    for image in model.images.values():
        for point, xy in zip(image.points2D, move(keypoints_of(image)), strict=True):
            point.xy = xy


def undistorted(project: Project) -> pycolmap.Reconstruction:
    """The model as COLMAP's image_undistorter writes it, and its images."""
    pycolmap.undistort_images(project.folder / "dense", project.sparse, project.images)
    return pycolmap.Reconstruction(project.folder / "dense" / "sparse")


@case("as COLMAP wrote it")
def _(project: Project) -> None: ...


@case("as text")
def _(project: Project) -> None:
    project.write(project.model, "text")


@case("as text with a byte order mark")
def _(project: Project) -> None:
    project.write(project.model, "text")
    for path in project.sparse.glob("*.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())


@case("from before rigs and frames")
def _(project: Project) -> None:
    for name in ("rigs.bin", "frames.bin"):
        (project.sparse / name).unlink()


@case("a database from before descriptor types")
def _(project: Project) -> None:
    project.execute("ALTER TABLE descriptors DROP COLUMN type", "PRAGMA user_version = 3700")


@case("a database whose last changes are in a journal")
def _(project: Project) -> None:
    copy = project.folder / "copy"
    copy.mkdir()
    with closing(sqlite3.connect(project.database)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("UPDATE images SET name = name")
        database.commit()
        for path in project.folder.glob("database.db*"):
            shutil.copy(path, copy)
    for path in project.folder.glob("database.db*"):
        path.unlink()
    for path in copy.iterdir():
        if not path.name.endswith("-shm"):
            shutil.move(path, project.folder)
    shutil.rmtree(copy)


@case("files and folders that are read-only")
def _(project: Project) -> None:
    for path in project.folder.rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)


@case("keypoints in another order")
def _(project: Project) -> None:
    rng = np.random.default_rng(0)
    with closing(sqlite3.connect(project.database)) as database:
        for image_id, rows, columns, data in list(database.execute("SELECT * FROM keypoints")):
            order = rng.permutation(rows)
            shuffled = np.frombuffer(data, np.float32).reshape(rows, columns)[order].tobytes()
            database.execute("UPDATE keypoints SET data = ? WHERE image_id = ?", (shuffled, image_id))
        database.commit()


@case("two images swapped in the database")
def _(project: Project) -> None:
    one, other = project.names[1:3]
    swap = "UPDATE images SET name = '{}' WHERE name = '{}'"
    project.execute(swap.format("x", one), swap.format(one, other), swap.format(other, "x"))


@case("descriptors of one image in another order")
def _(project: Project) -> None:
    with closing(sqlite3.connect(project.database)) as database:
        one = "WHERE image_id = (SELECT image_id FROM images WHERE name = ?)"
        name = project.names[2]
        rows, columns, data = database.execute(
            f"SELECT rows, cols, data FROM descriptors {one}", (name,)
        ).fetchone()
        turned = np.frombuffer(data, np.uint8).reshape(rows, columns)[::-1].tobytes()
        database.execute(f"UPDATE descriptors SET data = ? {one}", (turned, name))
        database.commit()


@case("an undistorted model beside the database of the photos")
def _(project: Project) -> None:
    project.write(undistorted(project))


@case("undistorted cameras with the keypoints of the photos")
def _(project: Project) -> None:
    model, original = undistorted(project), project.model
    for image_id, image in model.images.items():
        for point, old in zip(image.points2D, original.image(image_id).points2D, strict=True):
            point.xy = old.xy
    project.write(model)


@case("a model of images of half the size")
def _(project: Project) -> None:
    model = project.model
    for camera in model.cameras.values():
        camera.rescale(0.5)
    move_keypoints(model, lambda pixels: pixels / 2)
    project.write(model)


@case("keypoints rounded down to whole pixels")
def _(project: Project) -> None:
    model = project.model
    move_keypoints(model, np.floor)
    project.write(model)


@case("keypoints with the origin half a pixel away")
def _(project: Project) -> None:
    model = project.model
    move_keypoints(model, lambda pixels: pixels - 0.5)
    project.write(model)


@case("keypoints that are not a number")
def _(project: Project) -> None:
    model = project.model
    for image in model.images.values():
        for point in list(image.points2D)[::9]:
            if not point.has_point3D():
                point.xy = np.full(2, np.nan)
    project.write(model)


@case("a quaternion of length zero")
def _(project: Project) -> None:
    project.write(project.model, "text")
    path = project.sparse / "frames.txt"
    lines = path.read_text().split("\n")
    row = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    words = lines[row].split(" ")
    lines[row] = " ".join([*words[:2], "0", "0", "0", "0", *words[6:]])
    path.write_text("\n".join(lines))


@case("a spherical camera")
def _(project: Project) -> None:
    project.write(project.model, "text")
    path = project.sparse / "cameras.txt"
    camera = next(iter(project.model.cameras.values()))
    path.write_text(f"1 EQUIRECTANGULAR {camera.width} {camera.height} {camera.width} {camera.height}\n")


@case("points that no image observes")
def _(project: Project) -> None:
    model = project.model
    bare = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        bare.add_camera_with_trivial_rig(camera)
    for image in model.images.values():
        copy = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        bare.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in model.points3D.values():
        bare.add_point3D(point.xyz, pycolmap.Track(), point.color)
    project.write(bare)


@case("an image without descriptors in the database")
def _(project: Project) -> None:
    name = project.names[0]
    project.execute(
        f"DELETE FROM descriptors WHERE image_id = (SELECT image_id FROM images WHERE name = '{name}')"
    )


@case("described from the images")
def _(project: Project) -> Arguments:
    return ["--images", project.images]


def resized(project: Project, factor: float) -> Arguments:
    """A folder of resized images."""
    folder = project.folder / "resized"
    for name in project.names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = read_image(project.images / name)
        size = round(pixels.shape[1] * factor), round(pixels.shape[0] * factor)
        Image.fromarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)).save(
            folder / name, quality=95
        )
    return ["--images", folder]


@case("images of half the size")
def _(project: Project) -> Arguments:
    return resized(project, 0.5)


@case("images of a quarter of the size")
def _(project: Project) -> Arguments:
    return resized(project, 0.25)


@case("images of twice the size")
def _(project: Project) -> Arguments:
    return resized(project, 2)


@case("images cut to other proportions")
def _(project: Project) -> Arguments:
    for name in project.names:
        Image.fromarray(read_image(project.images / name)[20:]).save(project.images / name)
    return ["--images", project.images]


@case("two photos swapped")
def _(project: Project) -> Arguments:
    one, other = (project.images / name for name in project.names[1:3])
    first = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(first)
    return ["--images", project.images]


@case("every third photo turned")
def _(project: Project) -> Arguments:
    for name in project.names[::3]:
        Image.fromarray(read_image(project.images / name)[::-1, ::-1]).save(project.images / name, quality=95)
    return ["--images", project.images]


@case("hloc's files")
def _(project: Project) -> Arguments:
    return project.hloc


@case("hloc's files with old names of pairs")
def _(project: Project) -> Arguments:
    with h5py.File(project.matches, "r+") as file:
        for one in list(file):
            for other in list(file[one]):
                file.move(f"{one}/{other}", f"{one}_{other}")
            del file[one]
    return project.hloc


@case("hloc's features as matches")
def _(project: Project) -> Arguments:
    return ["--features", project.features, "--matches", project.features]


@case("hloc's matches of other images")
def _(project: Project) -> Arguments:
    with h5py.File(project.matches, "r+") as file:
        for one in list(file):
            file.move(one, f"other {one}")
    return project.hloc


@case("a descriptor that is not a number")
def _(project: Project) -> Arguments:
    with h5py.File(project.features, "r+") as file:
        file[project.names[0]]["descriptors"][5, 7] = np.nan
        file[project.names[1]]["keypoints"][7] = np.nan
    return project.hloc


def resize_descriptors(project: Project, length: int) -> Arguments:
    """Descriptors of another length."""
    with h5py.File(project.features, "r+") as file:
        for name in project.names:
            rows = np.resize(file[name]["descriptors"][()], (length, file[name]["descriptors"].shape[1]))
            del file[name]["descriptors"]
            file[name]["descriptors"] = rows
    return project.hloc


@case("descriptors of 64 values")
def _(project: Project) -> Arguments:
    return resize_descriptors(project, 64)


@case("descriptors of 256 values")
def _(project: Project) -> Arguments:
    return resize_descriptors(project, 256)


@case("an unknown extractor")
def _(project: Project) -> Arguments:
    return [*project.hloc, "--extractor", "nobody"]


def rename(project: Project, change: Callable[[str], str]) -> Arguments:
    """Rename the images in the model and the features."""
    model = project.model
    with h5py.File(project.features, "r+") as file:
        for image in model.images.values():
            if stored_name(change(image.name)) != image.name:
                file.move(image.name, change(image.name))
            image.name = change(image.name)
    project.write(model)
    return ["--features", project.features]


@case("names that start with a slash")
def _(project: Project) -> Arguments:
    return rename(project, lambda name: f"/abs/{name}")


@case("names that start with a dot")
def _(project: Project) -> Arguments:
    return rename(project, lambda name: f"./{name}")


@case("names with two slashes")
def _(project: Project) -> Arguments:
    return rename(project, lambda name: f"a//{name}")


def make_project(photos: Path | None, folder: Path) -> Project:
    """Reconstruct photos by COLMAP, or a rendered object from its known poses, and write hloc's files."""
    project, known = Project(folder), {}
    project.images.mkdir(parents=True)
    if photos:
        for name in list_images(photos):
            (project.images / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(photos / name, project.images / name)
    else:
        known = render(project.images)
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = 3000
    pycolmap.extract_features(
        project.database, project.images, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=options
    )
    pycolmap.match_exhaustive(project.database)
    project.sparse.mkdir(parents=True)
    if known:
        model = triangulated(project, known)
    else:
        models = pycolmap.incremental_mapping(project.database, project.images, folder / "sfm")
        model = max(models.values(), key=lambda one: one.num_reg_images())
        shutil.rmtree(folder / "sfm")
    model.write_binary(project.sparse)
    write_hloc_files(project)
    return project


def render(folder: Path) -> dict[str, pycolmap.Rigid3d]:
    """Render frames of an object through a lens with barrel distortion; returns the poses."""
    take = mapping_take("printed_box", 80, *SIZE, 0)
    ideal, lens = take.camera.calibration_matrix(), np.array([DISTORTION, 0, 0, 0])
    centers = np.stack(np.meshgrid(*(np.arange(side) + 0.5 for side in SIZE)), axis=-1)
    seen = cv2.undistortPoints(centers.reshape(-1, 1, 2), ideal, lens, P=ideal).reshape(centers.shape) - 0.5
    poses = {}
    for i, pose in enumerate(take.cam_from_object[:NUM_FRAMES]):
        frame = cv2.remap(take.frame(i), seen.astype(np.float32), None, cv2.INTER_CUBIC)
        poses[f"{i:02d}.png"] = pose
        Image.fromarray(frame).save(folder / f"{i:02d}.png", compress_level=1)
    return poses


def triangulated(project: Project, poses: dict[str, pycolmap.Rigid3d]) -> pycolmap.Reconstruction:
    """A model of known poses, with the points of the database's matches."""
    focal = mapping_take("printed_box", 80, *SIZE, 0).camera.mean_focal_length()
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL",
        width=SIZE[0],
        height=SIZE[1],
        params=[focal, SIZE[0] / 2, SIZE[1] / 2, DISTORTION],
        camera_id=1,
    )
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    with pycolmap.Database.open(project.database) as database:
        database.update_camera(camera)
        for image in database.read_all_images():
            keypoints = np.asarray(database.read_keypoints(image.image_id), np.float64)[:, :2]
            posed = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=1, image_id=image.image_id)
            model.add_image_with_trivial_frame(posed, poses[image.name])
    return pycolmap.triangulate_points(model, project.database, project.images, project.sparse)


def write_hloc_files(project: Project) -> None:
    """Write the features and verified matches of the database as hloc does."""
    with pycolmap.Database.open(project.database) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        with h5py.File(project.features, "w") as file:
            for image_id, name in names.items():
                descriptors = unit_rows(np.asarray(database.read_descriptors(image_id).data))
                file[f"{name}/keypoints"] = np.asarray(database.read_keypoints(image_id))[:, :2] - 0.5
                file[f"{name}/descriptors"] = descriptors.T.astype(np.float16)
        pair_ids, geometries = database.read_two_view_geometries()
        with h5py.File(project.matches, "w") as file:
            for pair_id, geometry in zip(pair_ids, geometries, strict=True):
                one, other = (names[i] for i in pycolmap.pair_id_to_image_pair(pair_id))
                targets = np.full(database.num_keypoints_for_image(ids_of(names)[one]), -1, np.int32)
                pairs = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
                targets[pairs[:, 0]] = pairs[:, 1]
                file[f"{one.replace('/', '-')}/{other.replace('/', '-')}/matches0"] = targets


def ids_of(names: dict[int, str]) -> dict[str, int]:
    """Image ids by name."""
    return {name: image_id for image_id, name in names.items()}


def state(folder: Path) -> dict[str, tuple[int, str]]:
    """Time and checksum of all files and folders."""
    return {
        str(path): (
            path.stat().st_mtime_ns,
            hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "",
        )
        for path in sorted(folder.rglob("*"))
    }


def answer(project: Project, options: Arguments | None, output: Path) -> str:
    """What `slimsfm import` prints, in short."""
    arguments = ["import", project.sparse, "-o", output, *(options or [])]
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        code = run([str(one) for one in arguments])
    lines = [line for text in (out, err) for line in text.getvalue().splitlines()]
    told = [line for line in lines if line.startswith(("note: ", "slimsfm: "))]
    short = " | ".join(told).replace(f"{project.folder}/", "").replace("slimsfm: ", "")
    return f"code {code}: {short[:400] or 'ok'}"


def localized(path: Path, truth: pycolmap.Reconstruction, images: Path) -> str:
    """How many of three photos the map localizes where the model has them."""
    if not path.exists():
        return "-"
    map_, found = read_map(path), 0
    localizer = Localizer(map_)
    queries = sorted(truth.images.values(), key=lambda image: image.name)[:3]
    for image in queries:
        pose = localizer.localize(read_image(images / image.name), image.camera).pose
        found += (
            pose is not None and corner_error(pose.cam_from_world, image.cam_from_world(), map_.box) < 0.05
        )
    return f"{found} of {len(queries)}"


def main() -> None:
    """Run all cases and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", type=Path, nargs="?")
    parser.add_argument("--only", default="", help="run the cases whose names contain these words")
    parsed = parser.parse_args()
    pycolmap.logging.minloglevel = 3
    with tempfile.TemporaryDirectory() as temporary:
        base = make_project(parsed.photos, Path(temporary) / "base")
        truth = base.model
        print(
            f"{len(base.names)} images, {truth.num_points3D()} points, {next(iter(truth.cameras.values()))}\n"
        )
        print("| input | import | localized | files unchanged |\n|---|---|---|---|")
        for name, change in CASES.items():
            if parsed.only in name:
                project = Project(Path(temporary) / "project")
                shutil.copytree(base.folder, project.folder)
                options, output = change(project), Path(temporary) / "map"
                before = state(project.folder)
                told = answer(project, options, output)
                same = "yes" if state(project.folder) == before else "NO"
                print(f"| {name} | {told} | {localized(output, truth, base.images)} | {same} |", flush=True)
                shutil.rmtree(output, ignore_errors=True)
                shutil.rmtree(project.folder)


if __name__ == "__main__":
    main()
