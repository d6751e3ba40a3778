"""How the evidence for a pose is weighed, by the extractor of its features.

Descriptors of extractors differ in how many matches are wrong and how exact keypoints are, so what a share of
inliers is worth differs too. `benchmarks/confidence.py` learns weights and measures what they are worth.
"""

import numpy as np
from jaxtyping import Float64

EVIDENCE_WEIGHTS = {
    "sift": np.array([2.87, 0.18, 0.27, 0.17, 0.99, 1.01, 0.96, 0.26, 1.36, 3.16, 0.09]),
    "xfeat": np.array([1.66, 0.32, 0.54, 0.4, 0.57, 0.97, 1.04, 0.29, 0.86, 2.77, 0.14]),
}
"""Weights of `Evidence.terms` by extractor; all others use SIFT's, which suffice for ALIKED."""

CALIBRATED = frozenset({"aliked", "sift", "xfeat"})
"""Extractors whose confidences were compared with true poses; those of others are what SIFT's would be."""


def evidence_weights(extractor: str) -> Float64[np.ndarray, " terms"]:
    """Weights of the evidence for poses by features of this extractor."""
    return EVIDENCE_WEIGHTS.get(extractor, EVIDENCE_WEIGHTS["sift"])
