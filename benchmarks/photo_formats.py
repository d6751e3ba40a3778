"""Build a small map of the same photos in each format, bit depth, kind of transparency, mask and size.

    python benchmarks/photo_formats.py [PHOTOS] [--count 8] [-o table.json]

Without a folder of photos, a box is rendered. Prints a table with a line per kind of input: images
registered, points, observations on masked pixels, difference of the poses from those of the first line, and
what the map notes. The difference is the largest relative corner error after both maps were aligned. Enlarged
photos are shrunk to the size of the others for extraction. With `pillow-heif` installed, HEIC is tried as
well.
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from PIL import ExifTags, ImageCms
from PIL import Image as PillowImage

from slimsfm.arrays import Image
from slimsfm.errors import SlimsfmError
from slimsfm.files import replacing
from slimsfm.geometry import corner_error
from slimsfm.image_files import can_read_heic, list_images
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.map import Map
from slimsfm.photos import read_image, shrink
from slimsfm.synthetic.scene import mapping_take

SIDE = 1200  # of the photos, unless they are smaller

Write = Callable[[Path, Image], None]
"""Writes a photo to a folder of photos; the path has no suffix."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of input."""

    name: str
    """What it is called in the table."""

    write: Write
    """Writes one photo."""

    hole: bool = False
    """Whether the left third of each photo is masked or transparent."""

    masks: bool = False
    """Whether there is a folder of masks."""

    options: BuildOptions = BuildOptions(camera="shared")
    """How the map is built."""


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", type=Path, nargs="?")
    parser.add_argument("--count", type=int, default=8, help="photos to use, the first in order of name")
    parser.add_argument("-o", "--output", type=Path, help="write the table as JSON")
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = 3
    rows, first = [], None
    print_row(["input", "registered", "points", "masked", "poses", "notes"])
    for kind in kinds():
        with tempfile.TemporaryDirectory() as folder:
            row, made = measure(kind, load(arguments.photos, arguments.count), Path(folder), first)
        first = first or made
        rows.append(row)
        print_row(list(row.values()))
    if arguments.output:
        with replacing(arguments.output, overwrite=True) as partial:
            partial.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def print_row(values: list) -> None:
    """Print a line of the table."""
    widths = (34, 10, 6, 6, 6, 0)
    print("  ".join(f"{value!s:{width}}" for value, width in zip(values, widths, strict=True)), flush=True)


def load(folder: Path | None, count: int) -> dict[str, Image]:
    """Photos by name, without suffix."""
    if folder is None:
        take = mapping_take("printed_box", 80, 640, 480, 0)
        return {f"{i:02d}": take.frame(i) for i in range(count)}
    return {
        f"{i:02d}": shrink(read_image(folder / name), SIDE)
        for i, name in enumerate(list_images(folder)[:count])
    }


def measure(kind: Kind, photos: dict[str, Image], folder: Path, first: Map | None) -> tuple[dict, Map | None]:
    """Build a map of one kind of input; returns a row of the table and the map."""
    (folder / "photos").mkdir()
    for name, photo in photos.items():
        kind.write(folder / "photos" / name, photo)
    masks = folder / "photos" / "masks"
    if masks.is_dir():
        masks = Path(shutil.move(masks, folder / "masks"))
    options = replace(
        kind.options,
        masks=masks if kind.masks else None,
        max_image_size=max(max(photo.shape) for photo in photos.values()),
    )
    row = {"input": kind.name, "registered": 0, "points": 0, "masked": "", "poses": "", "notes": ""}
    try:
        made = build_map(folder / "photos", options)
    except SlimsfmError as error:
        return {**row, "notes": f"{type(error).__name__}: {error}".replace(f"{folder}/", "")}, None
    return {
        **row,
        "registered": len(made.images),
        "points": len(made.point3D_ids),
        "masked": observations_in_hole(made) if kind.hole else "",
        "poses": f"{difference(made, first):.4f}" if first else "",
        "notes": "; ".join(made.info.notes),
    }, made


