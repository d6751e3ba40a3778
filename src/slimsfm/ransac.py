"""How many hypotheses a random search needs."""

from math import ceil, log, log1p

_MISSED = 1e-4  # probability that the search misses a pose
_CAUTION = 3  # times more hypotheses, for not every one with inliers alone is good
_LEAST_SHARE = 1e-3  # of inliers that is worth a search


def hypotheses_to_try(inlier_share: float, sample_size: int) -> int:
    """How many random samples hold one without a wrong match, all but certainly, thrice over as in PoseLib.

    Args:
        inlier_share: Inliers among the matches.
        sample_size: Matches in a sample.
    """
    share = min(max(inlier_share, _LEAST_SHARE), 1 - _LEAST_SHARE)
    return ceil(_CAUTION * log(_MISSED) / log1p(-(share**sample_size)))
