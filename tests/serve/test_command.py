"""What `slimsfm serve` prints, and wrong input in one line."""

import socket
import sys

from commands import slimsfm
from slimsfm.serve.announcing import announcement
from slimsfm.serve.maps import map_ids
from slimsfm.serve.options import ServeOptions
from slimsfm.serve.running import Binding, MapServer


def refusal(*arguments):
    outcome = slimsfm("serve", *arguments)
    (line,) = [line for line in outcome.err.splitlines() if line.strip()]
    assert (outcome.code, outcome.out) == (2, "")
    return line


def test_wrong_input_is_one_line(poster, tmp_path):
    assert "nowhere: not a map" in refusal(tmp_path / "nowhere", "--port", 0)
    assert "is given twice" in refusal(poster, poster, "--port", 0)
    assert "workers must be at least 1" in refusal(poster, "--workers", 0)
    assert "nowhere: no such video" in refusal(poster, "--film", tmp_path / "nowhere")
    assert "nowhere: no such file" in refusal(poster, "--cert", tmp_path / "nowhere", "--key", poster)
    assert "--cert" in refusal(poster, "--key", tmp_path / "nowhere")
    assert "--model" in refusal(poster, "--anchor", tmp_path / "nowhere")
    assert "nowhere.glb: no such model" in refusal(poster, "--model", tmp_path / "nowhere.glb", "--port", 0)
    assert "port must be between" in refusal(poster, "--port", 70000)
    assert "cannot be served" in refusal(poster, "--host", "no.such.host.invalid")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "cannot be served" in refusal(poster, "--port", taken.getsockname()[1])


def test_without_its_packages_the_command_says_what_to_install(poster, monkeypatch):
    for name in [one for one in sys.modules if one.startswith("slimsfm.serve.running")]:
        monkeypatch.delitem(sys.modules, name)
    for name in [one for one in sys.modules if one.startswith("slimsfm.serve.announcing")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert "pip install 'slimsfm[serve]'" in refusal(poster)


def test_ids_are_names_of_folders_made_fit_for_addresses(tmp_path):
    paths = [tmp_path / one for one in ("a/map", "b/map", "c/map-2", "my maps/blå bil", "...", "c/map")]
    assert map_ids(paths) == ["map", "map-2", "map-2-2", "bl-bil", "map-3", "map-4"]


def test_the_announcement_has_addresses_a_code_and_the_authority(poster, tmp_path):
    binding = Binding(host="0.0.0.0", port=0, authority=tmp_path / "authority")
    options = ServeOptions(maps=(poster,), record=tmp_path / "kept")
    server = MapServer(options, binding)
    server.close()
    said = announcement(server)
    first = server.urls[0]
    assert said.startswith(f"{first} serves poster; Ctrl-C stops it\n")
    assert first.startswith("https://")
    assert len(server.options.token) >= 16
    assert first.endswith(f"#token={server.options.token}")
    assert "▀" in said
    assert "authority.crt" in said
    assert "kept: images that clients send are kept here" in said
