"""Try every EXIF orientation, and focal lengths in EXIF that no lens has, on copies of the same photos.

    python benchmarks/exif_orientation.py [PHOTOS]

PHOTOS defaults to twelve rendered frames of a printed box. Every copy of the folder shows the same pictures,
stored with one EXIF orientation or with several in turn, or with a focal length that is impossible. Of each
copy, the upright map and a COLMAP model of the stored pixels are made. The photo in the middle is a query,
which is stored alike. A table shows the registered images, how far the pose of the query is from that of the
first row, and whether COLMAP undistorts the photos with the exported model: the undistorted pictures must be
those of the first row, turned.

A second table is for every third and every eighth picture held sideways: how far the camera centers are from
those of the map of pictures that are all held alike, if both kinds share a camera, and if they do not because
EXIF says that they are of two devices.
"""

import argparse
import logging
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import numpy as np
import pycolmap
from PIL import ExifTags, Image

from slimsfm.errors import SlimsfmError
from slimsfm.geometry import corner_error
from slimsfm.image_files import list_images
from slimsfm.localization import LocalizationOptions, Localizer, localize_images
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.importing import import_colmap
from slimsfm.mapping.map import Map
from slimsfm.mapping.orientation import stored_model, turned_pose
from slimsfm.photos import as_stored, read_image
from slimsfm.synthetic.scene import mapping_take

Pictures = dict[str, np.ndarray]

_ROTATED, _MIRRORED = (1, 3, 6, 8), (2, 4, 5, 7)
_TURNS = {1: 0, 3: 2, 6: 3, 8: 1}  # from the upright picture to the stored one
_ABSURD = (65535, 0, 1)  # of FocalLengthIn35mmFilm


@dataclass(frozen=True, kw_only=True)
class Copy:
    """How the pictures are stored."""

    label: str
    tags: tuple[int, ...]
    focal_35mm: int | None = None

    def save(self, pictures: Pictures, folder: Path) -> dict[str, int]:
        """Save the pictures; return the EXIF orientation of each."""
        folder.mkdir(parents=True)
        found = dict(zip(pictures, cycle(self.tags), strict=False))
        for name, tag in found.items():
            exif = Image.Exif()
            exif[ExifTags.Base.Orientation] = tag
            if self.focal_35mm is not None:
                exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = self.focal_35mm
            Image.fromarray(as_stored(pictures[name], tag)).save(folder / name, exif=exif)
        return found


COPIES = [
    *(Copy(label=f"orientation {tag}", tags=(tag,)) for tag in range(1, 9)),
    Copy(label="orientations 1, 3, 6, 8 in turn", tags=_ROTATED),
    Copy(label="orientations 2, 4, 5, 7 in turn", tags=_MIRRORED),
    *(Copy(label=f"35 mm focal length {value}", tags=(1,), focal_35mm=value) for value in _ABSURD),
]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photos", type=Path, nargs="?")
    parser.add_argument("--max-images", type=int, default=24, help="use evenly spaced photos")
    parser.add_argument("--max-size", type=int, default=640, help="shrink to this longer side")
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = 3
    logging.disable(logging.WARNING)
    pictures = read_pictures(arguments.photos, arguments.max_images, arguments.max_size)
    with tempfile.TemporaryDirectory() as temporary:
        compare(pictures, Path(temporary) / "orientations")
        compare_cameras(pictures, Path(temporary) / "cameras")


