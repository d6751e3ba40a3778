import re
from dataclasses import replace

import numpy as np

from slimsfm.evaluation.results import Outcomes
from slimsfm.report.failures import failures_html, query_changes, worst_and_others
from slimsfm.report.report_data import load_report_data


def outcomes_like(outcomes: Outcomes, errors, confidences) -> Outcomes:
    return replace(outcomes, error=np.array(errors), confidence=np.array(confidences))


def with_outcomes(result, key, errors, confidences):
    """The object with other outcomes in one cell."""
    cells = [
        replace(
            cell,
            map_runs=(replace(cell.map_runs[0], outcomes=outcomes_like(cell.outcomes, errors, confidences)),),
        )
        if cell.key == key
        else cell
        for cell in result.measurements
    ]
    return replace(result, measurements=tuple(cells))


def test_queries_that_only_one_map_localizes_are_lost_or_gained(run):
    can = run.objects[0]
    before, after = ("sift", "exhaustive", "full"), ("sift", "direct", "default")
    can = with_outcomes(can, before, [0.01, 0.01, 0.3], [0.99, 0.99, 0.5])
    can = with_outcomes(can, after, [0.01, np.inf, 0.02], [0.99, np.nan, 0.8])
    line = load_report_data(replace(run, objects=(can,))).headlines("can")[0]
    assert (line.before, line.after) == (before, after)
    names = [query.path.name for query in can.queries]
    found = {one.query: one.verdict for one in query_changes(can, line)}
    assert found == {names[1]: "lost", names[2]: "gained"}


def test_a_confident_wrong_pose_is_listed_even_if_the_full_map_fails_too(run):
    can = run.objects[0]
    can = with_outcomes(can, ("sift", "exhaustive", "full"), [0.5, 0.5, 0.01], [0.5, 0.5, 0.99])
    can = with_outcomes(can, ("sift", "direct", "default"), [0.5, 0.5, 0.4], [0.95, 0.5, 0.99])
    line = load_report_data(replace(run, objects=(can,))).headlines("can")[0]
    assert [one.verdict for one in query_changes(can, line)] == [
        "confident but wrong",
        "lost, confident but wrong",
    ]


def test_the_section_counts_over_all_objects_and_lists_each(run):
    html = failures_html(load_report_data(run))
    assert "Default map, direct, compared with the full map, exhaustive: of 7 queries 2 lost; diff" in html
    assert "Dominating map, exhaustive, compared with the full map, exhaustive: of 7 queries 2 lost" in html
    assert not re.search(r"\b0 (lost|gained|wrong)", html)
    assert html.count("<td>lost</td>") == 4
    assert "not localized" in html


def test_where_nothing_fails_one_sentence_says_so_and_there_is_no_table(run):
    can = run.objects[0]
    keys = [
        ("sift", "exhaustive", "full"),
        ("sift", "direct", "default"),
        ("sift", "exhaustive", "dominating"),
    ]
    for key in keys:
        can = with_outcomes(can, key, [0.01, 0.01, 0.01], [0.99, 0.99, 0.99])
    html = failures_html(load_report_data(replace(run, objects=(can,))))
    assert html.count("none of 3 queries lost or gained.") == 2
    assert "<table" not in html


def test_the_worst_queries_come_first_and_the_others_are_evenly_spaced():
    errors = np.full(20, 0.01)
    errors[[3, 7]] = [0.2, np.inf]
    shown = worst_and_others(errors, 6)
    assert shown[:2] == [7, 3]
    assert len(set(shown)) == 6
    assert max(shown) == 19


def test_few_queries_are_all_shown():
    assert worst_and_others(np.array([0.1, 0.3, 0.2]), 6) == [1, 2, 0]
