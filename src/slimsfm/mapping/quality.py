"""The quality of a model: what supports it, and what contradicts it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from slimsfm.files import plain

MIN_COMMON_POINTS = 15
"""Points that two images must both see to be joined."""

_MIN_FOCAL, _MAX_FOCAL = 0.2, 15.0  # focal length over the longer side of the image
WITHOUT_PARALLAX = 0.8
"""Share of the pairs of photos that rotations explain, of a camera that only turned."""

_LISTED = 12  # names in a sentence


@dataclass(frozen=True, kw_only=True)
class ModelQuality:
    """What supports a model, and what contradicts it."""

    given: int
    """Number of photos that the model was to be made of."""

    registered: int
    """Number of those that it contains."""

    verified_pairs: int
    """Number of pairs of its images with verified matches."""

    contradicted_pairs: int
    """Number of those pairs of which fewer than half of the matches agree with the model."""

    trusted_pairs: int
    """Number of pairs that are hard to doubt: see `mapping.support`."""

    contradictions: dict[str, float] = field(default_factory=dict)
    """Images of contradicted trusted pairs: the smallest share of the matches of such a pair that agrees."""

    ambiguous: bool = False
    """Whether look-alike parts confused mapping, and the names of the photos give no order to check by."""

    doubtful: tuple[str, ...] = ()
    """Those images, and the images that share points with them: poses close to these are in doubt."""

    median_observations: float
    """Median number of points that an image observes."""

    median_track_length: float
    """Median number of images that observe a point."""

    triangulation_angle_deg: float
    """Median, over points, of the largest angle between two rays to the point."""

    camera_spread: float
    """Largest distance of a camera to the median camera, over the median distance from cameras to points."""

    without_parallax: float = 0.0
    """Share of the pairs whose matches a rotation of the camera explains; measured if cameras are close."""

    focal_lengths: dict[str, float] = field(default_factory=dict)
    """Focal length over the longer side, by the name of the first image of each camera; of many cameras, a
    dozen from the shortest to the longest."""

    focal_origins: dict[str, str] = field(default_factory=dict)
    """First guess of these focal lengths: "EXIF", "guessed", "given" (known) or "model" (imported)."""

    pieces: tuple[int, ...] = ()
    """Number of images of each piece of the model, largest first; more than one is a fault."""

    @property
    def has_known_poses(self) -> bool:
        """Whether poses were given, which are believed more than matches of what looks alike."""
        return "given" in self.focal_origins.values()

    def with_origins(self, origins: Mapping[str, str]) -> "ModelQuality":
        """With the first guesses of focal lengths, by name of image; known poses are not contradicted."""
        found = {name: origins[name] for name in self.focal_lengths if name in origins}
        described = replace(self, focal_origins=found)
        return replace(described, contradictions={}, doubtful=()) if described.has_known_poses else described

    @property
    def contradicted_share(self) -> float:
        """Share of the images that belong to a contradicted trusted pair."""
        return len(self.contradictions) / max(self.registered, 1)

    @property
    def faults(self) -> tuple[str, ...]:
        """Reasons why the model cannot be used. A model with contradictions can, with doubt."""
        found = []
        if len(self.pieces) > 1:
            found.append(
                f"its images fall into {len(self.pieces)} pieces of {', '.join(map(str, self.pieces[:5]))} "
                f"images, with fewer than {MIN_COMMON_POINTS} common points between them"
            )
        if self.without_parallax >= WITHOUT_PARALLAX:
            found.append(turned(self.without_parallax))
        for name, focal in self.focal_lengths.items():
            if not _MIN_FOCAL <= focal <= _MAX_FOCAL:
                found.append(f"the focal length of {name} would be {focal:.3g} times the image's longer side")
        return tuple(found)

    @property
    def summary(self) -> str:
        """One line on what supports the model."""
        agreeing = self.verified_pairs - self.contradicted_pairs
        focal_lengths = ", ".join(
            f"{focal:.2f} ({self.focal_origins.get(name, 'refined')})"
            for name, focal in list(self.focal_lengths.items())[:_LISTED]
        )
        return (
            f"{self.registered} of {self.given} photos registered, {agreeing} of {self.verified_pairs} "
            f"verified pairs agree, {len(self.contradictions)} images contradicted; an image sees a median "
            f"of {self.median_observations:.0f} points; {self.triangulation_angle_deg:.1f} degrees "
            f"between rays; focal length over longer side {focal_lengths}"
        )

    @property
    def doubts(self) -> tuple[str, ...]:
        """Sentences on what contradicts the model, with names."""
        if self.ambiguous and not self.contradictions:
            return (
                "parts of these photos look alike, and the names of the photos give no order to tell them "
                "apart. The model may be folded; name the photos in the order in which they were taken",
            )
        if not self.contradictions:
            return ()
        shares = [f"{name} ({share:.0%})" for name, share in self.contradictions.items()]
        more = f" and {len(shares) - _LISTED} more" if len(shares) > _LISTED else ""
        return (
            f"matches contradict the poses of {len(shares)} of {self.registered} images. The model may be "
            "folded: parts that look alike are laid over each other, and poses may be wrong. Contradicted, "
            f"with the share of matches that agree: {', '.join(shares[:_LISTED])}{more}",
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts, and the faults that an imported model may have. Known poses do not depend on points."""
        faults = () if self.has_known_poses else self.faults
        return (*self.doubts, *(f"the model may be wrong: {fault}" for fault in faults))


def quality_from_json(data: dict[str, Any] | None) -> ModelQuality | None:
    """A quality from the plain values that `dataclasses.asdict` gives; None stays None.

    Raises:
        KeyError, ValueError: A value is missing or of another type.
    """
    return plain(data, ModelQuality | None)


def turned(share: float) -> str:
    """Say that a camera turned but hardly moved."""
    return (
        f"the camera turned but hardly moved (rotations explain {share:.0%} of the pairs of photos); walk "
        "around while taking photos"
    )
