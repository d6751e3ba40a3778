"""A small rendered object and its map from known poses, made once per session."""

import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from commands import Outcome, slimsfm
from slimsfm.cli.output import quiet
from slimsfm.datasets.base import PosedSequence, map_object
from slimsfm.datasets.onepose import read_object
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map

NAME = "boulder"
MAPPING_FRAMES = 30  # with fewer, the views are too far apart for SfM
QUERY_FRAMES = 4


@dataclass(frozen=True)
class Rendered:
    folder: Path
    synthesize: Outcome
    mapping: PosedSequence
    query: PosedSequence
    map_path: Path

    @property
    def map(self) -> Map:
        return read_map(self.map_path)

    @property
    def photos(self) -> Path:
        return self.mapping.folder

    @property
    def queries(self) -> Path:
        return self.query.folder


@cache
def rendered(folder: Path) -> Rendered:
    frames = ("--mapping-frames", MAPPING_FRAMES, "--query-frames", QUERY_FRAMES)
    size = ("--width", 320, "--height", 240)
    outcome = slimsfm("synthesize", "-o", folder / "objects", "--objects", NAME, *frames, *size)
    assert outcome.code == 0, outcome.err
    made = read_object(folder / "objects" / NAME)
    with tempfile.TemporaryDirectory() as workspace, quiet():
        write_map(map_object(made, Path(workspace)), folder / "map")
    return Rendered(folder, outcome, made.mapping, made.query, folder / "map")
