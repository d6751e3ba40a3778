"""A build goes on from what an interrupted one with the same photos and options left in its workspace."""

import os
import shutil
from dataclasses import dataclass, field

import numpy as np
import pytest

from commands import contents
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.io import write_map
from slimsfm.mapping.workspace import Workspace


@dataclass
class StopsAt:
    """Progress that interrupts the work with this label after some items."""

    label: str
    after: int
    seen: dict[str, int] = field(default_factory=dict)
    """Number of items by label."""

    def __call__(self, items, label):
        self.seen[label] = len(items)
        for number, item in enumerate(items):
            if label == self.label and number == self.after:
                raise KeyboardInterrupt
            yield item


def stop(folder, options, workspace, label, after):
    with pytest.raises(KeyboardInterrupt):
        build_map(folder, options, workspace=workspace, progress=StopsAt(label, after))


def goes_on(folder, options, workspace):
    """What is done of each kind of work when the build is repeated."""
    progress = StopsAt("", 0)
    return build_map(folder, options, workspace=workspace, progress=progress), progress.seen


def test_what_was_extracted_and_said_is_not_done_again(rendered, unposed, tmp_path):
    stop(rendered.folder, BuildOptions(), tmp_path / "work", "extract features", 3)
    torn = sorted((tmp_path / "work" / "extracted").iterdir())[0]
    torn.write_bytes(torn.read_bytes()[:1000])
    made, seen = goes_on(rendered.folder, BuildOptions(), tmp_path / "work")
    assert seen["extract features (2 done before)"] == 6
    write_map(made, tmp_path / "resumed")
    write_map(unposed.map, tmp_path / "whole")
    assert contents(tmp_path / "resumed") == contents(tmp_path / "whole")


@pytest.mark.parametrize("change", ["photo", "option", "mask"])
def test_other_photos_masks_and_options_start_afresh(rendered, tmp_path, change):
    folder = shutil.copytree(rendered.folder, tmp_path / "images")
    masks = tmp_path / "masks" / f"{rendered.names[0]}.png"
    masks.parent.mkdir(parents=True)
    shutil.copy(rendered.folder / rendered.names[0], masks)
    options = BuildOptions(masks=tmp_path / "masks")
    stop(folder, options, tmp_path / "work", "extract features", 3)
    if change == "option":
        options = BuildOptions(masks=tmp_path / "masks", max_features=100)
    else:
        os.utime(masks if change == "mask" else folder / rendered.names[0], (0, 0))
    progress = StopsAt("extract features", 1)
    with pytest.raises(KeyboardInterrupt):
        build_map(folder, options, workspace=tmp_path / "work", progress=progress)
    assert progress.seen == {"extract features": 8}


def test_pairs_are_matched_once(tmp_path):
    pairs = [(f"{i}", f"{j}") for i in range(10) for j in range(i)]
    solved = []

    def solve(blocks):
        for block in blocks:
            solved.append(block)
            yield {"lengths": np.array([int(a) for a, _ in block])}

    def workspace():
        (tmp_path / "work").mkdir(exist_ok=True)
        return Workspace(tmp_path / "work", {"of": "these"})

    with pytest.raises(KeyboardInterrupt):
        workspace().in_blocks(pairs, solve, StopsAt("match pairs", 33), "match pairs")
    assert len(solved) == 4
    progress = StopsAt("", 0)
    found = workspace().in_blocks(pairs, solve, progress, "match pairs")
    assert progress.seen == {"match pairs (40 done before)": 5}
    assert [pair for block in solved for pair in block] == pairs
    assert [pair for block, _ in found for pair in block] == pairs
    assert all(arrays["lengths"].tolist() == [int(a) for a, _ in block] for block, arrays in found)
