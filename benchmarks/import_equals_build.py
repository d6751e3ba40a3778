"""Compare poses against imported COLMAP models with poses against the map built from the same photos.

    python benchmarks/import_equals_build.py PHOTOS

Two thirds of the photos are references, the rest queries. The built model is written in each of COLMAP's
formats (old three-file binary, text, new with rigs and frames) with a database, imported, reduced to the same
images as the built map, and localized against. A model of pycolmap's own pipeline, with its own SIFT, is
compared as well, after alignment of the two worlds.
"""

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.geometry import corner_error
from slimsfm.image_files import list_images
from slimsfm.localization import Localizer
from slimsfm.mapping.build import build_map
from slimsfm.mapping.importing import import_colmap
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.photos import read_image
from slimsfm.progress import shown
from slimsfm.reduction import ImageOptions, ReduceOptions, reduce

Poses = dict[str, pycolmap.Rigid3d]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder.absolute()
    pycolmap.logging.minloglevel = 2
    with tempfile.TemporaryDirectory() as temporary:
        compare(folder, Path(temporary))


def compare(folder: Path, temporary: Path) -> None:
    """Build once, import in every format, and print median differences of the query poses."""
    names = list_images(folder)
    queries = names[::3]
    references = temporary / "references"
    references.mkdir()
    for name in set(names) - set(queries):
        os.symlink(folder / name, references / name)
    built = build_map(references, progress=shown)
    options = ReduceOptions(image_choice=ImageOptions(solver="exact"))
    slim = reduce(built, options, progress=shown).map
    cameras = dict.fromkeys(queries, built.shared_camera)
    expected = localize(slim, folder, cameras)
    for form in ("old binary", "text", "rigs and frames"):
        path = write_model(
            built, temporary / "build" / "database.db", temporary / form.replace(" ", "-"), form
        )
        imported = keep_images(import_colmap(path), slim.images)
        print_difference(form, expected, localize(imported, folder, cameras), built)
    path = run_colmap(references, temporary / "colmap")
    imported = import_colmap(path)
    b_from_a = pycolmap.align_reconstructions_via_proj_centers(imported.model, built.model, 0.05)
    kept = keep_images(imported, slim.images)
    found = localize(kept, folder, dict.fromkeys(queries, imported.shared_camera))
    moved = {name: b_from_a.transform_camera_world(pose) for name, pose in found.items()}
    print_difference("pycolmap's own pipeline, aligned", expected, moved, built)


def localize(map_: Map, folder: Path, cameras: dict) -> Poses:
    """Poses of the queries that could be localized."""
    localizer = Localizer(map_)
    found = {
        name: localizer.localize(read_image(folder / name), camera).pose for name, camera in cameras.items()
    }
    return {name: pose.cam_from_world for name, pose in found.items() if pose}


def write_model(built: Map, database: Path, path: Path, form: str) -> Path:
    """Write the built model in one of COLMAP's formats, with a database under the images' own names."""
    path.mkdir()
    (built.model.write_text if form == "text" else built.model.write_binary)(path)
    if form == "old binary":
        for name in ("rigs.bin", "frames.bin"):
            (path / name).unlink()
    (path / "database.db").write_bytes(database.read_bytes())
    with pycolmap.Database.open(path / "database.db") as copy:
        for image in copy.read_all_images():
            image.name = sorted(built.features)[image.image_id - 1]
            copy.update_image(image)
    return path


def run_colmap(images: Path, path: Path) -> Path:
    """Reconstruct with pycolmap alone, with its default SIFT and exhaustive matching."""
    path.mkdir()
    database = path / "database.db"
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = 4096
    pycolmap.extract_features(
        database, images, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=options
    )
    pycolmap.match_exhaustive(database)
    models = pycolmap.incremental_mapping(database, images, path)
    model = max(models.values(), key=lambda one: one.num_reg_images())
    (path / "sparse").mkdir()
    model.write_binary(path / "sparse")
    return path / "sparse"


def print_difference(form: str, expected: Poses, found: Poses, built: Map) -> None:
    """Print the median relative corner distance of the poses that both have."""
    both = sorted(expected.keys() & found.keys())
    distances = [corner_error(expected[name], found[name], built.box) for name in both]
    print(
        f"{form}: {len(found)} localized, {len(expected)} by the built map; "
        f"median difference {100 * np.median(distances):.4f} % of the diagonal (target 0.1)"
    )


if __name__ == "__main__":
    main()
