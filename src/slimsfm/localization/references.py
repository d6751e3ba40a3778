"""The reference images of a map as strategies match with them."""

from collections.abc import Sequence

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64
from scipy.sparse import csr_array

from slimsfm.arrays import Descriptors
from slimsfm.features import NearestOptions, match_nearest, unit_rows
from slimsfm.localization.strategy import PointMatches, Target, unite
from slimsfm.mapping.map import Map, check_has_features, observed


class References:
    """Of each reference image, in order of name, its keypoints that see a point of the map.

    A match to any other keypoint gives the pose nothing.
    """

    def __init__(self, map: Map) -> None:
        """Read the images.

        Raises:
            MapError: The map was made for direct matching alone.
        """
        check_has_features(map)
        self.targets = [reference_target(map, name) for name in map.observations]
        self._sees = csr_array(observed(map), dtype=np.float32)
        self._seen_by = csr_array(self._sees.T)
        self._center = map.box.center
        self._directions = np.array(
            [_direction(image.cam_from_world(), self._center) for image in map.images.values()]
        )
        self._counts = np.maximum(np.diff(self._sees.indptr), 1).astype(np.float32)

    def __len__(self) -> int:
        return len(self.targets)

    def sharing(self, points: Int64[np.ndarray, " _"]) -> Float32[np.ndarray, " references"]:
        """How many of some points each image sees."""
        return np.asarray(self._seen_by[points].sum(axis=0), np.float32)

    def expected(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """What one image sees, for a camera near it should see it too.

        It is the image that sees most of the points that agree with the pose; where these are not known, the
        one that looked at the object most nearly as the camera does.
        """
        if agreeing is not None:
            return self.targets[int(self.sharing(agreeing).argmax())]
        towards = _direction(cam_from_world, self._center)
        return self.targets[int((self._directions @ towards).argmax())]

    def known_from(self, rows: Sequence[int]) -> Float32[np.ndarray, " references"]:
        """Which share of its points each image has in common with some images."""
        known = (self._sees[list(rows)].sum(axis=0) > 0).astype(np.float32)
        return self._sees @ known / self._counts


def _direction(
    cam_from_world: pycolmap.Rigid3d, center: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    towards = cam_from_world.inverse().translation - center
    return towards / max(float(np.linalg.norm(towards)), 1e-12)


def reference_target(map: Map, name: str) -> Target:
    """What to match of a reference image."""
    seen = map.observations[name]
    return unit_rows(map.features[name].descriptors[seen.rows]), seen.points


def match_targets(
    descriptors: Descriptors, targets: Sequence[Target], matching: NearestOptions = NearestOptions()
) -> PointMatches:
    """Match a query's descriptors against one target after the other and unite the matches."""
    parts = [match_target(descriptors, target, matching) for target in targets]
    return unite(parts, references=len(targets))


def match_target(
    descriptors: Descriptors, target: Target, matching: NearestOptions
) -> Int64[np.ndarray, "_ 2"]:
    """Pairs (row of the query's descriptors, row of the map's points)."""
    target_descriptors, points = target
    pairs = match_nearest(descriptors, target_descriptors, matching)
    pairs[:, 1] = points[pairs[:, 1]]
    return pairs