def read_pictures(folder: Path | None, count: int, size: int) -> Pictures:
    """Small upright pictures of one size, or rendered frames."""
    if folder is None:
        take = mapping_take("printed_box", 80, 320, 240, 0)
        return {f"{i:03d}.png": take.frame(i) for i in range(12)}
    names = list_images(folder)
    chosen = names[:: max(1, len(names) // count)]
    found = {}
    for i, name in enumerate(chosen):
        picture = Image.fromarray(read_image(folder / name))
        picture.thumbnail((size, size))
        found[f"{i:03d}.png"] = np.asarray(picture)
    return found


def compare(pictures: Pictures, temporary: Path) -> None:
    """Print a row for each copy, and each way to map it."""
    query = sorted(pictures)[len(pictures) // 2]
    row = "{:<32} {:<9} {:>10} {:>10} {:>12} {:>12}"
    print(row.format("photos", "map", "registered", "query", "COLMAP", "difference"))
    plain: dict[str, tuple[Map, Pictures]] = {}
    for number, copy in enumerate(COPIES):
        folder = temporary / str(number)
        tags = copy.save({name: pictures[name] for name in pictures if name != query}, folder / "photos")
        first = copy.tags[0]
        copy_of_query = Copy(label="", tags=(first,), focal_35mm=copy.focal_35mm)
        copy_of_query.save({query: pictures[query]}, folder / "query")
        for kind in ("upright", "imported"):
            map_ = mapped(kind, folder)
            made = dict(undistorted(stored_model(map_), folder, kind)) if exportable(map_) else {}
            reference, pictures_of_reference = plain.setdefault(kind, (map_, made))
            error = query_error(map_, reference, folder / "query", first if kind == "imported" else 1)
            count = f"{len(map_.images)}/{len(tags)}"
            files, difference = summed_up(made, pictures_of_reference, tags)
            print(row.format(copy.label, kind, count, error, files, difference), flush=True)
            for note in map_.info.notes:
                print(f"    {note.partition(':')[0]}")


def compare_cameras(pictures: Pictures, temporary: Path) -> None:
    """Print what one camera for pictures held upright and sideways gains."""
    row = "{:<24} {:<16} {:>10} {:>16} {:>16}"
    print(row.format("\nheld sideways", " cameras", "registered", "all, median", "sideways"))
    alike = sideways_map(pictures, 0, "", temporary / "alike")
    for every in (3, 8):
        for cameras, make in (("one", ""), ("two", "another")):
            map_ = sideways_map(pictures, every, make, temporary / f"{every}-{cameras}")
            found = center_errors(map_, alike)
            of_turned = [found[name] for name in list(pictures)[1::every] if name in found]
            medians = [f"{np.median(errors):.5f} d" for errors in (list(found.values()), of_turned)]
            print(row.format(f"1 in {every}", cameras, f"{len(map_.images)}/{len(pictures)}", *medians))


def sideways_map(pictures: Pictures, every: int, make: str, folder: Path) -> Map:
    """The map of pictures of which every n-th, if any, is held sideways and of a camera of this make."""
    folder.mkdir(parents=True)
    for i, (name, picture) in enumerate(pictures.items()):
        exif = Image.Exif()
        turned = every and i % every == 1
        if turned and make:
            exif[ExifTags.Base.Make] = make
        Image.fromarray(as_stored(picture, 6 if turned else 1)).save(folder / name, exif=exif)
    return build_map(folder)


def center_errors(map_: Map, reference: Map) -> dict[str, float]:
    """Distances of the camera centers from those of the reference after alignment, over its diagonal."""
    names = [name for name in map_.images if name in reference.images]
    found, expected = (
        np.array([one.images[name].projection_center() for name in names]) for one in (map_, reference)
    )
    aligned = pycolmap.estimate_sim3d(found, expected)
    errors = np.linalg.norm(aligned * found - expected, axis=1) / reference.box.diagonal
    return dict(zip(names, errors.tolist(), strict=True))


def mapped(kind: str, folder: Path) -> Map:
    """The upright map of the photos, or the import of a COLMAP model of their stored pixels."""
    if kind == "upright":
        return build_map(folder / "photos")
    model = folder / "sparse"
    model.mkdir()
    build_map(folder / "photos", BuildOptions(orientation="stored")).model.write(model)
    return import_colmap(model, folder / "photos")


def exportable(map_: Map) -> bool:
    """Whether the stored pixels of any image are a rotation of its picture."""
    try:
        stored_model(map_)
    except SlimsfmError:
        return False
    return True


def undistorted(model: pycolmap.Reconstruction, folder: Path, kind: str) -> Iterator[tuple[str, np.ndarray]]:
    """The pictures that COLMAP makes of a model and the photos, as they are stored."""
    source, target = folder / f"{kind}-model", folder / f"{kind}-undistorted"
    source.mkdir()
    model.write(source)
    pycolmap.undistort_images(target, source, folder / "photos")
    for path in sorted((target / "images").iterdir()):
        yield path.name, read_image(path, "stored")


def query_error(map_: Map, reference: Map, folder: Path, tag: int) -> str:
    """Distance of the query's pose from the reference's, over the diagonal; poses are compared upright."""
    if tag in _MIRRORED:
        return "mirrored"
    options = LocalizationOptions(focal="unknown", min_confidence=0)
    (found,) = localize_images(Localizer(map_, options), folder).values()
    first = folder.parent.parent / "0" / "query"
    (expected,) = localize_images(Localizer(reference, options), first).values()
    if found.pose is None or expected.pose is None:
        return "not found"
    upright = turned_pose(found.pose.cam_from_world, -_TURNS[tag])
    aligned = pycolmap.align_reconstructions_via_proj_centers(map_.model, reference.model, 0.1)
    if aligned is None:
        return "unaligned"
    moved = aligned.transform_camera_world(upright)
    return f"{corner_error(moved, expected.pose.cam_from_world, reference.box):.4f} d"


def summed_up(made: Pictures, expected: Pictures, tags: Mapping[str, int]) -> tuple[str, str]:
    """How many photos COLMAP undistorted, and the mean difference to the pictures of the first row."""
    if not made:
        return "mirrored", ""
    differences = []
    for name, picture in made.items():
        turned = as_stored(expected[name], tags[name])
        height, width = (min(a, b) for a, b in zip(turned.shape[:2], picture.shape[:2], strict=True))
        cut = [_center(one, height, width).astype(int) for one in (turned, picture)]
        differences.append(np.abs(cut[0] - cut[1]).mean())
    return f"{len(made)}/{len(tags)}", f"{np.mean(differences):.1f} of 255"


def _center(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """The middle of a picture: models of other keypoints give other margins."""
    top, left = (picture.shape[0] - height) // 2, (picture.shape[1] - width) // 2
    return picture[top : top + height, left : left + width]


if __name__ == "__main__":
    main()
