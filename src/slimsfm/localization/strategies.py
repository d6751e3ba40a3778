"""The strategies: direct, exhaustive, retrieval as in hierarchical localization [1], and progressive.

References:
    [1] Sarlin, Cadena, Siegwart and Dymczyk, From Coarse to Fine: Robust Hierarchical Localization at Large
        Scale, CVPR 2019.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64
from scipy.sparse import csr_array

from slimsfm.arrays import Descriptors, Ids
from slimsfm.features import unit_rows
from slimsfm.features.nearest import vlad
from slimsfm.localization.appearances import descriptor_sums
from slimsfm.localization.matching import ReferenceMatching, match_target, matching_with
from slimsfm.localization.point_descriptors import describe_appearances
from slimsfm.localization.strategy import MatchingOptions, PointMatches, Query, Rounds, Target, unite
from slimsfm.mapping.descriptors import describe_images
from slimsfm.mapping.map import Map, check_has_features, observed

_DESCRIBED = 2048  # keypoints that the global descriptor of a query is computed from


class Exhaustive:
    """Matches against all reference images. O(references x keypoints x points seen) per query.

    The slowest strategy, and the one that the others are measured against.
    """

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:
        self.references = ReferenceImages(map, options)

    def rounds(self, query: Query) -> Rounds:
        """Match the query with every reference image, in one round."""
        yield self.references.match(query)

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """The points that one reference image near the pose sees."""
        return self.references.visible_points(cam_from_world, agreeing)


class Retrieval:
    """Matches against a fixed number of reference images, the most similar by global descriptor [1]."""

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:
        self._retrieved = options.retrieved
        self.references = ReferenceImages(map, options)
        self._ranking = ImageRanking(map)

    def rounds(self, query: Query) -> Rounds:
        """Match the query with the most similar reference images, in one round."""
        order = np.argsort(-self._ranking.similarities(self.references.describe(query)), kind="stable")
        yield self.references.match(query, order[: self._retrieved].tolist())

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """The points that one reference image near the pose sees."""
        return self.references.visible_points(cam_from_world, agreeing)


class ReferenceImages:
    """The reference images of a map, in order of name, and how to match a query with them."""

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:
        """Read the images.

        Raises:
            MapError: The map has no image features because it was made for direct matching only.
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
            rows: The images; None for all.
            strongest: Match only this many of the query's strongest keypoints, if the matcher matches
                keypoints one by one.
        """
        return unite(self.match_each(query, rows, strongest), query.shrink_factor)

    def match_each(
        self, query: Query, rows: Sequence[int] | None = None, strongest: int | None = None
    ) -> list[PointMatches]:
        """Match as `match` does, but return the matches with each image by themselves."""
        chosen = range(len(self)) if rows is None else rows
        return self._matching.match([(query, row) for row in chosen], strongest)

    def describe(self, query: Query) -> Descriptors:
        """Local descriptors of a query, of the kind that the images' global descriptors are made from."""
        return self._matching.describe(query)

    def sharing(self, points: Int64[np.ndarray, " _"]) -> Float32[np.ndarray, " references"]:
        """Number of the given points that each image sees."""
        return np.asarray(self._seen_by[points].sum(axis=0), np.float32)

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """The points that one image sees, because a camera near it should see them too.

        It is the image that sees most of the points that agree with the pose. Where these are not known, it
        is the image whose direction towards the object is nearest to the camera's.
        """
        if agreeing is not None:
            return self._matching.target(int(self.sharing(agreeing).argmax()))
        towards = _direction(cam_from_world, self._center)
        return self._matching.target(int((self._directions @ towards).argmax()))

    def nearest_points(self, agreeing: Ids, count: int) -> Target:
        """What the few images see that see most of some points; a point once per image that sees it."""
        sharing = self.sharing(agreeing)
        rows = [row for row in np.argsort(-sharing, kind="stable")[:count].tolist() if sharing[row]]
        targets = [self._matching.target(row) for row in rows]
        return np.concatenate([one[0] for one in targets]), np.concatenate([one[1] for one in targets])

    def known_from(self, rows: Sequence[int]) -> Float32[np.ndarray, " references"]:
        """The share of each image's points that some images see too."""
        known = (self._sees[list(rows)].sum(axis=0) > 0).astype(np.float32)
        return self._sees @ known / self._counts


@runtime_checkable
class ThroughReferences(Protocol):
    """A strategy that goes through reference images."""

    @property
    def references(self) -> ReferenceImages:
        """The images of its map."""
        ...


