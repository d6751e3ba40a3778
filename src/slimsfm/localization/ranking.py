"""Which reference images resemble a query."""

import numpy as np
from jaxtyping import Float32

from slimsfm.arrays import Descriptors
from slimsfm.features.vlad import vlad
from slimsfm.mapping.descriptors import describe_images
from slimsfm.mapping.map import Map

_STRONGEST = 2048  # keypoints that tell what a query looks like


class Ranking:
    """Compares a query with all reference images at once, by global descriptors."""

    def __init__(self, map: Map) -> None:
        self._global_descriptors = map.global_descriptors or describe_images(map)

    def similarities(self, descriptors: Descriptors) -> Float32[np.ndarray, " references"]:
        """Cosine between a query's global descriptor and that of each reference image, in order of name.

        Args:
            descriptors: What the query looks like, the strongest keypoints first.
        """
        return self._global_descriptors.descriptors @ vlad(
            descriptors[:_STRONGEST], self._global_descriptors.vocabulary
        )
