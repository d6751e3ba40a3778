"""COLMAP databases of any version are read as they are, and nothing of them changes."""

import shutil
import sqlite3
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from commands import state
from mutations import mutations
from scenes import exact_map, like_sift, with_matches
from slimsfm.errors import InputError, ModelError
from slimsfm.mapping.database import read_database
from slimsfm.mapping.map import Map

EARLY_SCHEMA = """
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, model INTEGER, width INTEGER, height INTEGER,
                      params BLOB, prior_focal_length INTEGER);
CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL,
                     prior_qw REAL, prior_qx REAL, prior_qy REAL, prior_qz REAL, prior_tx REAL,
                     prior_ty REAL, prior_tz REAL);
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
CREATE TABLE matches (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
CREATE TABLE inlier_matches (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB,
                             config INTEGER);
"""


@dataclass(frozen=True)
class Stored:
    path: Path
    map: Map

    def read(self):
        return read_database(self.path, self.map.images)

    def execute(self, *commands):
        with closing(sqlite3.connect(self.path)) as database:
            for command in commands:
                database.execute(command)
            database.commit()


def write_recent(path, map_):
    with pycolmap.Database.open(path) as database:
        database.write_camera(map_.shared_camera, use_camera_id=True)
        for name, image in map_.images.items():
            row = pycolmap.Image(name=name, camera_id=1, image_id=image.image_id)
            database.write_image(row, use_image_id=True)
            database.write_keypoints(image.image_id, map_.features[name].keypoints)
            sift = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(
                image.image_id, pycolmap.FeatureDescriptors(type=sift, data=map_.features[name].descriptors)
            )
        for (a, b), pairs in map_.matches.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = pairs.astype(np.uint32)
            database.write_two_view_geometry(map_.images[a].image_id, map_.images[b].image_id, geometry)


def write_early(path, map_):
    with closing(sqlite3.connect(path)) as database:
        database.executescript(EARLY_SCHEMA)
        database.execute("INSERT INTO cameras VALUES (1, 4, 640, 480, x'', 0)")
        for name, image in map_.images.items():
            one = map_.features[name]
            row = (image.image_id, name, *[None] * 7)
            database.execute("INSERT INTO images VALUES (?, ?, 1, ?, ?, ?, ?, ?, ?, ?)", row)
            for table, data in (("keypoints", one.keypoints), ("descriptors", one.descriptors)):
                values = (image.image_id, *data.shape, data.tobytes())
                database.execute(f"INSERT INTO {table} VALUES (?, ?, ?, ?)", values)
        for (a, b), pairs in map_.matches.items():
            pair_id = pycolmap.image_pair_to_pair_id(map_.images[a].image_id, map_.images[b].image_id)
            values = (pair_id, *pairs.shape, pairs.astype(np.uint32).tobytes(), 2)
            database.execute("INSERT INTO inlier_matches VALUES (?, ?, ?, ?, ?)", values)
        database.commit()


@pytest.fixture(params=[write_recent, write_early], ids=["recent", "early"])
def stored(request, tmp_path):
    map_ = like_sift(with_matches(exact_map(num_images=4, num_points=30)))
    request.param(tmp_path / "the data.db", map_)
    return Stored(tmp_path / "the data.db", map_)


def test_features_and_matches_come_back(stored):
    contents = stored.read()
    assert contents.extractor == "SIFT"
    assert sorted(contents.features) == list(stored.map.images)
    for name, one in stored.map.features.items():
        assert np.array_equal(contents.features[name].keypoints, one.keypoints)
        assert np.array_equal(contents.features[name].descriptors, one.descriptors)
        assert contents.features[name].image_size == (640, 480)
    assert list(contents.matches) == list(stored.map.matches)
    for pair, pairs in stored.map.matches.items():
        assert np.array_equal(contents.matches[pair], pairs)


def test_reading_changes_nothing_also_where_nothing_can_be_written(stored):
    before = state(stored.path.parent)
    stored.read()
    assert state(stored.path.parent) == before
    stored.path.chmod(0o444)
    stored.path.parent.chmod(0o555)
    try:
        before = state(stored.path.parent)
        assert len(stored.read().features) == 4
        assert state(stored.path.parent) == before
    finally:
        stored.path.parent.chmod(0o755)


