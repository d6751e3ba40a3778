"""A custom matcher: two features match if each would most likely choose the other."""

import numpy as np

from slimsfm.features import Features, unit_rows

TEMPERATURE = 0.02  # smaller values favor the nearest neighbor more strongly
THRESHOLD = 0.2  # least product of the two probabilities


class SoftmaxMatcher:
    """Matches by a dual softmax over cosines."""

    def __init__(self, features: str) -> None:
        """Accept features of any extractor; a trained matcher would reject unknown ones."""
        if features == "loftr":
            raise ValueError("features must be of an extractor with keypoints; loftr finds none")

    def match(self, features1: Features, features2: Features) -> np.ndarray:
        """Return pairs (row of features1, row of features2), sorted by the first; each row at most once."""
        if not len(features1) or not len(features2):
            return np.zeros((0, 2), np.int64)
        cosines = unit_rows(features1.descriptors) @ unit_rows(features2.descriptors).T
        weights = np.exp((cosines - 1) / TEMPERATURE)
        forth = weights / (weights.sum(axis=1, keepdims=True) + 1e-12)
        back = weights / (weights.sum(axis=0, keepdims=True) + 1e-12)
        probabilities = forth * back
        best = probabilities.argmax(axis=1)
        rows = np.arange(len(best))
        mutual = probabilities.argmax(axis=0)[best] == rows
        rows = rows[mutual & (probabilities[rows, best] > THRESHOLD)]
        return np.stack([rows, best[rows]], axis=1)
