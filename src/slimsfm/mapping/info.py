"""What a map says of itself: how it was made, its box and unit, and the photos that it is of."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from slimsfm.devices import Device
from slimsfm.files import plain
from slimsfm.geometry import Box
from slimsfm.mapping.georeference import Georeference
from slimsfm.mapping.quality import ModelQuality
from slimsfm.photos import Orientation

SMALLEST_FIRST_SIZE = 64
"""Least value of `MapInfo.first_image_size`: smaller images show hardly any features."""


@dataclass(frozen=True, kw_only=True)
class Parent:
    """The map that a map was reduced from, and by which choice."""

    path: str
    """Its folder, relative to that of the reduced map, with forward slashes."""

    fingerprint: str
    """Its `Map.fingerprint`."""

    options: dict[str, Any] = field(default_factory=dict)
    """Options of the reduction that are not the default, as JSON values."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MapInfo:
    """Metadata of a map, stored in its `map.json`.

    Raises:
        ValueError: A text is none, or the options of the extractor are no options.
    """

    extractor: str
    """Name of the extractor of the map's features and of the queries'."""

    extractor_options: dict = field(default_factory=dict)
    """Options of the extractor."""

    box: Box
    """The object's box in the map's frame."""

    box_source: str
    """Source of the box: "given" or "estimated"."""

    unit: str = "unknown"
    """Unit of the map's frame: "metre", or "unknown" if SfM left the scale open."""

    georeference: Georeference | None = None
    """Where on Earth the map is; None if that is not known. `slimsfm.align` finds it."""

    origin: str
    """A sentence that says how the map was made."""

    quality: ModelQuality | None = None
    """What supports the full model, and what contradicts it. None without verified matches."""

    notes: tuple[str, ...] = ()
    """Sentences, with names, on what was skipped, ignored or guessed when the map was made."""

    orientation: Orientation = "upright"
    """Which pixels of the image files model, features and poses are of. Queries are read alike."""

    exif_orientations: Mapping[str, int] = field(default_factory=dict)
    """EXIF orientation of the images of an upright map, by name, where it is not 1. Empty in maps of version
    0.1, which did not record it."""

    devices: Mapping[int, Device] = field(default_factory=dict)
    """What EXIF says of the photos that a camera was made with, by its id, where they agree. Empty in older
    maps and in maps made without the photos."""

    first_image_size: int | None = None
    """Longer side, in pixels, of the image that the first features of a query are extracted from; `reduce`
    finds it. None if it was not searched for."""

    parent: Parent | None = None
    """The map that this one was reduced from. None for full maps and for maps of older versions."""

    wrong_poses: tuple[str, ...] = ()
    """Images of the full map whose poses a check found wrong, by name: nothing is measured by them, and no
    image must be kept to localize them."""

    def __post_init__(self) -> None:
        for name in ("extractor", "box_source", "unit", "origin"):
            plain(getattr(self, name), str)
        largest = plain(self.extractor_options, dict[str, Any]).get("max_image_size")
        if plain(largest, float | None) is not None and largest < 1:
            raise ValueError(f"max_image_size must be at least 1, got {largest}")
        first = plain(self.first_image_size, int | None)
        if first is not None and first < SMALLEST_FIRST_SIZE:
            raise ValueError(f"first_image_size must be at least {SMALLEST_FIRST_SIZE}, got {first}")
