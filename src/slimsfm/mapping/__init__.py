"""Maps: build, import, read and write them, and keep some of their images."""

from slimsfm.mapping.build import BuildOptions, KnownPoses, build_map
from slimsfm.mapping.frames import ChosenFrames, extract_frames
from slimsfm.mapping.importing import ImportOptions, import_colmap
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.inputs import InputOptions
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map, Observations
from slimsfm.mapping.subset import keep_images

__all__ = [
    "BuildOptions",
    "ChosenFrames",
    "ImportOptions",
    "InputOptions",
    "KnownPoses",
    "Map",
    "MapInfo",
    "Observations",
    "build_map",
    "extract_frames",
    "import_colmap",
    "keep_images",
    "read_map",
    "write_map",
]
