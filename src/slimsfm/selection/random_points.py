"""Points at random: what every other selector must beat."""

import numpy as np

from slimsfm.arrays import Ids
from slimsfm.selection.problem import SelectionProblem, check_count


def random_points(problem: SelectionProblem, count: int, *, seed: int = 0) -> Ids:
    """Draw points uniformly, without replacement, from those that any image can use.

    Args:
        problem: The points and who can use them.
        count: How many points are wanted.
        seed: Equal problems and seeds give equal points; a smaller count gives a beginning of them.

    Returns:
        Points in the order of the draw.

    Raises:
        ValueError: `count` is not positive.
    """
    check_count(count)
    usable = np.flatnonzero(np.diff(problem.images_of.starts))
    return np.random.default_rng(seed).permutation(usable)[:count]
