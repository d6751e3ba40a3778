import csv
import io
import re
from dataclasses import replace

import numpy as np
import pytest
from handmade import DOMINATING, FULL, mapped_like, measurement_like, result_like, run_like

from slimsfm.evaluation.comparison import against_full, summarize_domination
from slimsfm.evaluation.formats import (
    csv_queries,
    csv_table,
    format_p_value,
    format_value,
    latex_table,
    markdown_comparisons,
    markdown_page,
    markdown_summaries,
    markdown_table,
)
from slimsfm.evaluation.table import (
    MAP_COLUMNS,
    all_rows,
    average_rows,
    format_bytes,
    format_number,
    is_metric,
    rows_of,
)

DASH, TIMES = "\N{EN DASH}", "\N{MULTIPLICATION SIGN}"
RANDOM = ("sift", "exhaustive", "random:k=2,rim")
AWKWARD = "0408_box & 50%|{x}~^$#\\"


@pytest.fixture(scope="module")
def run():
    """A metric object with an awkward name, one of unknown scale, and one that failed."""
    cells = [
        measurement_like(FULL, [0.01, 0.02, np.inf], references=1234, map_bytes=24_000_000),
        measurement_like(DOMINATING, [0.01, 0.2, 0.03]),
        measurement_like(RANDOM, [np.inf] * 3, [0.01, np.inf, 0.03]),
    ]
    objects = [result_like(AWKWARD, *cells), result_like("mug", *cells, unit="unknown")]
    return run_like(*objects, failed={"jar": "jar/box3d_corners.txt is missing"})


@pytest.fixture(scope="module")
def rows(run):
    return all_rows(run)


@pytest.fixture(scope="module")
def comparisons(run):
    return against_full(run.objects)


def cells_of(line):
    """The cells of a line of a Markdown table; an escaped bar is not a separator."""
    assert line.startswith("|")
    assert line.endswith("|")
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def tables_in(text):
    """The Markdown tables of a text, each as its lines."""
    return [block.splitlines() for block in re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE)]


def test_every_line_of_a_markdown_table_has_the_same_number_of_cells(run, rows, comparisons):
    texts = {
        markdown_table(rows): len(rows),
        markdown_comparisons(comparisons): len(comparisons),
        markdown_summaries(summarize_domination(run.objects)): 1,
    }
    for text, count in texts.items():
        (lines,) = tables_in(text)
        assert len(lines) == count + 2
        assert len({len(cells_of(line)) for line in lines}) == 1
        assert set(lines[1]) <= set("|- :")


def test_markdown_shows_values_with_the_interval_of_the_accuracy(run):
    (lines,) = tables_in(markdown_table(rows_of(run.objects[0])))
    shown_values = dict(zip(cells_of(lines[0]), cells_of(lines[2]), strict=True))
    assert shown_values["Map"] == "full"
    assert shown_values["Images"] == "1,234"
    assert shown_values["Map size"] == "24 MB"
    assert shown_values["ADD-0.1d"] == "66.7 [0.0, 100.0]"
    assert shown_values["5°-5cm"] == "66.7"
    assert shown_values["Match ms"] == "20.0"
    assert shown_values["FPS"] == "28.6"


def test_a_missing_value_is_a_dash(rows):
    (lines,) = tables_in(markdown_table(rows))
    header = cells_of(lines[0])
    rows = [dict(zip(header, cells_of(line), strict=True)) for line in lines[2:]]
    assert {row["5°-5cm"] for row in rows if row["Object"] == "mug"} == {DASH}
    assert DASH not in {row["5°-5cm"] for row in rows if row["Object"].startswith("0408")}


def test_without_a_metric_object_there_are_no_centimeter_columns(run):
    rows = rows_of(run.objects[1])
    assert not is_metric(rows)
    assert "cm" not in markdown_table(rows)
    assert "cm" not in latex_table(rows, "toys")


def test_comparisons_show_direction_and_uncertainty(run):
    (lines,) = tables_in(markdown_comparisons(against_full(run.objects[:1])))
    first = dict(zip(cells_of(lines[0]), cells_of(lines[2]), strict=True))
    assert first["Row"] == "sift, exhaustive, dominating"
    assert first["Baseline"] == "sift, exhaustive, full"
    assert first["ADD-0.1d"] == "66.7 → 66.7"
    assert first["p"] == "1.000"
    assert first["faster"] == f"1.0{TIMES} (1.0 to 1.0)"
    assert first["smaller"] == f"24000.0{TIMES}"


def test_small_probabilities_are_not_rounded_to_zero():
    assert [format_p_value(value) for value in (1.0, 0.05, 0.001, 0.00099, 0.0)] == [
        *("1.000", "0.050", "0.001"),
        *("< 0.001", "< 0.001"),
    ]


def test_a_value_without_an_interval_is_shown_alone(run):
    row = rows_of(run.objects[0])[0]
    assert format_value(row, MAP_COLUMNS[0], interval=True) == "1,234"


ENVIRONMENT = re.compile(r"\\(begin|end)\{([a-z*]+)\}")


def assert_balanced(latex):
    """Braces and environments open and close in order."""
    depth = 0
    for brace in re.sub(r"\\[{}\\]", "", latex):
        depth += {"{": 1, "}": -1}.get(brace, 0)
        assert depth >= 0
    assert depth == 0
    opened = []
    for what, name in ENVIRONMENT.findall(latex):
        if what == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert opened == []


