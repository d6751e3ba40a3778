"""The photos of a folder with their masks: which pixels may hold features.

A mask is a PNG file whose name is that of the photo plus `.png`, or, if there is none, that of the photo with
its suffix replaced by `.png`. Both are COLMAP's rules. What is not black in it is kept, whatever its bit
depth. A mask is as upright as its photo is read: an orientation tag of its own turns it; without one, a mask
that only fits the photo turned the other way is turned with it. Transparent pixels of a photo hold no
features either, unless they are told to.
"""

import os
from collections import defaultdict
from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from slimsfm.arrays import GrayImage, Image
from slimsfm.errors import ImageError, InputError
from slimsfm.files import inside
from slimsfm.image_files import FoundImages, find_images, named
from slimsfm.photos import Orientation, Photo, as_stored, read_photo, read_stored_mask, upright
from slimsfm.skipping import reason_of

AlphaUse = Literal["mask", "ignore"]
"""What transparency does: fully transparent pixels hold no features, or are like any others."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MaskedPhoto:
    """A photo and which of its pixels may hold features."""

    image: Image
    """RGB."""

    mask: GrayImage | None
    """0 where there are no features; None if they may be anywhere."""


def find_photos(folder: Path, masks: Path | None) -> FoundImages:
    """Find the images in a folder; masks in a subfolder of it are no photos.

    Raises:
        InputError: As in `find_images`.
    """
    inside = masks is not None and os.path.realpath(masks) != os.path.realpath(folder)
    return find_images(folder, leave_out=masks if inside else None)


class MaskedPhotos:
    """Reads the photos of a folder with their masks, and remembers what is to be said about them."""

    def __init__(
        self,
        folder: Path,
        names: list[str],
        masks: Path | None = None,
        alpha: AlphaUse = "mask",
        orientation: Orientation = "upright",
    ) -> None:
        """Find the masks.

        Args:
            folder: Folder of the photos.
            names: The photos, relative to the folder.
            masks: Folder of masks; None for none.
            alpha: What transparency does.
            orientation: Whether photos are read upright or as they are stored.

        Raises:
            InputError: The folder of masks does not exist or holds no mask of these photos.
        """
        self._folder, self._names, self._alpha = folder, names, alpha
        self._orientation: Orientation = orientation
        self._mask_folder, self._masks = masks, dict[str, Path]()
        self._said: dict[str, dict[str, str]] = defaultdict(dict)  # by photo: what, of which file
        self._unused_masks: set[str] = set()
        if masks is not None:
            self._find(Path(masks))

    def absolute(self) -> "MaskedPhotos":
        """The same photos by absolute paths, for processes with another working folder."""
        same = copy(self)
        same._folder = self._folder.absolute()
        same._mask_folder = self._mask_folder and self._mask_folder.absolute()
        same._masks = {name: path.absolute() for name, path in self._masks.items()}
        return same

    def reason(self, name: str, error: ImageError) -> str:
        """What an error says about a photo, without its path."""
        return reason_of(error, self._folder / name)

    def error(self, name: str, reason: str) -> ImageError:
        """The error of a photo that cannot be read for this reason."""
        return ImageError(f"{self._folder / name}: {reason}")

    def read(self, name: str) -> MaskedPhoto:
        """Read a photo and combine its mask with its transparency.

        Raises:
            ImageError: The photo or its mask is unreadable, or they differ in size.
        """
        photo = read_photo(inside(self._folder, name), self._orientation, warn=False)
        if photo.num_frames > 1:
            self._said[name]["photo(s) of several frames or pages, of which the first is used"] = name
        try:
            mask = self._mask(name, photo)
        except ImageError as error:
            told = str(error).removeprefix(f"{self._mask_folder}/")
            raise ImageError(f"{self._folder / name}: its mask {told}") from error
        if photo.alpha is not None and self._alpha == "mask":
            self._said[name]["photo(s) with transparent pixels, which hold no features"] = name
            mask = photo.alpha if mask is None else mask & photo.alpha
        if mask is not None and not mask.any():
            self._said[name][_EMPTY] = name
        return MaskedPhoto(image=photo.image, mask=mask)

    def files_of(self, name: str) -> tuple[Path, ...]:
        """The files of a photo: itself and, if it has one, its mask."""
        return tuple(path for path in (self._folder / name, self._masks.get(name)) if path)

    def said(self, name: str) -> dict[str, str]:
        """What is to be said about a photo that was read: sentences, and the file that each is about."""
        return self._said[name]

    def recall(self, name: str, said: Mapping[str, str]) -> None:
        """Take what an earlier process said about a photo for said, so that it need not be read again."""
        self._said[name] |= said

    def keep(self, names: Iterable[str]) -> None:
        """Forget all photos but these, which could be read, and check that two of them have pixels to keep.

        Raises:
            InputError: They have not.
        """
        self._names = list(names)
        empty = [name for name in self._names if _EMPTY in self._said[name]]
        if len(self._names) - len(empty) < 2 <= len(self._names):
            raise InputError(
                f"{named(_EMPTY, empty)}; a map needs at least two photos with pixels to keep: in a mask "
                "they are white, or have any other value but 0, and in a photo they are not transparent; "
                "`alpha='ignore'` ignores transparency"
            )

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences, with names, on masks without a photo, photos without a mask, transparency and frames."""
        files = defaultdict(set)
        for name in self._names:
            for what, file in self._said[name].items():
                files[what].add(file)
        files["mask(s) of no photo ignored"] = self._unused_masks
        return tuple(named(what, some) for what, some in sorted(files.items()) if some)

    def _find(self, masks: Path) -> None:
        if not masks.is_dir():
            raise InputError(f"{masks}: no such folder of masks")
        if os.path.realpath(masks) == os.path.realpath(self._folder):
            raise InputError(
                f"{masks}: is the folder of the photos; put the masks into a folder of their own"
            )
        for name in self._names:
            candidates = (masks / f"{name}.png", masks / PurePosixPath(name).with_suffix(".png"))
            path = next((path for path in candidates if path.is_file()), None)
            if path is None:
                self._said[name]["photo(s) without a mask, used whole"] = name
            else:
                self._masks[name] = path
        if not self._masks:
            raise InputError(_no_mask(masks, self._names[0]))
        used = set(self._masks.values())
        self._unused_masks = {one for one in find_images(masks).names if masks / one not in used}

    def _mask(self, name: str, photo: Photo) -> GrayImage | None:
        path, shape = self._masks.get(name), photo.image.shape[:2]
        if path is None:
            return None
        is_stored = self._orientation == "stored"
        mask, orientation = read_stored_mask(path)
        if orientation != 1:
            mask = upright(mask, orientation)
            mask = as_stored(mask, photo.orientation) if is_stored else mask
        elif photo.orientation != 1:
            turned = (as_stored if is_stored else upright)(mask, photo.orientation)
            if mask.shape == turned.shape == shape:
                as_read = f"mask(s) taken as {self._orientation}"
                self._said[name][f"{as_read}, because their photo is turned and they fit both ways"] = (
                    path.name
                )
            elif turned.shape == shape:
                mask = turned
        if mask.shape != shape:
            raise ImageError(
                f"{path}: the mask is {mask.shape[::-1]} pixels, its {self._orientation} image {shape[::-1]}"
            )
        return mask


_EMPTY = "photo(s) without features, because a mask or transparency covers all pixels"


def _no_mask(masks: Path, name: str) -> str:
    try:
        held = f"only {named('image(s)', find_images(masks).names)}"
    except InputError:
        held = "no image"
    stem = PurePosixPath(name).with_suffix(".png")
    return (
        f"{masks}: holds no mask of any photo, {held}; the mask of {name} is named {name}.png or {stem}, in "
        "the same subfolder as the photo"
    )
