import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from handmade import FULL, measurement_like, random_pose, result_like, run_like

from scenes import camera
from slimsfm.errors import InputError
from slimsfm.evaluation.result_files import (
    digest_of,
    object_to_json,
    read_object_result,
    read_run,
    run_to_json,
    write_json,
)
from slimsfm.evaluation.results import MapRun, Measurement, Outcomes, PosedQuery
from slimsfm.geometry import Box
from slimsfm.mapping.quality import ModelQuality

QUERIES = 20


def random_outcomes(rng):
    lost = rng.random(QUERIES) < 0.3
    return Outcomes(
        error=np.where(lost, np.inf, rng.lognormal(-3, 1, QUERIES)),
        rotation_deg=np.where(lost, np.inf, rng.uniform(0, 180, QUERIES)),
        translation=np.where(lost, np.inf, rng.lognormal(-3, 1, QUERIES)),
        confidence=np.where(lost | (rng.random(QUERIES) < 0.2), np.nan, rng.random(QUERIES)),
        references=rng.integers(0, 50, QUERIES),
        seconds=rng.random((QUERIES, 3)),
        cam_from_world=tuple(None if one else random_pose(rng) for one in lost),
    )


@pytest.fixture
def run(tmp_path):
    """A run with random numbers of full precision."""
    rng = np.random.default_rng(0)
    draws = tuple(
        MapRun(references=3, points=17, map_bytes=4711, outcomes=random_outcomes(rng)) for _ in range(2)
    )
    objects = [
        replace(
            result_like(name, measurement_like(FULL, [0.0] * QUERIES)),
            box=Box(rng.normal(size=3), rng.normal(size=(3, 3))),
            unit=unit,
            queries=tuple(
                PosedQuery(
                    path=Path("photos", f"{i}.png"),
                    camera=camera(model),
                    cam_from_world=random_pose(rng),
                    orientation="stored" if name == "mug" else "upright",
                )
                for i in range(QUERIES)
            ),
            measurements=(
                Measurement(method="sift", strategy="direct", variant="full", map_runs=draws[:1]),
                Measurement(method="sift", strategy="direct", variant="random:3", map_runs=draws),
            ),
        )
        for name, unit, model in (("can", "metre", "OPENCV"), ("mug", "unknown", "SIMPLE_RADIAL"))
    ]
    return run_like(*objects, folder=tmp_path / "run", failed={"jar": "it broke"})


@pytest.fixture
def written(run):
    write_json(run.folder / "results.json", run_to_json(run))
    return run.folder / "results.json"


