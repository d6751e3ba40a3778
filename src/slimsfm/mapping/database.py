"""Read COLMAP databases of any version without changing them.

`pycolmap.Database.open` migrates a database to its own version, so this module asks SQLite itself. A database
opened as `immutable` is neither locked nor written, in a folder that is read-only as well. SQLite must not
ignore a journal next to it, which an interrupted or running COLMAP leaves; such a database is copied first.

Tables:
    images               image_id, name, camera_id
    cameras              camera_id, width, height
    keypoints            image_id, rows, cols (2, 4 or 6), data (float32)
    descriptors          image_id, rows, cols (bytes), data; in recent versions also type
    two_view_geometries  pair_id, rows, cols (2), data (uint32); inlier_matches in early versions
"""

import shutil
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float32

from slimsfm.arrays import IndexPairs
from slimsfm.errors import InputError, ModelError
from slimsfm.features import Features
from slimsfm.files import contents_of, plain, working_folder

_MAGIC = b"SQLite format 3\0"
_JOURNALS = ("-wal", "-journal")  # with what is not yet in the database itself
_SIFT = (pycolmap.FeatureExtractorType.SIFT, pycolmap.FeatureExtractorType.UNDEFINED)


@dataclass(frozen=True, kw_only=True, eq=False)
class DatabaseContents:
    """What a COLMAP database holds of some images."""

    features: dict[str, Features]
    """By image name; images without any keypoint are left out."""

    matches: dict[tuple[str, str], IndexPairs]
    """Verified matches by pair of image names, sorted."""

    extractor: str
    """COLMAP's name of the extractor, such as SIFT or ALIKED_N16ROT."""


def read_database(path: Path, names: Iterable[str]) -> DatabaseContents:
    """Read the features and verified matches of images from a COLMAP database; nothing is written.

    Raises:
        InputError: The file is missing, damaged or no COLMAP database.
        ModelError: Keypoints have no descriptors, or descriptors are of several extractors.
    """
    with contents_of(path, "not readable as a COLMAP database"), _opened(path) as database:
        _check_tables(database)
        return _read(path, database, set(names))


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    if not path.is_file():
        raise InputError(f"{path}: no such database")
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise InputError(f"{path}: not a COLMAP database")
    journals = [journal for end in _JOURNALS if (journal := Path(f"{path}{end}")).is_file()]
    with working_folder() as folder:
        read = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        if any(journal.stat().st_size for journal in journals):
            for file in (path, *journals):
                shutil.copyfile(file, folder / file.name)
            read = (folder / path.name).as_uri()
        with closing(sqlite3.connect(read, uri=True)) as database:
            yield database


def _check_tables(database: sqlite3.Connection) -> None:
    """Check that tables hold what is read: SQL in a file, as of a view, may compute anything for any time."""
    schema = "SELECT name, type, rootpage FROM sqlite_master WHERE type NOT IN ('index', 'trigger')"
    for name, kind, page in database.execute(schema).fetchall():
        columns = database.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,)) if page else ()
        if kind != "table" or not page or any(hidden for (hidden,) in columns):
            raise ValueError(f"{name!r} is not a plain table")


def _read(path: Path, database: sqlite3.Connection, names: set[str]) -> DatabaseContents:
    found = database.execute(
        "SELECT image_id, name, width, height FROM images LEFT JOIN cameras USING (camera_id)"
    )
    images = {
        image_id: (name, (plain(width or 0, int), plain(height or 0, int)))
        for image_id, name, width, height in found
    }
    images = {image_id: one for image_id, one in images.items() if one[0] in names}
    features, extractors = {}, set()
    for image_id, (name, size) in images.items():
        keypoints = _array(database, "keypoints", image_id, np.float32)
        if not len(keypoints):
            continue
        extractor = _extractor(database, image_id)
        descriptors = _array(database, "descriptors", image_id, np.uint8)
        if len(descriptors) != len(keypoints):
            raise ModelError(
                f"{path}: image {name!r} has {len(keypoints)} keypoints but {len(descriptors)} descriptors; "
                "extract its features again, or give another source of descriptors"
            )
        is_sift = extractor in _SIFT
        descriptors = descriptors if is_sift else descriptors.view(np.float32)
        features[name] = Features(
            keypoints=np.ascontiguousarray(keypoints[:, :2]),
            descriptors=descriptors,
            scores=np.ones(len(keypoints), np.float32),
            image_size=size,
            frames=_frames(keypoints) if is_sift else None,
        )
        extractors.add("SIFT" if is_sift else extractor.name)
    if len(extractors) > 1:
        raise ModelError(f"{path}: holds features of several extractors ({', '.join(sorted(extractors))})")
    matches = _matches(database, {image_id: name for image_id, (name, _) in images.items()})
    return DatabaseContents(
        features=features, matches=matches, extractor=extractors.pop() if extractors else "SIFT"
    )


def _array(database: sqlite3.Connection, table: str, image_id: int, kind: type) -> np.ndarray:
    row = database.execute(f"SELECT rows, cols, data FROM {table} WHERE image_id = ?", (image_id,)).fetchone()
    return _matrix(row, kind) if row else np.zeros((0, 2), kind)


def _matrix(row: tuple[int, int, bytes | None], kind: type) -> np.ndarray:
    rows, columns, data = row
    if not rows:
        return np.zeros((0, 2), kind)
    if plain(rows, int) < 0 or plain(columns, int) < 1 + (kind is not np.uint8):
        raise ValueError(f"a matrix of {rows} rows and {columns} columns")
    return np.frombuffer(data or b"", kind).reshape(rows, columns).copy()


def _extractor(database: sqlite3.Connection, image_id: int) -> Any:
    columns = {column[1] for column in database.execute("PRAGMA table_info(descriptors)")}
    if "type" not in columns:
        return pycolmap.FeatureExtractorType.SIFT
    row = database.execute("SELECT type FROM descriptors WHERE image_id = ?", (image_id,)).fetchone()
    return pycolmap.FeatureExtractorType(row[0]) if row else pycolmap.FeatureExtractorType.UNDEFINED


def _frames(keypoints: Float32[np.ndarray, "n columns"]) -> Float32[np.ndarray, "n 2"] | None:
    """Scales and orientations: the last two of four columns, or computed from the affine shapes of six."""
    if keypoints.shape[1] == 4:
        return keypoints[:, 2:]
    if keypoints.shape[1] < 6:
        return None
    shapes = keypoints[:, 2:].reshape(-1, 2, 2)
    scales = np.linalg.norm(shapes, axis=1).mean(axis=1)
    return np.stack([scales, np.arctan2(shapes[:, 1, 0], shapes[:, 0, 0])], axis=1)


def _matches(database: sqlite3.Connection, names: dict[int, str]) -> dict[tuple[str, str], IndexPairs]:
    tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    table = next((one for one in ("two_view_geometries", "inlier_matches") if one in tables), None)
    found = {}
    rows = database.execute(f"SELECT pair_id, rows, cols, data FROM {table} WHERE rows > 0") if table else ()
    for pair_id, *row in rows:
        one, other = pycolmap.pair_id_to_image_pair(pair_id)
        if one not in names or other not in names:
            continue
        pairs = _matrix(tuple(row), np.uint32)[:, :2].astype(np.int64)
        ordered = names[one] < names[other]
        pairs = pairs if ordered else pairs[:, ::-1]
        key = (names[one], names[other]) if ordered else (names[other], names[one])
        found[key] = pairs[np.argsort(pairs[:, 0], kind="stable")]
    return {key: found[key] for key in sorted(found)}