def _direction(
    cam_from_world: pycolmap.Rigid3d, center: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    towards = cam_from_world.inverse().translation - center
    return towards / max(float(np.linalg.norm(towards)), 1e-12)


class ImageRanking:
    """Compares a query with all reference images at once, by global descriptors."""

    def __init__(self, map: Map) -> None:
        self._global_descriptors = map.global_descriptors or describe_images(map)

    def similarities(self, descriptors: Descriptors) -> Float32[np.ndarray, " references"]:
        """Cosine between a query's global descriptor and that of each reference image, in order of name.

        Args:
            descriptors: Local descriptors of the query, strongest keypoint first.
        """
        return self._global_descriptors.descriptors @ vlad(
            descriptors[:_DESCRIBED], self._global_descriptors.vocabulary
        )


_EARLY_ROUNDS = (1024,)  # keypoints per round before the last, which takes all
_NARROWEST = 0.5  # cosine: a point may be visible 60 degrees away from where it was seen


class Direct:
    """Matches against all described points at once. O(keypoints x points) per query."""

    requires = "points"

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:  # noqa: ARG002
        self._nearest = map.descriptor_metric
        self._described = map.point_descriptors or describe_appearances(map)
        self._positions = map.points3D_in_world[self._described.points].astype(np.float32)
        self._target = self._described.descriptors, self._described.points

    def rounds(self, query: Query) -> Rounds:
        """Match the strongest keypoints with the points' appearances, then all keypoints."""
        counts = [count for count in _EARLY_ROUNDS if count < len(query.descriptors)]
        for count in (*counts, len(query.descriptors)):
            yield unite([match_target(query.descriptors[:count], self._target, self._nearest)])

    def visible_points(
        self,
        cam_from_world: pycolmap.Rigid3d,
        agreeing: Int64[np.ndarray, " _"] | None = None,  # noqa: ARG002
    ) -> Target:
        """The points that were seen from about the position of the camera.

        The mean of unit vectors spread over a cone has the length (1 + cosine of the half angle) / 2, so the
        length of a point's direction gives the range of angles it was seen from.
        """
        if self._described.directions is None:
            return self._target
        towards = cam_from_world.inverse().translation.astype(np.float32) - self._positions
        lengths = np.linalg.norm(self._described.directions, axis=1)
        least = np.minimum(_NARROWEST, 2 * lengths - 1)
        products = np.einsum("nd,nd->n", towards, self._described.directions)
        facing = np.flatnonzero(products >= least * lengths * np.linalg.norm(towards, axis=1))
        return self._described.descriptors[facing], self._described.points[facing]


_FIRST, _STRONGEST = 1024, 2048  # keypoints matched with landmarks, and with images before the last round
_GROWTH = 0.6  # growth of the number of images from round to round, so that few poses are estimated
_TRIED = 0.5  # share of the images after which everything is matched with everything
_PER_IMAGE = 60  # landmarks that each image sees, if it sees as many points
_LANDMARKS = 1000  # landmarks per map, at most


class Progressive:
    """Matches with the most likely images first, and with all of them if the pose stays unsure."""

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:
        self._nearest = map.descriptor_metric
        self.references = ReferenceImages(map, options)
        self._ranking = ImageRanking(map)
        landmarks = choose_landmarks(map)
        self._landmarks = unit_rows(descriptor_sums(map))[landmarks], landmarks

    def rounds(self, query: Query) -> Rounds:
        """Match in rounds: the landmarks, one image, a second one, then more per round; last all with all."""
        parts = [match_target(query.descriptors[:_FIRST], self._landmarks, self._nearest)]
        matches = unite(parts)
        pose = yield matches
        similarities, tried = self._ranking.similarities(self.references.describe(query)), []
        while len(tried) < _TRIED * len(self.references):
            agreeing = matches.points[pose.inliers] if pose else matches.points
            known = len(tried)
            for _ in range(max(1, round(_GROWTH * known))):
                tried.append(self._next(similarities, tried, agreeing))
            found = self.references.match_each(query, tried[known:], _STRONGEST)
            parts += [unite([one], query.shrink_factor) for one in found]
            matches = unite(parts, query.shrink_factor)
            pose = yield matches
        yield self.references.match(query)

    def _next(self, similarities: Float32[np.ndarray, " references"], tried: list[int], agreeing: Ids) -> int:
        """The most useful image not tried yet: in turn one to confirm the pose and one to refute it."""
        score = similarities.copy()
        if len(tried) % 2 == 0 and len(agreeing):
            score += self.references.sharing(agreeing) / len(agreeing)
        elif tried:
            score -= self.references.known_from(tried)
        score[tried] = -np.inf
        return int(score.argmax())

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """The points that one reference image near the pose sees."""
        return self.references.visible_points(cam_from_world, agreeing)


def choose_landmarks(map: Map) -> Ids:
    """Choose a few points such that each reference image sees some of them.

    Takes the points with most observations first, until each image sees enough. Skips a point if all images
    that observe it see enough landmarks already. O(observations).

    Returns:
        Rows of the map's points, ascending.
    """
    seen_by = observed(map).T.tocsr()
    order = np.argsort(-np.diff(seen_by.indptr), kind="stable")
    counts = np.zeros(len(map.images), np.int64)
    chosen: list[int] = []
    for point in order.tolist():
        images = seen_by.indices[seen_by.indptr[point] : seen_by.indptr[point + 1]]
        if np.any(counts[images] < _PER_IMAGE):
            chosen.append(point)
            counts[images] += 1
            if len(chosen) == _LANDMARKS or counts.min() >= _PER_IMAGE:
                break
    return np.array(sorted(chosen), np.int64)
