"""A few points that tell where in a map a query may be: each reference image sees some of them."""

import numpy as np

from slimsfm.arrays import Ids
from slimsfm.mapping.map import Map, observed

_AN_IMAGE = 60  # landmarks that each image sees, if it sees as many points
_MOST = 1000  # landmarks of a map


def choose_landmarks(map: Map) -> Ids:
    """Rows of the landmarks, ascending: the points most often observed, until each image sees enough.

    A point that only images observe which see enough landmarks already is passed over. O(observations).
    """
    seen_by = observed(map).T.tocsr()
    order = np.argsort(-np.diff(seen_by.indptr), kind="stable")
    counts = np.zeros(len(map.images), np.int64)
    chosen: list[int] = []
    for point in order.tolist():
        images = seen_by.indices[seen_by.indptr[point] : seen_by.indptr[point + 1]]
        if np.any(counts[images] < _AN_IMAGE):
            chosen.append(point)
            counts[images] += 1
            if len(chosen) == _MOST or counts.min() >= _AN_IMAGE:
                break
    return np.array(sorted(chosen), np.int64)
