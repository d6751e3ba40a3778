"""Photos that cannot be used are skipped by name and reason, so that one of them does not stop the others."""

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from slimsfm.errors import ImageError
from slimsfm.image_files import named

_LOGGER = logging.getLogger(__name__)


class SkippedPhotos:
    """The photos of a folder that were skipped so far. May be used by several threads."""

    def __init__(self, folder: Path, *, strict: bool = False) -> None:
        """Skip photos of this folder; `strict` raises their errors instead."""
        self.reasons: dict[str, str] = {}
        """Why each was skipped, by name."""
        self._folder, self._strict = folder, strict
        self._errors: dict[str, ImageError] = {}

    @contextmanager
    def skipping(self, name: str) -> Iterator[None]:
        """Skip a photo, with a warning, if the block raises an `ImageError`."""
        try:
            yield
        except ImageError as error:
            if self._strict:
                raise
            self._errors[name] = error
            self.reasons[name] = reason_of(error, self._folder / name)
            _LOGGER.warning("%s: skipped: %s", name, self.reasons[name])

    def left(self, names: Iterable[str]) -> list[str]:
        """The names that were not skipped.

        Raises:
            ImageError: All were.
        """
        names = list(names)
        left = [name for name in names if name not in self.reasons]
        if names and not left:
            if len(names) == 1:
                raise self._errors[names[0]]
            raise ImageError("; ".join([f"{self._folder}: none of its images can be used", *self.notes]))
        return left

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence for each reason, with the names of its photos."""
        by_reason: dict[str, list[str]] = {}
        for name, reason in sorted(self.reasons.items()):
            by_reason.setdefault(reason, []).append(name)
        return tuple(f"{named('photo(s) skipped', names)} ({reason})" for reason, names in by_reason.items())


def reason_of(error: ImageError, path: Path) -> str:
    """What an error says about a photo, without the path of the photo."""
    return str(error).removeprefix(f"{path}: ")
