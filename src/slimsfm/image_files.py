"""Which files are photos: the formats that are read, and what a folder holds besides.

Formats are told by suffix, from a table: what Pillow reads of rasters that cameras, phones and editors write.
Icons, vector graphics and astronomy's files are not among them. HEIC needs the package pillow-heif.
"""

import logging
import os
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from slimsfm.errors import InputError

_LOGGER = logging.getLogger(__name__)

_FORMATS = {
    "JPEG": ".jpg .jpeg .jpe .jfif .mpo",
    "PNG": ".png .apng",
    "TIFF": ".tif .tiff",
    "WebP": ".webp",
    "AVIF": ".avif",
    "JPEG 2000": ".jp2 .j2k .j2c .jpc .jpf .jpx",
    "BMP": ".bmp .dib",
    "GIF": ".gif",
    "PNM": ".ppm .pgm .pbm .pnm .pfm",
    "TGA": ".tga",
    "PCX": ".pcx",
    "SGI": ".sgi .rgb .bw",
    "QOI": ".qoi",
    "DDS": ".dds",
    "Photoshop": ".psd",
}  # read by Pillow
_HEIC = ".heic .heif .hif"
_UNREAD = {
    "raw": (
        ".dng .cr2 .cr3 .crw .nef .nrw .arw .srf .sr2 .orf .rw2 .raf .pef .srw .x3f .3fr .iiq .raw .rwl .erf "
        ".kdc .dcr .mrw .gpr"
    ),
    "video": ".mp4 .mov .avi .mkv .webm .m4v .mpg .mpeg .3gp .mts .m2ts .wmv .insv .lrv",
    "JPEG XL": ".jxl",
    "OpenEXR": ".exr",
    "HDR": ".hdr",
    "FITS": ".fits .fit",
    "GIMP": ".xcf",
    "JPEG XR": ".jxr",
    "PDF": ".pdf",
    "SVG": ".svg",
    "Insta360": ".insp",
}  # recognized only to say that they are skipped


def _by_suffix(table: dict[str, str]) -> dict[str, str]:
    return {suffix: name for name, suffixes in table.items() for suffix in suffixes.split()}


_READ, _NAMED = _by_suffix(_FORMATS), _by_suffix({**_UNREAD, "HEIC": _HEIC})

INSTALL_HEIC = "HEIC photos need pillow-heif: pip install 'slimsfm[heic]'"
"""What to say where a HEIC photo cannot be read."""


def can_read_heic() -> bool:
    """Whether pillow-heif is installed."""
    return find_spec("pillow_heif") is not None


@dataclass(frozen=True, kw_only=True)
class FoundImages:
    """The images of a folder and its subfolders."""

    names: tuple[str, ...]
    """Paths relative to the folder, with forward slashes, sorted."""

    notes: tuple[str, ...]
    """Sentences, with names, on what was skipped."""


