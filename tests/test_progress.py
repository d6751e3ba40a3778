import re
import time
from io import StringIO

import pytest
from rich.console import Console

from slimsfm.progress import PlainLines, TerminalBars, counted, shown, silent, single_step


def terminal():
    return Console(file=StringIO(), force_terminal=True, width=100, color_system=None)


def drawn(console):
    """What a terminal was sent, without control sequences."""
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]|\r", "", console.file.getvalue())


@pytest.mark.parametrize(
    "progress",
    [silent, shown, PlainLines(), TerminalBars(terminal())],
    ids=["silent", "shown", "lines", "bars"],
)
@pytest.mark.parametrize("items", [[], ["a"], ["a", "b", "c"]])
def test_items_are_unchanged(progress, items):
    assert list(progress(items, "work")) == items


def test_without_a_terminal_start_and_end_of_a_stage_are_lines_with_counts_and_seconds(capsys):
    list(shown(range(28), "match pairs"))
    out, err = capsys.readouterr()
    assert out == ""
    first, last = err.splitlines()
    assert first == "match pairs: 0 of 28"
    assert re.fullmatch(r"match pairs: 28 of 28 in \d+\.\d s", last)


def test_an_empty_loop_shows_nothing(capsys):
    assert list(shown([], "localize")) == []
    assert capsys.readouterr() == ("", "")


def test_without_a_terminal_lines_inside_a_stage_have_rate_and_time_left(capsys):
    for item in PlainLines(interval_s=0.1)(range(4), "localize"):
        time.sleep(0.4 if item == 3 else 0.01)
    _, *inside, _ = capsys.readouterr().err.splitlines()
    assert len(inside) >= 2
    assert re.fullmatch(r"localize: 3 of 4, [\d.e+]+/s, \d+ s left", inside[-1])


def test_without_a_terminal_a_stage_that_has_done_nothing_so_far_says_so(capsys):
    for _ in PlainLines(interval_s=0.05)(range(2), "localize"):
        time.sleep(0.2)
        break
    assert "localize: 0 of 2 after 0 s" in capsys.readouterr().err.splitlines()


def test_the_default_interval_is_half_a_minute():
    assert PlainLines().interval_s == 30


def test_a_single_step_is_not_counted(capsys):
    with single_step(PlainLines(interval_s=0.05), "reconstruct globally"):
        time.sleep(0.2)
    first, *inside, last = capsys.readouterr().err.splitlines()
    assert first == "reconstruct globally: started"
    assert set(inside) == {"reconstruct globally: running for 0 s"}
    assert re.fullmatch(r"reconstruct globally: done after \d+\.\d s", last)


def test_a_step_that_fails_is_not_done(capsys):
    with pytest.raises(ValueError, match="no"), single_step(PlainLines(), "reconstruct"):
        raise ValueError("no")
    assert capsys.readouterr().err.splitlines()[-1].startswith("reconstruct: stopped after ")


def test_counts_reported_from_elsewhere_never_go_back_nor_beyond_the_total(capsys):
    with counted(PlainLines(), 8, "register images") as advance_to:
        for done in (2, 5, 2, 3, 6):
            advance_to(done)
    assert re.fullmatch(r"register images: 6 of 8 in .* s", capsys.readouterr().err.splitlines()[-1])
    with counted(PlainLines(), 8, "register images") as advance_to:
        advance_to(20)
    assert re.fullmatch(r"register images: 8 of 8 in .* s", capsys.readouterr().err.splitlines()[-1])


def test_counts_work_with_any_progress_bar():
    seen = []

    def record(items, label):
        for item in items:
            seen.append((label, item))
            yield item

    with counted(record, 3, "pairs") as advance_to:
        advance_to(2)
    assert seen == [("pairs", 0), ("pairs", 1), ("pairs", 2)]
    with counted(silent, 3, "pairs") as advance_to:
        advance_to(3)


def test_on_a_terminal_a_bar_shows_counts_and_goes_when_it_is_done():
    console = terminal()
    for _ in TerminalBars(console)(range(3), "extract features"):
        time.sleep(0.15)
    assert re.search(r"extract features .*[12]/3", drawn(console))
    assert console.file.getvalue().count("extract features") > 1
    assert not drawn(console).rstrip("\n").endswith("3/3")


def test_on_a_terminal_a_single_step_shows_seconds_instead_of_counts():
    console = terminal()
    with single_step(TerminalBars(console), "reconstruct globally"):
        time.sleep(0.2)
    assert re.search(r"reconstruct globally .*0 s", drawn(console))
    assert "0/1" not in drawn(console)


def test_on_a_terminal_a_loop_inside_a_loop_has_a_bar_of_its_own():
    console = terminal()
    bars = TerminalBars(console)
    for _ in bars(range(2), "objects"):
        for _ in bars(range(2), "queries"):
            time.sleep(0.15)
    assert re.search(r"objects .*0/2.*\n.*queries .*[01]/2", drawn(console))
    list(bars(range(2), "again"))
