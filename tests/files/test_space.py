"""What cannot be written is refused before the work, by trying."""

from pathlib import Path

import pytest

from commands import slimsfm, state
from slimsfm.errors import OutputError
from slimsfm.files.space import check_place

NOWHERE = Path("/proc/self/fdinfo")
"""A folder that exists and in which nobody can create a file."""

COMMANDS = {
    "build": ("build", "none", "-o", "OUT"),
    "import": ("import", "none", "-o", "OUT"),
    "reduce": ("reduce", "none", "-o", "OUT"),
    "localize": ("localize", "none", "none", "-o", "OUT.json"),
    "track": ("track", "none", "none", "-o", "OUT.json"),
    "drawn track": ("track", "none", "none", "-o", "here.json", "--video", "OUT.mp4"),
    "frontier": ("frontier", "none", "--json", "OUT.json"),
    "curves": ("frontier", "none", "--curves", "OUT.svg"),
    "graph": ("graph", "none", "-o", "OUT.npz"),
    "statistics": ("graph", "none", "--json", "OUT.json"),
    "benchmark": ("benchmark", "images", "none", "-o", "OUT"),
    "report": ("report", "none", "-o", "OUT.html"),
    "figures": ("figures", "none", "-o", "OUT"),
    "onnx": ("export", "onnx", "superpoint", "-o", "OUT.onnx"),
    "colmap": ("export", "colmap", "none", "-o", "OUT"),
    "hloc": ("export", "hloc", "none", "-o", "OUT"),
    "synthesize": ("synthesize", "-o", "OUT"),
    "demo": ("demo", "-o", "OUT"),
}


@pytest.mark.skipif(not NOWHERE.is_dir(), reason="needs /proc")
@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS.keys())
def test_every_command_tries_its_output_before_it_reads_its_inputs(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = slimsfm(*(word.replace("OUT", str(NOWHERE / "new")) for word in command))
    assert done.code == 2
    assert done.err.startswith(f"slimsfm: {NOWHERE / 'new'}")
    assert "cannot be written" in done.err
    assert list(tmp_path.iterdir()) == []


def test_what_is_tried_leaves_nothing_and_needs_no_folder(tmp_path):
    before = state(tmp_path).keys()
    check_place(tmp_path / "new" / "folder" / "map", least_bytes=1000)
    assert state(tmp_path).keys() == before


def test_too_little_room_is_said_with_numbers(tmp_path):
    with pytest.raises(OutputError, match=r"map: No space left on device: .* MB are free, about 1e"):
        check_place(tmp_path / "map", least_bytes=10**18)
