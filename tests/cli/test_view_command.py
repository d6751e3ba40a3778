"""The command serves until it is interrupted, and refuses wrong input in one line."""

import os
import signal
import socket
import subprocess
import sys
from urllib.request import urlopen

import pytest
from PIL import Image

from commands import messages, slimsfm
from poster import poster_map, poster_photo
from scenes import exact_map
from slimsfm.mapping.io import write_map
from slimsfm.mapping.subset import keep_images

pytest.importorskip("viser", reason="the live view needs viser: pip install 'slimsfm[view]'")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A map, a map reduced from it, and two of its four photos, one of them also as a query."""
    folder = tmp_path_factory.mktemp("poster")
    full = poster_map()
    write_map(full, folder / "map")
    write_map(keep_images(full, ["1.png", "3.png"]), folder / "small")
    for name in ("photos/1.png", "photos/4.png", "queries/4.png"):
        (folder / name).parent.mkdir(exist_ok=True)
        photo = poster_photo(full.images[name[-5:]].cam_from_world())
        Image.fromarray(photo).save(folder / name)
    return folder


def refusal(*arguments):
    outcome = slimsfm("view", *arguments)
    (line,) = [line for line in outcome.err.splitlines() if line.strip()]
    assert outcome.code == 2
    assert outcome.out == ""
    return line


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_the_page_is_served_until_interrupted(folder, how):
    options = ("--reduced", "small", "--images", "photos", "--queries", "queries", "--port", "0")
    process = subprocess.Popen(
        [sys.executable, "-m", "slimsfm", "view", "map", *options],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        first = process.stdout.readline()
        assert first.endswith(" shows map and small; Ctrl-C stops it\n")
        assert "<html" in urlopen(first.split()[0]).read().decode()
        assert process.stdout.readline() == "photos: 2 of 4 photos are missing or unreadable\n"
        process.send_signal(how)
        out, err = process.communicate(timeout=20)
    finally:
        process.kill()
    assert (process.returncode, out) == (0, "stopped\n")
    assert messages(err) == []


def test_missing_weights_are_named(folder, monkeypatch):
    monkeypatch.setenv("SLIMSFM_WEIGHTS", "")
    line = refusal(folder / "map", "--weights", folder / "nowhere", "--port", 0)
    assert str(folder / "nowhere") in line


def test_missing_folders_are_named(folder):
    assert "nowhere: not a map" in refusal(folder / "nowhere")
    assert "nowhere: not a map" in refusal(folder / "map", "--reduced", folder / "nowhere")
    assert "nowhere: no such folder of images" in refusal(folder / "map", "--images", folder / "nowhere")
    nowhere = ("--queries", folder / "nowhere", "--port", 0)
    assert "nowhere: no such folder of images" in refusal(folder / "map", *nowhere)


def test_a_port_in_use_is_named(folder):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"port {port} of localhost cannot be served" in refusal(folder / "map", "--port", port)


def test_a_map_that_was_not_reduced_from_the_other_is_refused(folder, tmp_path):
    write_map(exact_map(), tmp_path / "stranger")
    line = refusal(folder / "map", "--reduced", tmp_path / "stranger", "--port", 0)
    assert line == "slimsfm: reduced: its image '001.png' is not in the map; give a map reduced from it"


def test_without_viser_the_command_says_what_to_install(folder, monkeypatch):
    for name in [one for one in sys.modules if one.startswith("slimsfm.report.live")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'slimsfm[view]'" in refusal(folder / "map")
