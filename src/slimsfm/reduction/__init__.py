"""Reduction of a map: choose images or points to keep, and predict what that costs."""

from slimsfm.reduction.choice import (
    Candidate,
    Choice,
    ErrorGrowth,
    Frontier,
    apply_choice,
    points_seen,
)
from slimsfm.reduction.disturbance import Conditions
from slimsfm.reduction.forecast import Prediction, Trials
from slimsfm.reduction.growth import Growth, predict_growth
from slimsfm.reduction.image_sets import (
    DominatingSetOptions,
    dominating_set,
    image_order,
    images_within,
    keep_random_images,
)
from slimsfm.reduction.limits import ReductionLimits, recommend
from slimsfm.reduction.pareto import USES, FrontierOptions, GraphProvider, forecast_images, frontier
from slimsfm.reduction.reduced import ImageOptions, Reduced, ReduceOptions, reduce
from slimsfm.reduction.repetition import repeated_options, with_parent
from slimsfm.reduction.speed import Speed, measure_speed

__all__ = [
    "USES",
    "Candidate",
    "Choice",
    "Conditions",
    "DominatingSetOptions",
    "ErrorGrowth",
    "Frontier",
    "FrontierOptions",
    "GraphProvider",
    "Growth",
    "ImageOptions",
    "Prediction",
    "ReduceOptions",
    "Reduced",
    "ReductionLimits",
    "Speed",
    "Trials",
    "apply_choice",
    "dominating_set",
    "forecast_images",
    "frontier",
    "image_order",
    "images_within",
    "keep_random_images",
    "measure_speed",
    "points_seen",
    "predict_growth",
    "recommend",
    "reduce",
    "repeated_options",
    "with_parent",
]
