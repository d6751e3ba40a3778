import json
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from slimsfm.evaluation.metrics import NO_POSE, PoseError, score
from slimsfm.evaluation.table import Row, mean_row
from slimsfm.localization import Localization, Seconds

KEYS = {
    *("object", "strategy", "variant", "references", "points", "map_bytes", "queries", "localized"),
    *("add_0.1d", "add_0.05d", "add_0.02d", "median_corner_error"),
    *("confidence_wrong_at_0.9", "references_tried"),
    *("ms_extract", "ms_match", "ms_pose", "ms_total", "fps"),
}
METRIC_KEYS = {"1deg_1cm", "3deg_3cm", "5deg_5cm"}


def row(corner_errors, *, metric=False, match=0.02, references=4.0, variant="random"):
    errors = [
        NO_POSE
        if np.isinf(one)
        else PoseError(relative_corner_error=one, rotation_deg=100 * one, translation=one)
        for one in corner_errors
    ]
    seconds = Seconds(extract=0.01, match=match, pose=0.01)
    nothing = Localization(
        pose=None,
        camera=pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480),
        points2D=np.zeros((0, 2)),
        points3D_in_world=np.zeros((0, 3)),
        references=4,
        seconds=seconds,
    )
    found = [nothing] * len(errors)
    return Row(
        object="toy",
        strategy="direct",
        variant=variant,
        references=references,
        points=100.0,
        map_bytes=1e6,
        scores=score(errors, found, metric=metric),
    )


@pytest.mark.parametrize("metric", [True, False])
@pytest.mark.parametrize("corner_errors", [[0.01, 0.03], [0.01, np.inf], [np.inf, np.inf]], ids=str)
def test_a_row_is_plain_json_of_the_documented_keys(metric, corner_errors):
    values = json.loads(json.dumps(row(corner_errors, metric=metric).to_json(), allow_nan=False))
    assert values.keys() == (KEYS | METRIC_KEYS if metric else KEYS)
    assert values["queries"] == 2
    assert values["ms_total"] == pytest.approx(40.0)
    assert values["ms_match"] == pytest.approx(20.0)
    assert values["fps"] == pytest.approx(25.0)


def test_an_infinite_median_has_no_value_in_json():
    assert row([np.inf, np.inf, 0.01]).to_json()["median_corner_error"] is None
    assert row([0.01, 0.02, np.inf]).to_json()["median_corner_error"] == 0.02


def test_the_mean_of_one_row_is_that_row():
    one = row([0.01, 0.04, np.inf], metric=True)
    assert mean_row([one]).to_json() == one.to_json()


def test_a_mean_row_averages_every_figure_and_takes_the_median_of_medians():
    rows = [
        row([0.01, 0.01], metric=True, match=0.02),
        row([0.03, 0.03], metric=True, match=0.05, references=5.0),
        row([np.inf, np.inf], metric=True, match=0.08),
    ]
    mean = mean_row(rows)
    assert (mean.object, mean.strategy, mean.variant) == ("toy", "direct", "random")
    assert mean.references == pytest.approx(13 / 3)
    assert mean.scores.add == pytest.approx({0.1: 200 / 3, 0.05: 200 / 3, 0.02: 100 / 3})
    assert mean.scores.deg_cm == pytest.approx({1: 100 / 3, 3: 200 / 3, 5: 200 / 3})
    assert mean.scores.median_corner_error == pytest.approx(0.03)
    assert mean.scores.seconds.match == pytest.approx(0.05)
    assert mean.scores.fps == pytest.approx(1 / 0.07)
    assert mean.scores.queries == 2
    json.dumps(mean.to_json(), allow_nan=False)


def test_a_mean_over_nothing_localized_is_still_json():
    mean = mean_row([row([np.inf, np.inf])] * 2 + [row([0.01, 0.01])] * 2)
    assert np.isinf(mean.scores.median_corner_error)
    assert json.loads(json.dumps(mean.to_json(), allow_nan=False))["median_corner_error"] is None


def test_one_row_without_centimetres_leaves_the_mean_without():
    metric = row([0.01], metric=True)
    assert mean_row([metric, replace(metric, scores=row([0.01]).scores)]).scores.deg_cm is None
