"""`slimsfm localize --full`: the full map is tried where the reduced one gives no pose."""

import json

import numpy as np
import pytest

from commands import slimsfm
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.io import write_map
from slimsfm.mapping.subset import direct_map


@pytest.fixture
def too_small(boulder, tmp_path):
    """A map of so few points that no pose is found."""
    full = boulder.map
    write_map(direct_map(full, describe_points(full)[np.arange(8)]), tmp_path / "small")
    return tmp_path / "small"


def test_the_full_map_gives_the_poses_that_the_reduced_one_does_not(boulder, too_small, tmp_path):
    localized = {}
    for name, arguments in {"slim": (), "both": ("--full", boulder.map_path)}.items():
        output = tmp_path / f"{name}.json"
        done = slimsfm("localize", too_small, boulder.queries, "-o", output, *arguments)
        assert done.code == 0, done.err
        localized[name] = sum(one["localized"] for one in json.loads(output.read_text())["images"])
    assert localized["slim"] == 0 < localized["both"]
    count = len(boulder.query.image_paths)
    said = " ".join(done.out.split())
    assert f"gave {localized['both']} of the {count} poses that {too_small} did not" in said
    assert done.out.count(", full map") == count


def test_a_full_map_goes_with_one_map(boulder, too_small, tmp_path):
    output = tmp_path / "poses.json"
    full = ("--full", boulder.map_path, "--also", boulder.map_path)
    refusal = slimsfm("localize", too_small, boulder.queries, "-o", output, *full)
    assert (refusal.code, output.exists()) == (2, False)
    assert "full goes with one map" in refusal.err
