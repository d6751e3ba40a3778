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
        InputOptions,
        Map,
        build_map,
        extract_frames,
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
    from slimsfm.serve.client import AsyncClient, Client
    from slimsfm.tracking import Tracked, Tracker, TrackerOptions
    from slimsfm.upkeep.add import Addition, AddOptions, add
    from slimsfm.upkeep.align import Distance, Gps, GravityUp, OtherMap, Positions, Tag, align
    from slimsfm.upkeep.alignment import Alignment
    from slimsfm.upkeep.checking import check
    from slimsfm.upkeep.findings import MapCheck
    from slimsfm.upkeep.forget import ForgetOptions, Forgetting, forget
    from slimsfm.upkeep.merge import Merged, merge
    from slimsfm.upkeep.positions import read_positions
    from slimsfm.upkeep.repair import Repaired, repair
    from slimsfm.upkeep.transform import transformed

_MODULES = {
    "AddOptions": "slimsfm.upkeep.add",
    "Addition": "slimsfm.upkeep.add",
    "Alignment": "slimsfm.upkeep.alignment",
    "AsyncClient": "slimsfm.serve.client",
    "BuildOptions": "slimsfm.mapping",
    "Client": "slimsfm.serve.client",
    "Distance": "slimsfm.upkeep.align",
    "ForgetOptions": "slimsfm.upkeep.forget",
    "Forgetting": "slimsfm.upkeep.forget",
    "FrontierOptions": "slimsfm.reduction",
    "Gps": "slimsfm.upkeep.align",
    "Gravity": "slimsfm.pose",
    "GravityUp": "slimsfm.upkeep.align",
    "ImageOptions": "slimsfm.reduction",
    "ImportOptions": "slimsfm.mapping",
    "InputOptions": "slimsfm.mapping",
    "Localization": "slimsfm.localization",
    "LocalizationOptions": "slimsfm.localization",
    "Localizer": "slimsfm.localization",
    "Map": "slimsfm.mapping",
    "MapCheck": "slimsfm.upkeep.findings",
    "Merged": "slimsfm.upkeep.merge",
    "MultiLocalizer": "slimsfm.localization",
    "OtherMap": "slimsfm.upkeep.align",
    "PoseEstimate": "slimsfm.pose",
    "Positions": "slimsfm.upkeep.align",
    "RansacOptions": "slimsfm.pose",
    "ReduceOptions": "slimsfm.reduction",
    "ReductionLimits": "slimsfm.reduction",
    "Repaired": "slimsfm.upkeep.repair",
    "Tag": "slimsfm.upkeep.align",
    "Tracked": "slimsfm.tracking",
    "Tracker": "slimsfm.tracking",
    "TrackerOptions": "slimsfm.tracking",
    "add": "slimsfm.upkeep.add",
    "align": "slimsfm.upkeep.align",
    "build_map": "slimsfm.mapping",
    "check": "slimsfm.upkeep.checking",
    "estimate_pose": "slimsfm.pose",
    "extract_frames": "slimsfm.mapping",
    "forget": "slimsfm.upkeep.forget",
    "frontier": "slimsfm.reduction",
    "import_colmap": "slimsfm.mapping",
    "localize_images": "slimsfm.localization",
    "localize_objects": "slimsfm.localization",
    "merge": "slimsfm.upkeep.merge",
    "read_image": "slimsfm.photos",
    "read_map": "slimsfm.mapping",
    "read_positions": "slimsfm.upkeep.positions",
    "reduce": "slimsfm.reduction",
    "refine_pose": "slimsfm.pose",
    "repair": "slimsfm.upkeep.repair",
    "track_video": "slimsfm.report.tracked_video",
    "transformed": "slimsfm.upkeep.transform",
    "write_map": "slimsfm.mapping",
    "write_poses": "slimsfm.localization.pose_files",
}
"""The module of each public name. A new name needs a line here, in `__all__` and in the imports above."""

__all__ = [
    "AddOptions",
    "Addition",
    "Alignment",
    "AsyncClient",
    "BuildOptions",
    "Client",
    "Distance",
    "ForgetOptions",
    "Forgetting",
    "FrontierOptions",
    "Gps",
    "Gravity",
    "GravityUp",
    "ImageOptions",
    "ImportOptions",
    "InputOptions",
    "Localization",
    "LocalizationOptions",
    "Localizer",
    "Map",
    "MapCheck",
    "Merged",
    "MultiLocalizer",
    "OtherMap",
    "PoseEstimate",
    "Positions",
    "RansacOptions",
    "ReduceOptions",
    "ReductionLimits",
    "Repaired",
    "Tag",
    "Tracked",
    "Tracker",
    "TrackerOptions",
    "add",
    "align",
    "build_map",
    "check",
    "estimate_pose",
    "extract_frames",
    "forget",
    "frontier",
    "import_colmap",
    "localize_images",
    "localize_objects",
    "merge",
    "read_image",
    "read_map",
    "read_positions",
    "reduce",
    "refine_pose",
    "repair",
    "track_video",
    "transformed",
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
