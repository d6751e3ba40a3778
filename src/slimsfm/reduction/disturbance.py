"""What blur and occlusion do to a query, applied to the matches of a clean one.

Queries in use are not as clean as the photos of a map. No image is read here: a disturbance removes matches
and moves keypoints as disturbed photos were measured to lose and move them.

`benchmarks/rough_queries.py` measures the parameters, on photos of a building and of an object, every third a
query. Of the right matches with the points of the map, by the scale s of the keypoint in pixels, there remain

    s                    < 1    1    1.5    2     3     4     6 and more
    1.5 px of blur      0.00  0.03  0.24  0.48  0.73  0.80  0.90
    3 px of blur        0.00  0.00  0.00  0.03  0.25  0.48  0.73

(means of the scenes, which differ by 0.02 to 0.2). Twice the blur removes keypoints twice as large, so the
odds depend on s over sigma alone: they are its cube, and even at 1.7 sigma. What remains moves by 0.18 to
0.23 sigma. Of the wrong matches, 0.52 to 0.86 remain where 0.31 to 0.38 of the right ones do, because other
keypoints replace lost ones. With 40 % hidden, 0.53 to 0.75 of the right and 0.72 to 1.06 of the wrong remain.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float64, Int64

from slimsfm.arrays import Mask

Conditions = Literal["clean", "rough"]
"""Which queries a reduced map is for: as clean as its photos, or blurred and partly hidden ones too."""

GOLDEN = (5**0.5 - 1) / 2
"""Its multiples fill the unit interval evenly."""

_SQUARE_ROOT = 2**0.5  # as GOLDEN, but unrelated to it
_HALF_KEPT = 1.7  # scale of a keypoint over sigma of the blur at which half of the right matches remain
_STEEPNESS = 3.0  # exponent of their odds
_MOVED = 0.2  # pixels per pixel of blur
_REPLACED = 0.6  # share of the wrong matches of lost keypoints that remain or are replaced by others
_TYPICAL_SCALE = 2.0  # pixels, of keypoints whose scale is not known


def check_conditions(conditions: str) -> None:
    """Check the name of conditions.

    Raises:
        ValueError: It is unknown.
    """
    if conditions not in get_args(Conditions):
        raise ValueError(f"conditions must be one of {', '.join(get_args(Conditions))}, got {conditions!r}")


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """How a query differs from a clean photo."""

    name: str
    """Name in tables."""

    blur_px: float = 0.0
    """Sigma of a Gaussian blur, in pixels in which features are found."""

    hidden: float = 0.0
    """Share of the image that is hidden, from one side."""


ROUGH = (
    Disturbance(name="1.5 px of blur", blur_px=1.5),
    Disturbance(name="40 % hidden", hidden=0.4),
)
"""The disturbances of rough conditions."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Keypoints:
    """The keypoints of a query."""

    pixels: Float64[np.ndarray, "n 2"]
    """Pixels in which features are found."""

    scales: Float64[np.ndarray, " n"] | None
    """Scale of each keypoint in these pixels; None if the extractor has none."""

    size: tuple[int, int]
    """Width and height of the image in these pixels."""


def remaining(keypoints: Keypoints, disturbance: Disturbance, test: int) -> Mask:
    """Decide which keypoints of a query are still found and described alike.

    Args:
        keypoints: The keypoints of the clean query.
        disturbance: What happens to the query.
        test: Number of the query; it determines what is hidden and which keypoints the blur removes.
    """
    found = np.ones(len(keypoints.pixels), bool)
    if disturbance.blur_px > 0:
        chance = np.random.default_rng((test, 1)).random(len(found))
        found &= chance < kept_by_blur(keypoints.scales, disturbance.blur_px)
    if disturbance.hidden > 0:
        found &= ~_hidden(keypoints, disturbance.hidden, test)
    return found


def kept_by_blur(
    scales: Float64[np.ndarray, " n"] | None, blur_px: float
) -> Float64[np.ndarray, " n"] | float:
    """Probability that a keypoint of a scale in pixels (None: unknown) still matches what it matched."""
    relative = np.maximum(_TYPICAL_SCALE if scales is None else scales, 1e-6) / (_HALF_KEPT * blur_px)
    return 1 / (1 + relative**-_STEEPNESS)


def _hidden(keypoints: Keypoints, share: float, test: int) -> Mask:
    """Keypoints on one side of a line that cuts this share off the image, at an angle of the test's own."""
    angle = 2 * np.pi * (test * _SQUARE_ROOT % 1)
    towards = np.array([np.cos(angle), np.sin(angle)])
    pixels = np.stack(np.meshgrid(*(np.linspace(0, side, 64) for side in keypoints.size)), axis=-1)
    return keypoints.pixels @ towards < np.quantile(pixels @ towards, share)


def disturbed(
    keypoints: Keypoints,
    rows: Int64[np.ndarray, " m"],
    wrong: Mask,
    disturbance: Disturbance,
    test: int,
) -> tuple[Mask, Float64[np.ndarray, "m 2"]]:
    """Disturb the matches of a query.

    Args:
        keypoints: The keypoints of the clean query.
        rows: The keypoint of each match.
        wrong: Whether each match contradicts the query's true pose.
        disturbance: What happens to the query.
        test: Number of the query; the same test is always disturbed in the same way.

    Returns:
        Which matches remain, and the pixels of all of them.
    """
    generator = np.random.default_rng((test, 2))
    moves = generator.normal(0, 1, keypoints.pixels.shape) * _MOVED * disturbance.blur_px
    replaced = generator.random(len(keypoints.pixels)) < _REPLACED
    found = remaining(keypoints, disturbance, test)
    return found[rows] | (wrong & replaced[rows]), (keypoints.pixels + moves)[rows]