def find_images(folder: str | Path, *, leave_out: Path | None = None) -> FoundImages:
    """Find the images in a folder and its subfolders, and say what else there is.

    Links to files and folders are followed, and a file or folder that several paths lead to counts once.
    Hidden files and folders, whose names begin with a dot, are left out without a word.

    Args:
        folder: The folder.
        leave_out: A folder inside it whose files are no photos, such as that of their masks.

    Raises:
        InputError: The folder does not exist or contains no image, or the name of an image cannot be written
            to the text files of COLMAP and hloc.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of images")
    images, skipped = [], defaultdict(list)
    for name in _files(folder, leave_out, skipped):
        kind = _kind(name)
        if kind is None:
            images.append(name)
        else:
            skipped[kind].append(name)
    notes = tuple(_note(kind, names) for kind, names in sorted(skipped.items()))
    if not images:
        readable = ", ".join(_FORMATS)
        raise InputError("; ".join([f"{folder}: contains no image that can be read ({readable})", *notes]))
    check_names(folder, images)
    return FoundImages(names=tuple(sorted(images)), notes=notes)


def list_images(folder: str | Path) -> list[str]:
    """List the images in a folder and its subfolders, sorted; what is skipped is logged as a warning.

    Raises:
        InputError: As in `find_images`.
    """
    found = find_images(folder)
    for note in found.notes:
        _LOGGER.warning("%s: %s", folder, note)
    return list(found.names)


def is_image(path: Path) -> bool:
    """Whether a path is that of an image, by its name."""
    return not path.name.startswith(".") and _kind(path.name) is None


def named(count_of: str, names: Iterable[str]) -> str:
    """Write a count with the names that it counts: "3 HEIC files: a.heic, b.heic, c.heic"."""
    listed = sorted(names)
    return f"{len(listed)} {count_of.replace('(s)', '' if len(listed) == 1 else 's')}: {', '.join(listed)}"


_OTHER, _BROKEN, _TWICE, _CLOSED = "other", "broken link", "twice", "closed folder"  # reasons besides formats


def _kind(name: str) -> str | None:
    """The format that a file is skipped for; None for an image."""
    suffix = Path(name).suffix.lower()
    if suffix in _READ or (suffix in _HEIC.split() and can_read_heic()):
        return None
    return _NAMED.get(suffix, _OTHER)


def _note(kind: str, names: list[str]) -> str:
    if kind == _OTHER:
        suffixes = sorted({Path(name).suffix.lower() or "no suffix" for name in names})
        return f"{len(names)} other file{'s' * (len(names) > 1)} skipped ({', '.join(suffixes)})"
    if kind == _BROKEN:
        return named("link(s) to nothing skipped", names)
    if kind == _TWICE:
        return named("link(s) skipped to what is listed already", names)
    if kind == _CLOSED:
        return named("folder(s) skipped that may not be read", names)
    reason = f" ({INSTALL_HEIC})" if kind == "HEIC" else ""
    return named(f"{kind} file(s) skipped{reason}", names)


def _files(folder: Path, leave_out: Path | None, skipped: dict[str, list[str]]) -> Iterator[str]:
    """Names of the files in a folder; real files first, so that a link to one of them is the one skipped."""
    seen = set()
    for path in sorted(
        _walk(folder, leave_out, skipped), key=lambda path: (path.is_symlink(), path.as_posix())
    ):
        name, real = path.relative_to(folder).as_posix(), os.path.realpath(path)
        if not path.is_file():
            skipped[_BROKEN].append(name)
        elif real in seen:
            skipped[_TWICE].append(name)
        else:
            yield name
        seen.add(real)


def _walk(folder: Path, leave_out: Path | None, skipped: dict[str, list[str]]) -> Iterator[Path]:
    """All files below a folder that are not hidden; linked folders last, so that no circle is walked."""
    left_out = os.path.realpath(leave_out) if leave_out else ""
    entered, linked = set(), [folder]
    for start in linked:  # grows
        pending = [start]
        for path in pending:  # grows
            real, name = os.path.realpath(path), path.relative_to(folder).as_posix()
            if real in entered:
                skipped[_TWICE].append(name)
            if real in entered or real == left_out:
                continue
            entered.add(real)
            try:
                entries = sorted(path.iterdir())
            except OSError:
                skipped[_CLOSED].append(name)
                continue
            shown = [entry for entry in entries if not entry.name.startswith(".")]
            for entry in shown:
                if entry.is_dir():
                    (linked if entry.is_symlink() else pending).append(entry)
                else:
                    yield entry


def check_names(folder: Path, names: Iterable[str]) -> None:
    """Check that the files that hold names of images can hold these.

    Raises:
        InputError: A name has a character that ends a line or is no text.
    """
    for name in names:
        if any(unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp") for letter in name):
            raise InputError(
                f"{folder}: the name {name!r} has a line break or another character that text files "
                "of names cannot hold; rename the image"
            )