def observations_in_hole(map_: Map) -> int:
    """Observations in the left third of the images."""
    return sum(
        int(np.sum(map_.features[name].keypoints[seen.rows, 0] < map_.camera(name).width // 3))
        for name, seen in map_.observations.items()
    )


def difference(made: Map, first: Map) -> float:
    """Largest relative corner error between the poses of two maps, after an alignment by camera centers."""
    by_stem = {name.split(".")[0]: image for name, image in first.images.items()}
    pairs = [(image, by_stem.get(name.split(".")[0])) for name, image in made.images.items()]
    both = [(one, other) for one, other in pairs if other is not None]
    centers = [np.array([image.projection_center() for image in side]) for side in zip(*both, strict=True)]
    first_from_made = pycolmap.estimate_sim3d(*centers)
    if first_from_made is None:
        return np.inf
    return max(
        corner_error(
            first_from_made.transform_camera_world(one.cam_from_world()), other.cam_from_world(), first.box
        )
        for one, other in both
    )


def kinds() -> list[Kind]:
    """All kinds of input; photos in the first are exact."""
    return [
        Kind(name="PNG", write=saved("png")),
        *(Kind(name=suffix.upper(), write=saved(suffix)) for suffix in ("jpg", "webp", "avif", "jp2", "gif")),
        *(Kind(name=suffix.upper(), write=saved(suffix)) for suffix in ("tif", "bmp", "ppm", "tga")),
        *([Kind(name="HEIC", write=saved("heic"))] if can_read_heic() else []),
        *(Kind(name=f"mode {mode}", write=saved("tif", mode)) for mode in ("L", "P", "CMYK", "LAB")),
        *(Kind(name=f"gray, {bits} of 16 bits", write=deep_gray(bits)) for bits in (10, 12, 16)),
        *(Kind(name=f"RGB, {bits} of 16 bits", write=deep_color(bits)) for bits in (10, 12, 16)),
        Kind(name="float, 0 to 1", write=floats(1 / 255)),
        Kind(name="float, 0 to 65535", write=floats(257)),
        Kind(name="RGBA, opaque", write=transparent("png", hole=False)),
        Kind(name="RGBA, left third transparent", write=transparent("png"), hole=True),
        Kind(name="WebP, left third transparent", write=transparent("webp"), hole=True),
        Kind(
            name="the same, alpha ignored",
            write=transparent("png"),
            hole=True,
            options=BuildOptions(camera="shared", alpha="ignore"),
        ),
        *(
            Kind(name=f"mask {naming}, {depth}", write=masked(naming, depth), hole=True, masks=True)
            for naming, depth in (
                ("IMG.png.png", "8 bits"),
                ("IMG.png", "8 bits"),
                ("IMG.png", "0 and 1"),
                ("IMG.png", "1 bit"),
                ("IMG.png", "16 bits, 0 and 255"),
                ("IMG.png", "RGBA"),
            )
        ),
        Kind(name="mask IMG.png, all black", write=masked("IMG.png", "black"), hole=True, masks=True),
        Kind(name="mask IMG_mask.png", write=masked("IMG_mask.png", "8 bits"), hole=True, masks=True),
        Kind(name="turned by EXIF, stored mask", write=turned, hole=True, masks=True),
        Kind(name="two frames", write=animated),
        *(Kind(name=f"{times} times as large", write=saved("jpg", times=times)) for times in (2, 4, 6)),
        Kind(name="files that are not read", write=with_others),
    ]


def saved(suffix: str, mode: str = "RGB", times: int = 1) -> Write:
    """Write a photo in a format and color mode, enlarged."""

    def write(path: Path, photo: Image) -> None:
        if suffix == "heic":
            import pillow_heif

            pillow_heif.register_heif_opener()
        image = PillowImage.fromarray(photo)
        if mode == "LAB":
            rgb, lab = (ImageCms.createProfile(space) for space in ("sRGB", "LAB"))
            image = ImageCms.profileToProfile(image, rgb, lab, outputMode="LAB") or image
        elif mode != "RGB":
            image = image.convert(mode)
        if times > 1:
            image = image.resize((times * image.width, times * image.height), PillowImage.Resampling.BICUBIC)
        image.save(f"{path}.{suffix}", quality=95)

    return write


def deep_gray(bits: int) -> Write:
    """Write gray of some bits in a file of 16."""

    def write(path: Path, photo: Image) -> None:
        gray = np.asarray(PillowImage.fromarray(photo).convert("L"), np.uint16)
        PillowImage.fromarray(gray << (bits - 8)).save(f"{path}.png")

    return write


def deep_color(bits: int) -> Write:
    """Write colors of some bits in a file of 16."""
    return lambda path, photo: save_deep(f"{path}.png", photo.astype(np.uint16) << (bits - 8))


def save_deep(path: str, values: np.ndarray) -> None:
    """Write 16 bits per channel, which Pillow cannot."""
    cv2.imwrite(path, values[..., ::-1])


def floats(scale: float) -> Write:
    """Write gray as floating-point values."""

    def write(path: Path, photo: Image) -> None:
        gray = np.asarray(PillowImage.fromarray(photo).convert("L"), np.float32)
        PillowImage.fromarray(gray * np.float32(scale)).save(f"{path}.tif")

    return write


def left_third(photo: Image) -> np.ndarray:
    """A mask that keeps all but the left third."""
    mask = np.full(photo.shape[:2], 255, np.uint8)
    mask[:, : photo.shape[1] // 3] = 0
    return mask


def transparent(suffix: str, *, hole: bool = True) -> Write:
    """Write a photo with transparency."""

    def write(path: Path, photo: Image) -> None:
        alpha = left_third(photo) if hole else np.full(photo.shape[:2], 255, np.uint8)
        PillowImage.fromarray(np.dstack([photo, alpha])).save(f"{path}.{suffix}", lossless=True, exact=True)

    return write


def masked(naming: str, depth: str) -> Write:
    """Write a photo and its mask."""

    def write(path: Path, photo: Image) -> None:
        PillowImage.fromarray(photo).save(f"{path}.png")
        save_mask(path.parent / "masks" / naming.replace("IMG", path.name), left_third(photo), depth)

    return write


def save_mask(path: Path, mask: np.ndarray, depth: str) -> None:
    """Write a mask in a bit depth."""
    path.parent.mkdir(exist_ok=True)
    image = {
        "8 bits": lambda: PillowImage.fromarray(mask),
        "0 and 1": lambda: PillowImage.fromarray(mask // 255),
        "1 bit": lambda: PillowImage.fromarray(mask > 0),
        "16 bits, 0 and 255": lambda: PillowImage.fromarray(mask.astype(np.uint16)),
        "RGBA": lambda: PillowImage.fromarray(mask).convert("RGBA"),
        "black": lambda: PillowImage.fromarray(0 * mask),
    }[depth]()
    image.save(path)


def turned(path: Path, photo: Image) -> None:
    """Write a photo that EXIF turns, and its mask in stored pixels, as COLMAP's masks are."""
    exif = PillowImage.Exif()
    exif[ExifTags.Base.Orientation] = 6
    stored = PillowImage.fromarray(np.ascontiguousarray(np.rot90(photo)))
    stored.save(f"{path}.png", exif=exif)
    save_mask(
        path.parent / "masks" / f"{path.name}.png",
        np.ascontiguousarray(np.rot90(left_third(photo))),
        "8 bits",
    )


def animated(path: Path, photo: Image) -> None:
    """Write a file of two frames."""
    frames = [PillowImage.fromarray(photo), PillowImage.fromarray(photo[::-1])]
    frames[0].save(f"{path}.webp", save_all=True, append_images=frames[1:], quality=95)


def with_others(path: Path, photo: Image) -> None:
    """Write a photo beside files that are no photos."""
    PillowImage.fromarray(photo).save(f"{path}.png")
    for suffix in (".dng", ".mov", ".xmp"):
        path.with_suffix(suffix).write_bytes(b"")


if __name__ == "__main__":
    main()
