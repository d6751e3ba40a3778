"""What is read from damaged or hostile results is refused by name, or its tables and pages can be made."""

import copy
import json
import random
import shutil

import pytest

from commands import slimsfm
from mutations import mutations
from slimsfm.errors import InputError
from slimsfm.evaluation.formats import csv_queries, csv_table, latex_table, markdown_page
from slimsfm.evaluation.result_files import digest_of, read_run
from slimsfm.report.report_data import load_report_data

NASTY = (
    *(None, True, 0, -1, 0.5, 1e29, 1e308, 2**70, float("nan"), float("inf")),
    *("", "../x", "/abs", "a[b]\0", "\ud800", "full", "sift", [], {}, [[]], [None]),
)


@pytest.fixture
def path(run, tmp_path):
    shutil.copy(run.folder / "results.json", tmp_path / "results.json")
    return tmp_path / "results.json"


def all_tables(found):
    data = load_report_data(found)
    rows = [row for some in data.rows.values() for row in some]
    markdown_page(found, rows, data.comparisons)
    latex_table(rows, found.dataset)
    csv_table(rows)
    csv_queries(found.objects)
    return digest_of(found.objects)


def places(value, place=()):
    if place:
        yield place
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in list(inner)[:8]:
        yield from places(one, (*place, key))


def damaged_values(whole, seed, count):
    """Results in which one value is another one, missing or there twice."""
    read = {key: one for key, one in whole.items() if key not in ("rows", "comparisons", "dominating_sets")}
    known, draw = list(places(read)), random.Random(seed)
    for _ in range(count):
        place, data = draw.choice(known), copy.deepcopy(read)
        holder = data
        for key in place[:-1]:
            holder = holder[key]
        kind = draw.choice(("other", "other", "missing", "twice"))
        if kind == "missing":
            del holder[place[-1]]
        else:
            holder[place[-1]] = draw.choice(NASTY) if kind == "other" else [holder[place[-1]]] * 2
        yield f"{kind} {place}", json.dumps(data)


def test_one_wrong_value_is_refused_by_name_or_harmless(path):
    for name, text in damaged_values(json.loads(path.read_text()), seed=3, count=60):
        path.write_text(text)
        try:
            found = read_run(path)
        except InputError as error:
            if not str(error).startswith(f"{path}: "):
                pytest.fail(f"{name}: {error}")
        else:
            all_tables(found)


def test_wrong_bytes_are_refused_or_harmless(path):
    whole = path.read_bytes()
    for _, damaged in mutations(whole, seed=4, count=30):
        path.write_bytes(damaged)
        try:
            found = read_run(path)
        except InputError:
            continue
        all_tables(found)


@pytest.mark.parametrize("name", ["../escape", "/tmp/escape", "a/../../../escape", "", ".", "a\0b"])
@pytest.mark.parametrize("command", ["figures", "report"])
def test_names_of_objects_do_not_lead_out_of_the_output(run, tmp_path, command, name):
    folder = tmp_path / "run"
    shutil.copytree(run.folder, folder, ignore=shutil.ignore_patterns("photos"))
    data = json.loads((folder / "results.json").read_text())
    data["objects"][0]["name"] = name
    (folder / "results.json").write_text(json.dumps(data))
    outcome = slimsfm(command, folder, "-o", tmp_path / "out" / "here")
    assert outcome.code == 2
    assert outcome.err.count("\n") == 1
    assert "must be a name inside" in outcome.err
    assert [one.name for one in tmp_path.iterdir()] == ["run"]
