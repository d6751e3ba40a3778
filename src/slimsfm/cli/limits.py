"""Limits of a slim map, as a user writes them."""

from dataclasses import dataclass

from slimsfm.cli.units import parse_bytes, parse_percent
from slimsfm.reduction import Wish


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What the slim map must keep to; the smallest that does is taken."""

    max_loss: str | None = None
    """Percentage points that may be lost against the full map, such as 1%; nothing, with a reserve, if not
    given."""

    max_bytes: str | None = None
    """Size on disk, such as 100kB."""

    max_ms: float | None = None
    """Time of matching and pose a query, on this machine."""

    max_points: int | None = None
    """Number of points."""

    max_images: int | None = None
    """Number of images, where images are kept."""

    def __post_init__(self) -> None:
        _ = self.wish  # refuses what it cannot read

    @property
    def wish(self) -> Wish:
        """The same in plain numbers."""
        return Wish(
            max_loss=None if self.max_loss is None else parse_percent(self.max_loss, "max-loss"),
            max_bytes=None if self.max_bytes is None else parse_bytes(self.max_bytes, "max-bytes"),
            max_ms=self.max_ms,
            max_points=self.max_points,
            max_images=self.max_images,
        )
