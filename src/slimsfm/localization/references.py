"""The reference images of a map as strategies match with them."""

from collections.abc import Sequence

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64
from scipy.sparse import csr_array

from slimsfm.arrays import Descriptors
from slimsfm.localization.matching import ReferenceMatching, matching_with
from slimsfm.localization.strategy import MatchingOptions, PointMatches, Query, Target, unite
from slimsfm.mapping.map import Map, check_has_features, observed


class References:
    """The reference images of a map, in order of name, and how a query is matched with them."""

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:
        """Read the images.

        Raises:
            MapError: The map was made for direct matching alone.
            InputError: The matcher is unknown, or cannot match features of the map's kind.
        """
        check_has_features(map)
        self._matching: ReferenceMatching = matching_with(map, options)
        self._sees = csr_array(observed(map), dtype=np.float32)
        self._seen_by = csr_array(self._sees.T)
        self._center = map.box.center
        self._directions = np.array(
            [_direction(image.cam_from_world(), self._center) for image in map.images.values()]
        )
        self._counts = np.maximum(np.diff(self._sees.indptr), 1).astype(np.float32)

    def __len__(self) -> int:
        return len(self._counts)

    def match(
        self, query: Query, rows: Sequence[int] | None = None, strongest: int | None = None
    ) -> PointMatches:
        """Match a query with some images, or with all.

        Args:
            query: The query.
            rows: The images.
            strongest: So many of the query's keypoints take part, where these are matched one by one.
        """
        chosen = range(len(self)) if rows is None else rows
        return unite([self._matching.match(query, row, strongest) for row in chosen])

    def describe(self, query: Query) -> Descriptors:
        """What a query looks like, in terms of what the images are described by."""
        return self._matching.describe(query)

    def sharing(self, points: Int64[np.ndarray, " _"]) -> Float32[np.ndarray, " references"]:
        """How many of some points each image sees."""
        return np.asarray(self._seen_by[points].sum(axis=0), np.float32)

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """What one image sees, for a camera near it should see it too.

        It is the image that sees most of the points that agree with the pose; where these are not known, the
        one that looked at the object most nearly as the camera does.
        """
        if agreeing is not None:
            return self._matching.target(int(self.sharing(agreeing).argmax()))
        towards = _direction(cam_from_world, self._center)
        return self._matching.target(int((self._directions @ towards).argmax()))

    def known_from(self, rows: Sequence[int]) -> Float32[np.ndarray, " references"]:
        """Which share of its points each image has in common with some images."""
        known = (self._sees[list(rows)].sum(axis=0) > 0).astype(np.float32)
        return self._sees @ known / self._counts


def _direction(
    cam_from_world: pycolmap.Rigid3d, center: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    towards = cam_from_world.inverse().translation - center
    return towards / max(float(np.linalg.norm(towards)), 1e-12)
