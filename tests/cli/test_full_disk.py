"""A disk that fills up while a result is written: one line, exit code 2, and no incomplete result."""

import os
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest

from commands import messages

needs_root = pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0 or shutil.which("mount") is None,
    reason="needs root, to mount a small disk",
)


@contextmanager
def disk(folder, kilobytes):
    folder.mkdir()
    size = f"size={kilobytes}k"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        pytest.skip("needs permission to mount a small disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def refused_for_space(*arguments):
    """In its own process, because a failure in COLMAP's code may end it."""
    found = subprocess.run(
        [sys.executable, "-m", "slimsfm", *map(str, arguments)], capture_output=True, text=True
    )
    lines = messages(found.stderr)
    assert (found.returncode, len(lines)) == (2, 1), found.stderr
    assert "No space left on device" in lines[0]
    return lines[0]


def size_of(path):
    return sum(file.stat().st_size for file in [path, *path.rglob("*")] if file.is_file())


@needs_root
@pytest.mark.parametrize("share", [0.05, 0.5, 0.9], ids=["empty", "in the model", "in the features"])
def test_a_map_is_complete_or_absent(boulder, tmp_path, share):
    names = sorted(boulder.map.images)
    parts = [size_of(boulder.map_path / part) for part in ("sparse", "features.h5")]
    sizes = {0.05: 8192, 0.5: 0.5 * parts[0], 0.9: parts[0] + 0.5 * parts[1]}
    with disk(tmp_path / "disk", int(sizes[share] / 1024)) as folder:
        line = refused_for_space("reduce", boulder.map_path, "-o", folder / "slim", "--images", *names)
        assert str(folder / "slim") in line
        assert list(folder.iterdir()) == []


@needs_root
def test_poses_are_complete_or_absent_and_existing_ones_stay(boulder, tmp_path):
    with disk(tmp_path / "disk", 8) as folder:
        (folder / "poses.json").write_text("mine")
        (folder / "filler").write_bytes(bytes(4096))
        images = ("localize", boulder.map_path, boulder.queries)
        line = refused_for_space(*images, "-o", folder / "poses.json", "--overwrite")
        assert str(folder / "poses.json") in line
        assert sorted(path.name for path in folder.iterdir()) == ["filler", "poses.json"]
        assert (folder / "poses.json").read_text() == "mine"


@needs_root
def test_a_graph_is_complete_or_absent(boulder, tmp_path):
    needed = sum(
        (file.stat().st_size // 4096 + 1) * 4 for file in boulder.map_path.rglob("*") if file.is_file()
    )
    with disk(tmp_path / "disk", needed + 2) as folder:
        a_map = shutil.copytree(boulder.map_path, folder / "map", ignore=shutil.ignore_patterns("graph-*"))
        filler = folder / "filler"
        with filler.open("wb", buffering=0) as file:
            _fill(file)
        line = refused_for_space("reduce", a_map, "-o", tmp_path / "slim", "--solver", "exact")
        assert str(a_map / "graph-matches.partial") in line
        assert not (tmp_path / "slim").exists()
        names = {path.name for path in a_map.iterdir()}
        assert names == {"sparse", "features.h5", "matches.h5", "global.npz", "map.json"}


def _fill(file):
    try:
        while True:
            file.write(bytes(1024))
    except OSError:
        return
