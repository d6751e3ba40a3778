"""A query in the pixels in which its features were found."""

from dataclasses import replace
from typing import NamedTuple

import pycolmap

from slimsfm.geometry import resized_camera
from slimsfm.localization.strategy import PointMatches, Query


class Shrunk(NamedTuple):
    """Matches in pixels in which keypoints were found, because that is what limits in pixels are for."""

    query: Query
    matches: PointMatches
    camera: pycolmap.Camera
    whole: pycolmap.Camera
    factor: float

    @classmethod
    def of(cls, query: Query, matches: PointMatches, camera: pycolmap.Camera) -> "Shrunk":
        """Shrink matches as much as the image was shrunk in which they were found."""
        factor = min(query.shrink_factor, max(matches.shrink_factor, 1.0))
        if factor == 1:
            return cls(query, matches, camera, camera, factor)
        if matches.points2D is not None:
            matches = replace(matches, points2D=matches.points2D / factor)
        small = resized_camera(camera, 1 / factor)
        return cls(
            replace(query, keypoints=query.keypoints / factor, camera=small), matches, small, camera, factor
        )

    def enlarged(self, estimated: pycolmap.Camera) -> pycolmap.Camera:
        """The intrinsics of the image, from those that were estimated for the shrunk one."""
        if self.factor == 1:
            return estimated
        enlarged = resized_camera(estimated, self.factor)
        enlarged.width, enlarged.height = self.whole.width, self.whole.height
        return enlarged