def body_of(latex):
    """The lines of the tabular, as cells."""
    (body,) = re.findall(r"\\toprule\n(.*)\\bottomrule", latex, flags=re.DOTALL)
    lines = body.split("\\\\\n")
    return [[cell.strip() for cell in re.split(r"(?<!\\)&", line)] for line in lines[:-1]]


def test_latex_is_balanced_and_has_the_columns_of_the_papers_table(run):
    rows = rows_of(run.objects[0])
    latex = latex_table(rows, "TinyDataset toys_2")
    assert_balanced(latex)
    header, *lines = body_of(latex)
    assert header == [
        *("Method", "Images", "Points", "Map size"),
        *(f"{n}$^\\circ$-{n}cm" for n in (1, 3, 5)),
        *("ADD-0.1d", "FPS"),
    ]
    assert {len(line) for line in lines} == {len(header)}
    (columns,) = re.findall(r"\\begin\{tabular\}\{(.*)\}", latex)
    assert columns == "l" + "r" * (len(header) - 1)
    assert [line[-2] for line in lines] == ["66.7", "66.7", "33.3"]
    assert "\\caption{TinyDataset toys\\_2}" in latex


def test_latex_escapes_special_characters(rows):
    latex = latex_table(rows, "50 % of 3° at _")
    assert_balanced(latex)
    assert r"0408\_box \& 50\%|\{x\}\textasciitilde{}\^{}\$\#\textbackslash{}: sift" in latex
    assert r"\caption{50 \% of 3$^\circ$ at \_}" in latex
    assert latex.isascii()
    assert not re.search(r"(?<!\\)[%#]|(?<!\\)_", latex)


def test_latex_separates_objects_with_rules_and_names_variants(rows):
    latex = latex_table(rows, "toys")
    assert latex.count("\\midrule") == 1 + (4 - 1)  # below the header; two averages and two objects
    assert "mug: sift, exhaustive &" in latex
    assert "mug: sift, exhaustive [dominating] &" in latex


def test_csv_parses_back_to_equal_values(rows):
    lines = list(csv.DictReader(io.StringIO(csv_table(rows))))
    assert len(lines) == len(rows)
    for row, line in zip(rows, lines, strict=True):
        values = row.to_json()
        assert set(values) <= set(line)
        for key, text in line.items():
            value = values.get(key)
            assert text == "" if value is None else type(value)(text) == value


def test_the_csv_of_queries_has_every_query_of_every_draw(run):
    lines = list(csv.DictReader(io.StringIO(csv_queries(run.objects))))
    assert len(lines) == 2 * (3 + 3 + 2 * 3)
    wanted = [
        (result, cell, draw, trial.outcomes, i)
        for result in run.objects
        for cell in result.measurements
        for draw, trial in enumerate(cell.map_runs)
        for i in range(3)
    ]
    for line, (result, cell, draw, outcomes, i) in zip(lines, wanted, strict=True):
        key = (line["method"], line["strategy"], line["variant"])
        assert (line["object"], key, int(line["draw"])) == (result.name, cell.key, draw)
        assert line["query"] == f"{i}.png"
        for name in ("error", "rotation_deg", "translation", "confidence"):
            assert float(line[name]) == pytest.approx(getattr(outcomes, name)[i], rel=0, abs=0, nan_ok=True)
        assert int(line["references_tried"]) == outcomes.references[i]
        assert [float(line[f"s_{stage}"]) for stage in ("extract", "match", "pose")] == [0.01, 0.02, 0.005]


def test_without_objects_there_are_no_queries():
    assert csv_queries([]) == "\n"


def test_the_page_has_all_tables(run, rows, comparisons):
    page = markdown_page(run, rows, comparisons)
    assert page.startswith("# TinyDataset toys\n")
    assert "**jar failed**: jar/box3d_corners.txt is missing" in page
    assert "- cpu: abacus\n- python: 3.99\n" in page
    assert [len(table) - 2 for table in tables_in(page)] == [len(rows), len(comparisons), 1]
    assert "failed" not in markdown_page(replace(run, failed={}), rows, comparisons)


def test_averages_come_first(run, rows):
    assert rows[:6] == average_rows(run.objects)
    assert [row.object for row in rows[6:]] == [AWKWARD] * 3 + ["mug"] * 3
    assert all_rows(replace(run, objects=run.objects[:1])) == rows_of(run.objects[0])


def test_sizes_of_dominating_sets_are_shown(run):
    wide = replace(run.objects[0], maps=(mapped_like("sift", references=40, chosen=4, dominating_points=25),))
    (lines,) = tables_in(markdown_summaries(summarize_domination([wide, run.objects[1]])))
    assert cells_of(lines[2]) == ["sift", "2", "2", "3.00", "4", "0.150", "0.150", "0.325", "0.325"]


def test_counts_and_sizes_have_a_suitable_unit():
    assert [format_number(value) for value in (7.0, 12_345.0, 3.25)] == ["7", "12,345", "3.2"]
    assert [format_bytes(value) for value in (0, 999, 1000, 9_949, 24e6, 999.6e6, 5e12)] == [
        *("0 B", "999 B", "1.0 kB", "9.9 kB", "24 MB", "1.0 GB", "5000 GB"),
    ]
