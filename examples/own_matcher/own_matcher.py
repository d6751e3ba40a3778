"""A matcher of one's own: two features match where each would most probably choose the other."""

import numpy as np

from slimsfm.features import Features, unit_rows

TEMPERATURE = 0.02  # the smaller, the surer must the nearest be
THRESHOLD = 0.2  # least product of both probabilities


class SoftmaxMatcher:
    """Matches by dual softmax over cosines."""

    def __init__(self, features: str) -> None:
        """Of features of any extractor; a trained matcher would refuse those that it was not trained for."""
        if features == "loftr":
            raise ValueError("features must be of an extractor, and loftr finds none")

    def match(self, features1: Features, features2: Features) -> np.ndarray:
        """Pairs (row of features1, row of features2), sorted by the first; no row occurs twice."""
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
