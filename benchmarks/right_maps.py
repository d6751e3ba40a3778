"""How often maps are right, against plain pycolmap: on look-alike scenes and on photos as people bring them.

    python benchmarks/right_maps.py -o /tmp/right --photos DIR --other DIR

Renders the look-alike scenes. Makes mixtures, brackets, zooms and others from half of the photos that are
given, with a map of all of them as the truth. Prints, for each scene, how many images are registered, how
many of those are right (rotation within 5 degrees, relative to the other images), and the time.
"""

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter

import numpy as np
import pycolmap
from PIL import Image as PilImage

from hard_photos import MAKERS
from lookalikes import LOOKALIKES
from slimsfm.cli.output import quiet
from slimsfm.errors import SlimsfmError
from slimsfm.image_files import list_images
from slimsfm.mapping import Map, build_map
from slimsfm.progress import shown

FRAMES, WIDTH, HEIGHT, SEED = 60, 640, 480, 0
RIGHT_DEG = 5.0

Rotations = dict[str, pycolmap.Rotation3d]
"""Rotation from the world to the camera, by image name without its suffix."""


def scenes(
    output: Path, photos: Path | None, other: Path | None, more: list[Path]
) -> Iterator[tuple[str, Path, Rotations]]:
    """Name, folder of images and true rotations of each scene; empty if unknown."""
    yield from ((folder.name, folder, {}) for folder in more)
    for name in LOOKALIKES:
        yield name, *_rendered(output / name, name)
    if photos is None or other is None:
        return
    truth = _rotations(build_map(photos, progress=shown))
    yield photos.name, photos, {}
    for name, maker in MAKERS.items():
        folder = output / name
        if not folder.exists():
            for image_name, image in maker(photos, other):
                path = folder / Path(image_name).with_suffix(".png")
                path.parent.mkdir(parents=True, exist_ok=True)
                PilImage.fromarray(image).save(path, compress_level=1)
        yield name, folder, _renamed(truth, folder)


def _rendered(folder: Path, name: str) -> tuple[Path, Rotations]:
    take = LOOKALIKES[name](FRAMES, WIDTH, HEIGHT, SEED)
    if not folder.exists():
        folder.mkdir(parents=True)
        for index in shown(range(FRAMES), f"render {name}"):
            PilImage.fromarray(take.frame(index)).save(folder / f"frame{index:03d}.png", compress_level=1)
    return folder, {f"frame{index:03d}": pose.rotation for index, pose in enumerate(take.cam_from_object)}


def _renamed(truth: Rotations, folder: Path) -> Rotations:
    """The true rotations of the photos in a folder; a bracket adds _NUMBER to the name of its photo."""
    stems = [Path(name).stem for name in list_images(folder)]
    found = {stem: stem if stem in truth else stem.rsplit("_", 1)[0] for stem in stems}
    return {stem: truth[original] for stem, original in found.items() if original in truth}


def count_right(found: Rotations, truth: Rotations) -> int:
    """Number of images whose rotation agrees with the truth, for the best alignment of the two worlds."""
    common = sorted(found.keys() & truth.keys())
    best = 0
    for name in common:
        world = truth[name].inverse() * found[name]
        errors = [np.degrees((truth[one] * world * found[one].inverse()).angle()) for one in common]
        best = max(best, int((np.array(errors) < RIGHT_DEG).sum()))
    return best


def ours(folder: Path) -> tuple[Rotations, str]:
    """Rotations of `build_map`, and what it says of the map."""
    try:
        made = build_map(folder, progress=shown)
    except SlimsfmError as error:
        return {}, f"refused: {error}"
    quality = made.info.quality
    said = [*made.info.notes, *(quality.doubts if quality else ())]
    return _rotations(made), "; ".join(said)


def _rotations(map: Map) -> Rotations:
    return {Path(name).stem: image.cam_from_world().rotation for name, image in map.images.items()}


def plain(folder: Path) -> tuple[Rotations, str]:
    """Rotations of pycolmap with its defaults: SIFT, all pairs, incremental mapping, the largest model."""
    with tempfile.TemporaryDirectory() as work, quiet():
        database = Path(work) / "database.db"
        pycolmap.extract_features(database, folder)
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, folder, work)
    if not models:
        return {}, "no model"
    largest = max(models.values(), key=lambda model: model.num_reg_images())
    images = [largest.image(image_id) for image_id in largest.reg_image_ids()]
    return {Path(image.name).stem: image.cam_from_world().rotation for image in images}, ""


def measured(run: Callable[[Path], tuple[Rotations, str]], folder: Path, truth: Rotations) -> dict:
    """What one way to map a folder gives."""
    start = perf_counter()
    found, said = run(folder)
    seconds = perf_counter() - start
    known = len(found.keys() & truth.keys())
    return {
        "registered": len(found),
        "right": f"{count_right(found, truth)} of {known}" if truth else "",
        "seconds": round(seconds, 1),
        "said": said,
    }


def main() -> None:
    """Print the table, and write it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--photos", type=Path, help="photos of one place")
    parser.add_argument("--other", type=Path, help="photos of another place")
    parser.add_argument("--more", type=Path, nargs="*", default=[], help="further folders, of unknown poses")
    parser.add_argument("--only", nargs="*", help="names of scenes")
    wanted = parser.parse_args()
    rows = {}
    print("| scene | images | pycolmap: registered | right | s | slimsfm: registered | right | s | said |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---|")
    for name, folder, truth in scenes(wanted.output, wanted.photos, wanted.other, wanted.more):
        if wanted.only and name not in wanted.only:
            continue
        a, b = measured(plain, folder, truth), measured(ours, folder, truth)
        rows[name] = {"images": len(list_images(folder)), "pycolmap": a, "slimsfm": b}
        cells = [name, rows[name]["images"], *list(a.values())[:3], *list(b.values())[:3], b["said"][:300]]
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)
        (wanted.output / "right_maps.json").write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