def test_what_is_still_in_the_write_ahead_log_counts(stored, tmp_path):
    """COLMAP leaves the log if it was killed, and while it runs."""
    (tmp_path / "left").mkdir()
    with closing(sqlite3.connect(stored.path)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("UPDATE images SET name = '005.png' WHERE name = '004.png'")
        database.commit()
        for end in ("", "-wal"):
            shutil.copy(f"{stored.path}{end}", tmp_path / "left")
    path = tmp_path / "left" / stored.path.name
    before = state(path.parent)
    assert "005.png" in read_database(path, ["004.png", "005.png"]).features
    assert state(path.parent) == before


def test_a_transaction_that_was_interrupted_is_ignored(stored, tmp_path):
    (tmp_path / "left").mkdir()
    with closing(sqlite3.connect(stored.path)) as database:
        database.execute("PRAGMA journal_mode = DELETE")
        database.execute("PRAGMA cache_size = 1")  # so that changes are written before the commit
        database.execute("UPDATE keypoints SET data = zeroblob(length(data))")
        database.execute("UPDATE descriptors SET data = zeroblob(length(data))")
        for end in ("", "-journal"):
            shutil.copy(f"{stored.path}{end}", tmp_path / "left")
    path = tmp_path / "left" / stored.path.name
    before = state(path.parent)
    features = read_database(path, stored.map.images).features
    for name, one in stored.map.features.items():
        assert np.array_equal(features[name].keypoints, one.keypoints)
        assert np.array_equal(features[name].descriptors, one.descriptors)
    assert state(path.parent) == before


def test_keypoints_without_descriptors_are_named(stored):
    stored.execute("DELETE FROM descriptors WHERE image_id = 2")
    with pytest.raises(ModelError, match=r"'002\.png' has 50 keypoints but 0 descriptors"):
        stored.read()
    stored.execute("DELETE FROM keypoints WHERE image_id = 2")
    assert sorted(stored.read().features) == ["001.png", "003.png", "004.png"]


DAMAGES = {
    "shorter data": "UPDATE keypoints SET data = substr(data, 1, 40) WHERE image_id = 1",
    "data that is missing": "UPDATE descriptors SET data = NULL WHERE image_id = 1",
    "a column less": "UPDATE keypoints SET cols = cols - 1 WHERE image_id = 1",
    "no images": "DROP TABLE images",
    "no keypoints": "DROP TABLE keypoints",
    "a name in another encoding": "UPDATE images SET name = CAST(x'ff2e706e67' AS TEXT) WHERE image_id = 1",
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_a_damaged_database_is_named(stored, damage):
    stored.execute("PRAGMA foreign_keys = OFF", damage)
    with pytest.raises(InputError, match=r"the data\.db: not readable as a COLMAP database") as error:
        stored.read()
    assert len(str(error.value)) < 400


def test_descriptors_of_several_extractors_are_refused(tmp_path):
    map_ = like_sift(exact_map(num_images=3, num_points=30))
    stored = Stored(tmp_path / "database.db", map_)
    write_recent(stored.path, map_)
    stored.execute("UPDATE descriptors SET type = 1 WHERE image_id = 1")
    with pytest.raises(ModelError, match=r"several extractors \(ALIKED_N16ROT, SIFT\)"):
        stored.read()
    stored.execute("UPDATE descriptors SET type = 1")
    contents = stored.read()
    assert contents.extractor == "ALIKED_N16ROT"
    assert contents.features["001.png"].descriptors.shape == (50, 32)


def test_a_damaged_database_is_read_within_bounds_or_refused(stored):
    whole = stored.path.read_bytes()
    for _, damaged in mutations(whole, seed=5, count=60):
        stored.path.write_bytes(damaged)
        with suppress(InputError):
            assert all(len(one) == len(one.descriptors) for one in stored.read().features.values())


COMPUTED = {
    "view": (
        "ALTER TABLE images RENAME TO others",
        "CREATE VIEW images AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) "
        "SELECT x image_id, x name, 1 camera_id FROM n",
    ),
    "column": (
        "ALTER TABLE keypoints RENAME TO others",
        "CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER, "
        "data BLOB AS (zeroblob(1000000000)))",
        "INSERT INTO keypoints SELECT image_id, rows, cols FROM others",
    ),
}


@pytest.mark.parametrize("commands", COMPUTED.values(), ids=COMPUTED.keys())
def test_values_that_a_database_would_compute_are_refused(stored, commands):
    stored.execute(*commands)
    with pytest.raises(InputError, match="is not a plain table"):
        stored.read()


@pytest.mark.parametrize(
    "change",
    ["rows = -1", "rows = 'many'", "cols = 0", "cols = 1", "rows = 2000000000", "data = zeroblob(7)"],
)
def test_impossible_keypoints_are_refused(stored, change):
    stored.execute(f"UPDATE keypoints SET {change}")
    with pytest.raises(InputError, match="not readable as a COLMAP database"):
        stored.read()
