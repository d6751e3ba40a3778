import pytest

from slimsfm.report.words import headline, number, size


@pytest.mark.parametrize(
    ("num_bytes", "text"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (1000, "1.0 kB"),
        (1_102_000, "1.1 MB"),
        (24_000_000, "24 MB"),
        (999_700, "1.0 MB"),
        (3.2e12, "3200 GB"),
    ],
)
def test_sizes_are_said_in_fitting_units(num_bytes, text):
    assert size(num_bytes) == text


def test_counts_and_means_of_counts():
    assert [number(8123), number(8123.0), number(2.5)] == ["8,123", "8,123", "2.5"]


def test_the_headline_compares_equal_strategies(full, reduced, make_row):
    rows = [
        make_row("full", strategy="direct"),
        make_row("full", match=1.396, add=98.0),
        make_row("random", match=0.001),
        make_row("dominating", match=0.096, map_bytes=1.1e6),
    ]
    assert headline(full, reduced, rows) == (
        "4 images, 30 points, 24 MB → 1 image, 20 points, 1.1 MB; "
        "ADD-0.1d 98.0 % → 97.0 %, matching and pose 14× faster."  # noqa: RUF001
    )


def test_the_headline_owns_up_to_a_loss(full, reduced, make_row):
    slower = headline(full, reduced, [make_row("full", match=0.096), make_row("dominating", match=0.146)])
    assert slower.endswith("matching and pose 1.5× slower.")  # noqa: RUF001
    same = headline(full, reduced, [make_row("full"), make_row("dominating")])
    assert same.endswith("matching and pose equally fast.")


def test_without_a_row_of_each_map_the_headline_counts_alone(full, reduced, make_row):
    for rows in ([], [make_row("full")], [make_row("full", strategy="direct"), make_row("dominating")]):
        assert headline(full, reduced, rows) == "4 images, 30 points → 1 image, 20 points."
