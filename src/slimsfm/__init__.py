"""slimsfm: small, fast COLMAP maps for visual localization and 6-DoF object pose.

    import slimsfm

    full = slimsfm.build_map("photos")
    small = slimsfm.reduce(full)
    slimsfm.write_map(small.map, "small")
    result = slimsfm.Localizer(small.map).localize(slimsfm.read_image("query.jpg"))

The names below are loaded on first use (PEP 562), so that importing the package takes no time.
"""

# pycolmap's wheel exports the symbols of its own zlib. Loaded first, they would replace half of the system's
# zlib, and Python's `zlib` module would corrupt the heap.
import zlib as _zlib  # noqa: F401
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slimsfm.localization import (
        Localization,
        LocalizationOptions,
        Localizer,
        MultiLocalizer,
        localize_images,
        localize_objects,
    )
    from slimsfm.localization.pose_files import write_poses
    from slimsfm.mapping import (
        BuildOptions,
        ImportOptions,
        Map,
        build_map,
        import_colmap,
        read_map,
        write_map,
    )
    from slimsfm.photos import read_image
    from slimsfm.pose import Gravity, PoseEstimate, RansacOptions, estimate_pose, refine_pose
    from slimsfm.reduction import (
        FrontierOptions,
        ImageOptions,
        ReduceOptions,
        ReductionLimits,
        frontier,
        reduce,
    )
    from slimsfm.report.tracked_video import track_video
    from slimsfm.tracking import Tracked, Tracker, TrackerOptions
    from slimsfm.upkeep import MapCheck, Repaired, check, repair

_MODULES = {
    "BuildOptions": "slimsfm.mapping",
    "FrontierOptions": "slimsfm.reduction",
    "Gravity": "slimsfm.pose",
    "ImageOptions": "slimsfm.reduction",
    "ImportOptions": "slimsfm.mapping",
    "Localization": "slimsfm.localization",
    "LocalizationOptions": "slimsfm.localization",
    "Localizer": "slimsfm.localization",
    "Map": "slimsfm.mapping",
    "MapCheck": "slimsfm.upkeep",
    "MultiLocalizer": "slimsfm.localization",
    "PoseEstimate": "slimsfm.pose",
    "RansacOptions": "slimsfm.pose",
    "ReduceOptions": "slimsfm.reduction",
    "ReductionLimits": "slimsfm.reduction",
    "Repaired": "slimsfm.upkeep",
    "Tracked": "slimsfm.tracking",
    "Tracker": "slimsfm.tracking",
    "TrackerOptions": "slimsfm.tracking",
    "build_map": "slimsfm.mapping",
    "check": "slimsfm.upkeep",
    "estimate_pose": "slimsfm.pose",
    "frontier": "slimsfm.reduction",
    "import_colmap": "slimsfm.mapping",
    "localize_images": "slimsfm.localization",
    "localize_objects": "slimsfm.localization",
    "read_image": "slimsfm.photos",
    "read_map": "slimsfm.mapping",
    "reduce": "slimsfm.reduction",
    "refine_pose": "slimsfm.pose",
    "repair": "slimsfm.upkeep",
    "track_video": "slimsfm.report.tracked_video",
    "write_map": "slimsfm.mapping",
    "write_poses": "slimsfm.localization.pose_files",
}
"""The module of each public name. A new name needs a line here, in `__all__` and in the imports above."""

__all__ = [
    "BuildOptions",
    "FrontierOptions",
    "Gravity",
    "ImageOptions",
    "ImportOptions",
    "Localization",
    "LocalizationOptions",
    "Localizer",
    "Map",
    "MapCheck",
    "MultiLocalizer",
    "PoseEstimate",
    "RansacOptions",
    "ReduceOptions",
    "ReductionLimits",
    "Repaired",
    "Tracked",
    "Tracker",
    "TrackerOptions",
    "build_map",
    "check",
    "estimate_pose",
    "frontier",
    "import_colmap",
    "localize_images",
    "localize_objects",
    "read_image",
    "read_map",
    "reduce",
    "refine_pose",
    "repair",
    "track_video",
    "write_map",
    "write_poses",
]


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'slimsfm' has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
