"""Track an object through a video."""

from slimsfm.tracking.tracker import Tracked, Tracker, TrackerOptions

__all__ = ["Tracked", "Tracker", "TrackerOptions"]
