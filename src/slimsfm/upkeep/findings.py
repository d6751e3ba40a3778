"""What a check of a map finds, each finding with its evidence."""

from dataclasses import dataclass
from typing import Literal

import pycolmap

_LISTED = 6  # names in a sentence


@dataclass(frozen=True, kw_only=True, eq=False)
class WrongPose:
    """An image whose pose the others contradict: they agree that it stands elsewhere."""

    name: str
    """Name of the image."""

    cam_from_world: pycolmap.Rigid3d
    """Where the map says that it stands."""

    others_cam_from_world: pycolmap.Rigid3d
    """Where the others say that it stands, those whose poses are right."""

    sets: tuple[tuple[str, ...], ...]
    """Disjoint sets of references that localize the image there, each without the others."""

    inliers: int
    """Number of matches that agree with the pose by all these references together."""

    agreeing: int
    """Number of these that also agree with the pose of the map."""

    distance: float
    """Relative corner error between both poses."""

    rotation_deg: float
    """Angle between both poses."""

    shift: float
    """Distance between both positions of the camera, in map units."""

    predicted_error: float
    """Predicted relative corner error of the pose by the others."""

    @property
    def sentence(self) -> str:
        """The finding in words."""
        sets = f"{len(self.sets)} disjoint sets of references" if len(self.sets) > 1 else "the references"
        return (
            f"{self.name}: {sets} localize it {self.distance:.3f} d away, by {self.rotation_deg:.1f} degrees "
            f"and {self.shift:.3g} units; {self.inliers} matches agree with them, of which {self.agreeing} "
            "agree with the map"
        )


@dataclass(frozen=True, kw_only=True)
class Misplaced:
    """An image that does not match what it should see: it was laid over a place that looks alike."""

    name: str
    """Name of the image."""

    expected: int
    """Points of the images around it that it should see, counted once per image; of those that are right."""

    seen: int
    """Number of these that it matches."""

    matches: int
    """Number of its matches with these images."""

    agreeing: float
    """Share of the matches that agree with the map."""

    @property
    def sentence(self) -> str:
        """The finding in words."""
        if not self.expected:
            return f"{self.name}: stands only among images that are misplaced too"
        return (
            f"{self.name}: matches {self.seen / self.expected:.0%} of what it should see of the images "
            f"around it; {1 - self.agreeing:.0%} of its {self.matches} matches with them contradict the map"
        )


@dataclass(frozen=True, kw_only=True)
class Unlocalized:
    """An image that no set of the others localizes: nothing supports its pose, and nothing contradicts it."""

    name: str
    """Name of the image."""

    references: int
    """Number of other images that it has verified matches with."""

    matches: int
    """Number of its keypoints that are matched with points which do not depend on it."""

    @property
    def sentence(self) -> str:
        """The finding in words."""
        return (
            f"{self.name}: matched with {self.references} images, but only {self.matches} keypoints with "
            "points that do not depend on it"
        )


@dataclass(frozen=True, kw_only=True)
class Duplicate:
    """Two images with nearly the same pixels."""

    name: str
    """Name of the first image."""

    copy: str
    """Name of the other one, which adds nothing."""

    matched: float
    """Share of the keypoints of the image with fewer that are matched."""

    moved_px: float
    """Median distance between matched keypoints, in pixels."""

    distance: float
    """Relative corner error between the two poses."""

    @property
    def sentence(self) -> str:
        """The finding in words."""
        poses = "" if self.distance < _SAME else f"; yet their poses are {self.distance:.3f} d apart"
        return (
            f"{self.copy}: as {self.name}; {self.matched:.0%} of the keypoints match, "
            f"{self.moved_px:.1f} px apart{poses}"
        )


_SAME = 0.005  # relative corner error of equal poses


@dataclass(frozen=True, kw_only=True)
class Blurred:
    """An image that is less sharp than those that show the same."""

    name: str
    """Name of the image."""

    sharpness: float
    """Its sharpness over the median of its neighbors'."""

    measured_by: Literal["pixels", "features"]
    """pixels: contrast of fine detail (variance of the Laplacian). features: share of small keypoints."""

    @property
    def sentence(self) -> str:
        """The finding in words."""
        how = "fine detail" if self.measured_by == "pixels" else "small keypoints"
        return f"{self.name}: {self.sharpness:.0%} of the {how} that its neighbors have"


@dataclass(frozen=True, kw_only=True)
class Thread:
    """Two parts of a map that little holds together."""

    part: tuple[str, ...]
    """Images of the smaller part."""

    rest: int
    """Number of images of the other part."""

    link: tuple[str, str]
    """The two images, one of each part, that hold them together best."""

    matches: int
    """Number of matches between these that agree with the map."""

    usual: int
    """The median, over the images of the map, of the matches with the best neighbor."""

    contradicted: tuple[tuple[str, str], ...]
    """Pairs of images across whose matches contradict the map: with many, the parts may be folded."""

    @property
    def sentence(self) -> str:
        """The finding in words."""
        across = len(self.contradicted)
        folded = f"; {across} pairs across contradict the map: the parts may be folded" if across else ""
        return (
            f"{len(self.part)} images ({listed(self.part)}) hang on the other {self.rest} by {self.matches} "
            f"matches ({self.link[0]} and {self.link[1]}), where {self.usual} are usual{folded}"
        )


@dataclass(frozen=True, kw_only=True)
class ContradictedPair:
    """Two images whose matches are hard to doubt, and contradict the map: it may be folded there."""

    first: str
    """Name of one image."""

    second: str
    """Name of the other one."""

    matches: int
    """Number of their verified matches."""

    agreeing: float
    """Share of the matches that agree with the poses of the map."""

    @property
    def sentence(self) -> str:
        """The finding in words."""
        return (
            f"{self.first}, {self.second}: {self.agreeing:.0%} of {self.matches} matches agree with the map"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class MapCheck:
    """What a check of a map found."""

    images: int
    """Number of images of the map."""

    pairs: int
    """Number of pairs of images with matches."""

    agreeing_pairs: int
    """Number of these of which at least half of the matches agree with the map."""

    matches_from: Literal["map", "matched again"]
    """Source of the matches: stored in the map, or found again because the map stores none."""

    usual_error: float
    """Median relative corner error between the poses of the map and those by the other images."""

    wrong: tuple[WrongPose, ...]
    """Images whose poses are wrong, and where the others say that they stand, by name."""

    misplaced: tuple[Misplaced, ...]
    """Others with wrong poses, by name: they were laid over a place that looks alike. Not looked for where
    poses were given."""

    contradicted_pairs: tuple[ContradictedPair, ...]
    """Other pairs of images that are hard to doubt (`mapping.support`) and contradict the map. Not looked for
    where poses were given, which are believed more than look-alike matches."""

    unlocalized: tuple[Unlocalized, ...]
    """Images that no others localize, by name."""

    duplicates: tuple[Duplicate, ...]
    """Pairs of images with nearly the same pixels."""

    blurred: tuple[Blurred, ...]
    """Images that are less sharp than their neighbors, by name."""

    threads: tuple[Thread, ...]
    """Parts that little holds together."""

    @property
    def is_contradicted(self) -> bool:
        """Whether anything contradicts poses of the map."""
        return bool(self.wrong or self.misplaced or self.contradicted_pairs)

    @property
    def wrong_names(self) -> tuple[str, ...]:
        """Names of the images whose poses are wrong, sorted."""
        return tuple(sorted(one.name for one in (*self.wrong, *self.misplaced)))


def listed(names: tuple[str, ...]) -> str:
    """The first of many names, in one line."""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more
