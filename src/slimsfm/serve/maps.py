"""The maps of a server: their ids and versions, read again when their folder is replaced."""

import hashlib
import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slimsfm.errors import InputError, SlimsfmError
from slimsfm.files import read_bytes
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.cameras import QueryCamera, guess_camera
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map
from slimsfm.serve.errors import ApiError

_LOGGER = logging.getLogger(__name__)
_NOT_IN_IDS = re.compile(r"[^A-Za-z0-9._-]+")
_INFO = "map.json"


@dataclass(frozen=True, kw_only=True, eq=False)
class ServedMap:
    """One version of a map that is served. Requests that run keep theirs when it is replaced."""

    id: str
    """Name of the map in requests."""

    version: str
    """Differs if anything in the map differs."""

    localizer: Localizer
    """Localizer of the map."""

    model: bytes | None = None
    """What the page draws at the object, as JSON."""


class MapStore:
    """The maps that are served, by id. Reading is safe from any thread; `reload_changed` is for one."""

    def __init__(
        self,
        paths: Sequence[Path],
        options: LocalizationOptions,
        model_for: Callable[[str, Map], bytes | None] = lambda _id, _map: None,
    ) -> None:
        """Read the maps.

        Args:
            paths: Their folders.
            options: How images are localized.
            model_for: Gives the model of a map, by its id, as JSON.

        Raises:
            InputError: There is none, one is given twice, or one cannot be read.
        """
        if not paths:
            raise InputError("maps: give at least one map to serve")
        self._options, self._model_for = options, model_for
        self._paths = dict(zip(map_ids(paths), paths, strict=True))
        self._states = {key: _state(path) for key, path in self._paths.items()}
        self._served = {key: self._read(key) for key in self._paths}
        self.loads = len(self._served)
        """Number of maps read so far."""

    @property
    def ids(self) -> list[str]:
        """The ids in the order in which the maps were given."""
        return list(self._served)

    def __getitem__(self, id: str) -> ServedMap:
        """The current version of a map.

        Raises:
            ApiError: There is no such map (404).
        """
        found = self._served.get(id)
        if found is None:
            raise ApiError(404, "unknown_map", f"there is no map {id[:80]!r}; GET /v1/maps lists all")
        return found

    def select(self, ids: Sequence[str]) -> list[ServedMap]:
        """The maps of these ids, each once; all maps if there is none.

        Raises:
            ApiError: There is no such map (404).
        """
        return [self[key] for key in dict.fromkeys(ids or self.ids)]

    def reload_changed(self) -> list[str]:
        """Read maps again whose folder was replaced, and return their ids.

        A map that is missing or cannot be read stays as it is until its folder changes again.
        """
        changed = []
        for key, path in self._paths.items():
            state = _state(path)
            if state is None or state == self._states[key]:
                continue
            self._states[key] = state
            try:
                served = self._read(key)
            except (SlimsfmError, OSError) as error:
                _LOGGER.warning("%s: the old version stays: %s", key, error)
                continue
            self._served = {**self._served, key: served}
            self.loads += 1
            changed.append(key)
        return changed

    def _read(self, id: str) -> ServedMap:
        path = self._paths[id]
        found = read_map(path)
        digest = hashlib.sha256(read_bytes(path / _INFO) + found.fingerprint.encode())
        localizer = Localizer(found, self._options)
        _warm_up(localizer)
        return ServedMap(
            id=id, version=digest.hexdigest()[:12], localizer=localizer, model=self._model_for(id, found)
        )


def map_ids(paths: Sequence[Path]) -> list[str]:
    """Ids of maps: the names of their folders without what a URL would escape, numbered where equal.

    Raises:
        InputError: A folder is given twice.
    """
    folders = [path.resolve() for path in paths]
    ids: list[str] = []
    for path, folder in zip(paths, folders, strict=True):
        if folders.count(folder) > 1:
            raise InputError(f"maps: the map {path} is given twice")
        name = _NOT_IN_IDS.sub("-", folder.name).strip("-.") or "map"
        same = [name, *(f"{name}-{number}" for number in range(2, len(paths) + 1))]
        ids.append(next(one for one in same if one not in ids))
    return ids


def _state(path: Path) -> tuple[int, ...] | None:
    """What differs after a folder was replaced or its map.json written again; None if there is no map."""
    try:
        folder, info = path.stat(), (path / _INFO).stat()
    except OSError:
        return None
    return folder.st_dev, folder.st_ino, info.st_ino, info.st_mtime_ns, info.st_size


def _warm_up(localizer: Localizer) -> None:
    """Localize noise, so that what is computed once is not computed while a client waits."""
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    localizer.localize(noise, QueryCamera(camera=guess_camera(320, 240), source="unknown"))
