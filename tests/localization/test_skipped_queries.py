"""Queries that cannot be used are skipped by name and reason, and the others do not notice."""

import csv
import json
import shutil
from pathlib import Path

import pytest
from PIL import Image

from outcomes import assert_same_outcomes
from slimsfm.errors import ImageError
from slimsfm.localization import (
    LocalizationOptions,
    Localizer,
    MultiLocalizer,
    localize_failed,
    localize_images,
    localize_objects,
)
from slimsfm.localization.pose_files import write_poses

BROKEN = ["0 cut.jpg", "empty.jpg", "text.png"]


@pytest.fixture(scope="module")
def folder(boulder, tmp_path_factory) -> Path:
    """Queries of another size than the map's photos, of one unknown camera, and broken ones."""
    folder = tmp_path_factory.mktemp("queries")
    for path in (*boulder.query.image_paths, *boulder.mapping.image_paths[::4]):
        Image.open(path).crop((10, 0, 310, 240)).save(folder / f"{path.parent.parent.name} {path.name}")
    Image.open(min(folder.iterdir())).save(folder / BROKEN[0])
    good = (folder / BROKEN[0]).read_bytes()
    for name, content in zip(BROKEN, (good[: len(good) // 2], b"", b"text"), strict=True):
        (folder / name).write_bytes(content)
    return folder


@pytest.fixture(scope="module")
def results(boulder, folder):
    return localize_images(Localizer(boulder.map), folder)


def test_broken_queries_have_a_reason_and_the_others_do_not_notice(boulder, folder, results, tmp_path):
    assert sorted(results) == list(results) == sorted(path.name for path in folder.iterdir())
    for name in BROKEN:
        assert results[name].is_skipped
        assert results[name].pose is None
        assert results[name].reason.startswith("not a readable image: damaged")
    without = shutil.copytree(folder, tmp_path / "good", ignore=shutil.ignore_patterns(*BROKEN))
    alone = localize_images(Localizer(boulder.map), without)
    assert any(one.camera_source == "queries" for one in alone.values())
    assert_same_outcomes({name: one for name, one in results.items() if not one.is_skipped}, alone)


def test_every_query_without_a_pose_has_a_reason_and_no_other(boulder, results):
    strictest = Localizer(boulder.map, LocalizationOptions(min_confidence=1.0))
    unsure = localize_images(strictest, boulder.query.image_paths[0])
    for one in (*results.values(), *unsure.values()):
        assert (one.pose is None) == (one.reason is not None)
    assert all("confidence" in one.reason for one in unsure.values())


def test_pose_files_treat_skipped_queries_as_not_localized(results, tmp_path):
    for name in ("poses.json", "poses.csv", "poses.tum", "spaceless/images.txt"):
        named = {key.replace(" ", "_"): one for key, one in results.items()}
        write_poses(tmp_path / name, named)
    images = json.loads((tmp_path / "poses.json").read_text())["images"]
    skipped = [one for one in images if one["name"].replace("_", " ") in BROKEN]
    assert [(one["localized"], one["focal_length_px"]) for one in skipped] == [(False, None)] * 3
    assert all(one["reason"] == results[BROKEN[0]].reason for one in skipped)
    rows = list(csv.DictReader((tmp_path / "poses.csv").read_text().splitlines()))
    assert [row["reason"] or None for row in rows] == [one["reason"] for one in images]
    localized = sum(one.pose is not None for one in results.values())
    for name, lines in (("poses.tum", 1), ("spaceless/images.txt", 2)):
        text = (tmp_path / name).read_text()
        assert len([line for line in text.split("\n")[lines:] if line]) == localized


def test_strict_and_no_usable_query_at_all_are_errors(boulder, folder, tmp_path):
    localizer = Localizer(boulder.map)
    with pytest.raises(ImageError, match=r"empty\.jpg: not a readable image"):
        localize_images(localizer, folder, strict=True)
    with pytest.raises(ImageError, match=r"text\.png: not a readable image"):
        localize_images(localizer, folder / "text.png")
    for name in BROKEN:
        shutil.copy(folder / name, tmp_path / name)
    with pytest.raises(ImageError, match="none of its images can be used; 3 photos skipped: 0 cut"):
        localize_objects(MultiLocalizer({"one": localizer}), tmp_path)


def test_queries_of_unknown_focal_length_are_skipped_where_it_must_be_known(boulder, tmp_path):
    first, second = boulder.query.image_paths[:2]
    shutil.copy(first, tmp_path / "a.png")
    Image.open(second).crop((10, 0, 310, 240)).save(tmp_path / "b.png")
    found = localize_images(Localizer(boulder.map, LocalizationOptions(focal="known")), tmp_path)
    assert found["a.png"].pose is not None
    assert found["b.png"].is_skipped
    assert "its focal length is unknown" in found["b.png"].reason


def test_the_full_map_is_not_asked_for_skipped_queries(boulder, folder, results):
    skipped = {name: results[name] for name in BROKEN}
    assert localize_failed(Localizer(boulder.map), skipped, folder) == {}