def same_bits(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def test_reading_returns_the_written_values_bit_for_bit(run, written):
    found = read_run(written.parent)
    assert digest_of(found.objects) == digest_of(run.objects)
    assert run_to_json(found) == run_to_json(run)
    for was, now in zip(run.objects, found.objects, strict=True):
        assert same_bits(was.box.half_edges, now.box.half_edges)
        for cell_was, cell_now in zip(was.measurements, now.measurements, strict=True):
            for one, other in zip(cell_was.map_runs, cell_now.map_runs, strict=True):
                assert_equal_outcomes(one.outcomes, other.outcomes)


def assert_equal_outcomes(a, b):
    for name in ("error", "rotation_deg", "translation", "confidence", "references", "seconds"):
        assert same_bits(getattr(a, name), getattr(b, name)), name
    for one, other in zip(a.cam_from_world, b.cam_from_world, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            assert same_bits(one.rotation.quat, other.rotation.quat)
            assert same_bits(one.translation, other.translation)


def test_reading_returns_all_other_fields(run, written):
    found = read_run(written)  # the file works as well as its folder
    assert found.folder == run.folder
    for name in ("dataset", "options", "environment", "failed"):
        assert getattr(found, name) == getattr(run, name)
    for was, now in zip(run.objects, found.objects, strict=True):
        assert (now.name, now.unit, now.images, now.maps) == (was.name, was.unit, was.images, was.maps)
        for query, again in zip(was.queries, now.queries, strict=True):
            assert again.path == query.path
            assert again.camera.model == query.camera.model
            assert (again.camera.width, again.camera.height) == (640, 480)
            assert same_bits(again.camera.params, query.camera.params)


def test_the_file_is_strict_json_in_which_no_pose_is_null(run, written):
    def refuse(constant):
        raise AssertionError(constant)

    data = json.loads(written.read_text(), parse_constant=refuse)
    trial, outcomes = data["objects"][0]["cells"][0]["trials"][0], run.objects[0].measurements[0].outcomes
    for key in ("error", "rotation_deg", "translation", "cam_from_world"):
        assert [value is None for value in trial[key]] == [one is None for one in outcomes.cam_from_world]
    assert [value is None for value in trial["confidence"]] == np.isnan(outcomes.confidence).tolist()


def test_the_digest_depends_only_on_poses_and_maps(run):
    (can, mug), before = run.objects, digest_of(run.objects)

    def changed(**fields):
        return digest_of([with_outcomes(can, **fields), mug])

    outcomes = can.measurements[0].outcomes
    assert changed(seconds=7 * outcomes.seconds) == before
    moved = replace(can, images=Path("elsewhere"))
    assert digest_of([moved, mug]) == before
    error = outcomes.error.copy()
    error[np.isfinite(error)] = np.nextafter(error[np.isfinite(error)], 1)
    assert changed(error=error) != before
    assert changed(cam_from_world=outcomes.cam_from_world[::-1]) != before
    assert digest_of([can]) != before
    assert digest_of([mug, can]) != before


def with_quality(result):
    """The object with a measured map that is doubted."""
    quality = ModelQuality(
        given=12,
        registered=10,
        verified_pairs=30,
        contradicted_pairs=3,
        trusted_pairs=9,
        contradictions={"1.png": 0.1 + 0.2, "2.png": 0.0},
        doubtful=("1.png", "2.png", "3.png"),
        median_observations=100.5,
        median_track_length=3.0,
        triangulation_angle_deg=12.25,
        camera_spread=1.5,
        focal_lengths={"1.png": 1.2},
        focal_origins={"1.png": "guessed"},
        pieces=(10,),
    )
    maps = (replace(result.maps[0], quality=quality, notes=("a note",)), *result.maps[1:])
    return replace(result, maps=maps)


def test_the_quality_of_maps_is_stored_and_does_not_change_the_digest(run, tmp_path):
    measured = with_quality(run.objects[0])
    write_json(tmp_path / "can.json", object_to_json(measured))
    found = read_object_result(tmp_path / "can.json")
    assert found.maps == measured.maps
    assert digest_of([found]) == digest_of(run.objects[:1])


def test_results_without_quality_stay_readable(run, written):
    data = json.loads(written.read_text())
    for mapped in (one for result in data["objects"] for one in result["maps"]):
        del mapped["quality"], mapped["notes"]
    written.write_text(json.dumps(data))
    found = read_run(written)
    assert [(one.maps[0].quality, one.maps[0].notes) for one in found.objects] == [(None, ())] * 2
    assert digest_of(found.objects) == digest_of(run.objects) == data["digest"]


def with_outcomes(result, **fields):
    cell = result.measurements[0]
    trial = replace(cell.map_runs[0], outcomes=replace(cell.outcomes, **fields))
    return replace(result, measurements=(replace(cell, map_runs=(trial,)), *result.measurements[1:]))


def test_a_single_object_can_be_read(run, tmp_path):
    write_json(tmp_path / "can.json", object_to_json(run.objects[0]))
    assert digest_of([read_object_result(tmp_path / "can.json")]) == digest_of(run.objects[:1])


def test_infinite_numbers_are_an_error_and_the_old_file_stays(tmp_path):
    write_json(tmp_path / "x.json", {"a": 1.0})
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "x.json", {"a": np.inf})
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": 1.0}
    assert [path.name for path in tmp_path.iterdir()] == ["x.json"]


def shorten(text):
    return text[: len(text) // 2]


def lose(*path):
    def change(text):
        data = json.loads(text)
        inner = data
        for key in path[:-1]:
            inner = inner[key]
        del inner[path[-1]]
        return json.dumps(data)

    return change


def put(value, *path):
    def change(text):
        data = json.loads(text)
        inner = data
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value
        return json.dumps(data)

    return change


TRIAL = ("objects", 0, "cells", 0, "trials", 0)
DAMAGE = {
    "cut short": shorten,
    "empty": lambda _: "",
    "no JSON": lambda _: "results",
    "a list": lambda _: "[]",
    "no format": lose("format"),
    "no objects": lose("objects"),
    "no queries": lose("objects", 0, "queries"),
    "fewer queries": lose("objects", 0, "queries", 0),
    "fewer errors": lose(*TRIAL, "error", 0),
    "fewer poses": lose(*TRIAL, "cam_from_world", 0),
    "a pose of six numbers": lose("objects", 0, "queries", 0, "cam_from_world", 6),
    "a pose of three numbers": put([1, 2, 3], "objects", 0, "queries", 0, "cam_from_world"),
    "a flat box": put([[0, 0, 0]] * 3, "objects", 0, "box", "half_edges"),
    "words for numbers": put(["good"] * QUERIES, *TRIAL, "error"),
    "an unknown camera": put("PINHOLE_9", "objects", 0, "queries", 0, "camera", "model"),
    "another field": put(1, "objects", 0, "maps", 0, "color"),
    "quality of nothing": put({"given": 3}, "objects", 0, "maps", 0, "quality"),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_damaged_results_are_named_in_the_error(written, damage):
    written.write_text(damage(written.read_text()))
    with pytest.raises(InputError, match=r"results\.json: not a result of slimsfm benchmark \(.*; run"):
        read_run(written.parent)


def test_binary_results_are_named_in_the_error(written):
    written.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match=r"results\.json: not a result"):
        read_run(written)


def test_results_of_another_format_are_named_in_the_error(written):
    written.write_text(put(2, "format")(written.read_text()))
    with pytest.raises(InputError, match=r"results\.json: has format 2, expected 1; run the benchmark again"):
        read_run(written)


def test_missing_results_are_named_in_the_error(tmp_path):
    for given in (tmp_path, tmp_path / "nothing", tmp_path / "nothing.json"):
        with pytest.raises(InputError, match="no such file; pass the folder of a run of slimsfm benchmark"):
            read_run(given)
