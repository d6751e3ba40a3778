from dataclasses import replace

import pytest
from handmade import FULL, mapped_like, measurement_like, result_like

from slimsfm.evaluation.comparison import summarize_domination


def test_dominating_sets_are_summarized_by_method():
    plain = result_like("toy", measurement_like(FULL, [0.01]))
    sizes = [(10, 2, 40), (20, 3, 50), (40, 10, 90)]
    objects = [
        replace(
            plain,
            maps=(
                mapped_like("sift", references=references, chosen=chosen, dominating_points=points),
                mapped_like("aliked"),
            ),
        )
        for references, chosen, points in sizes
    ]
    sift, aliked = summarize_domination(objects)
    assert (sift.method, sift.objects, sift.smallest, sift.largest) == ("sift", 3, 2, 10)
    assert sift.mean == pytest.approx(5.0)
    assert sift.images_kept_mean == pytest.approx((0.2 + 0.15 + 0.25) / 3)
    assert sift.images_kept_median == pytest.approx(0.2)
    assert sift.points_kept_mean == pytest.approx(0.6)
    assert sift.points_kept_median == pytest.approx(0.5)
    assert aliked.method == "aliked"
    assert aliked.to_json()["points_kept_mean"] == pytest.approx(0.4)


def test_without_objects_there_is_no_summary():
    assert summarize_domination([]) == []
