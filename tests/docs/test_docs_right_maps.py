"""The numbers on the page about right maps match the code."""

from pathlib import Path

import pytest

from slimsfm.localization import evidence
from slimsfm.mapping import camera_groups, choice, diagnosis, pair_subsets, parallax, quality, reconstruction
from slimsfm.mapping import support as measured

PAGE = " ".join((Path(__file__).parents[2] / "docs" / "right-maps.md").read_text(encoding="utf-8").split())


@pytest.mark.parametrize(
    ("words", "value"),
    [
        ("within {:g} px of its epipolar line", measured._MAX_ERROR_PX),
        ("photos of more than {:g} px", measured._FULL_SIZE),
        ("fewer than {:.0%} of the matches agree", measured.MIN_AGREEING),
        ("joined if they have at least {} points in common", quality.MIN_COMMON_POINTS),
        ("within {:g} of the distance to the points", measured._CLOSE),
        ("moves {:.0%} of the matches", parallax._EXPLAINED),
        ("to within {:.1%} of the longer side", parallax._MAX_ERROR),
        ("If rotations explain {:.0%} of the pairs", quality.WITHOUT_PARALLAX),
        ("between {:g} and", quality._MIN_FOCAL),
        ("and {:g} times the longer side", quality._MAX_FOCAL),
        ("the focal lengths of {:.0%} of the photos", camera_groups._LEAST_SHARE),
        ("differ by more than {:.0%}", camera_groups._OFF),
        ("leave a gap of {:.0%}", camera_groups._GAP),
        ("or {:.0%} more observations", choice._MORE - 1),
        ("it has {:.0%} of the photos", reconstruction._MOST),
        ("up to {} apart, then from direct neighbors", reconstruction._OVERLAPS[0]),
        ("matches cover {:.0%} of what all keypoints cover", pair_subsets._LEAST_COVERAGE),
        ("that have {:.0%} of the photos that the contradicted models had", reconstruction._ENOUGH),
        ("if {:.0%} of them lack it", diagnosis._COMMON),
        ("mean gray below {}", diagnosis._DARK),
        ("overexposed (above {})", diagnosis._BRIGHT),
        ("fewer than {} features", diagnosis._FEW),
        ("{:.0%} of the [confidence]", evidence._DOUBTED),
    ],
)
def test_the_limits_match_the_code(words, value):
    assert words.format(value).replace("%", " %") in PAGE


def test_what_is_counted_in_words_matches_the_code():
    assert measured._NEIGHBOR_SHARE == 0.5
    assert "at least half as many verified matches as the strongest pair" in PAGE
    assert (camera_groups._ITERATIONS, camera_groups._LEAST) == (10, 2)
    assert "for ten steps of bundle adjustment" in PAGE
    assert (pair_subsets._PER_IMAGE, choice._SMALLEST_OTHER) == (2, 5)
    assert "the two strongest pairs of each image" in PAGE
    assert "at least five photos" in PAGE
