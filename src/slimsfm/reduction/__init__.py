"""From a map to a slim one, and what that costs, told beforehand."""

from slimsfm.reduction.choice import Candidate, Choice, Maker, points_seen
from slimsfm.reduction.forecast import Prediction, Trials
from slimsfm.reduction.frontier import USES, Frontier, FrontierOptions, Weigh, frontier, try_images
from slimsfm.reduction.images import (
    Reduction,
    ReductionOptions,
    dominating_set,
    image_order,
    images_within,
    keep_random_images,
    reduce_map,
)
from slimsfm.reduction.recommend import Wish, recommend

__all__ = [
    "USES",
    "Candidate",
    "Choice",
    "Frontier",
    "FrontierOptions",
    "Maker",
    "Prediction",
    "Reduction",
    "ReductionOptions",
    "Trials",
    "Weigh",
    "Wish",
    "dominating_set",
    "frontier",
    "image_order",
    "images_within",
    "keep_random_images",
    "points_seen",
    "recommend",
    "reduce_map",
    "try_images",
]
