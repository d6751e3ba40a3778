"""Learned methods on the command line: what is found, what is missing, and that nothing else needs them."""

import os
import re
import subprocess
import sys

import pytest

from commands import messages, slimsfm
from slimsfm.features.registry import EXTRACTORS, plugins
from slimsfm.localization.calibration import CALIBRATED
from slimsfm.weights import FOLDER

WITHOUT = """
import sys

from importlib.machinery import PathFinder

class Finder(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        is_missing = name.partition(".")[0] in ("torch", "kornia", "transformers", "onnxruntime")
        return None if is_missing else super().find_spec(name, path, target)

sys.meta_path = [Finder if finder is PathFinder else finder for finder in sys.meta_path]
from slimsfm.cli import run
sys.exit(run(sys.argv[1:]))
"""


def slimsfm_without_torch(*arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", WITHOUT, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


@pytest.fixture(autouse=True)
def environment_is_put_back(monkeypatch):
    for name in (FOLDER, "SLIMSFM_DEVICE"):
        monkeypatch.setenv(name, os.environ.get(name, ""))
        monkeypatch.delenv(name)


def test_methods_are_listed_with_licenses_and_found_weights(tmp_path):
    (tmp_path / "depth-save.pth").write_bytes(b"")
    (tmp_path / "aliked-n16.pth").write_bytes(b"")
    found = slimsfm("methods", "--weights", tmp_path)
    assert found.code == 0
    lines = {line.split()[1]: line for line in found.out.splitlines() if len(line.split()) > 2}
    assert lines.keys() >= {
        "sift",
        "aliked",
        "disk",
        "superpoint",
        "xfeat",
        "nearest",
        "superglue",
        "lightglue",
        "lighterglue",
        "loftr",
    }
    assert "research only" in lines["superpoint"]
    assert lines["disk"].rstrip().endswith("weights folder")
    assert "no: not the published file" in lines["aliked"]


def test_methods_names_the_extractors_whose_confidence_is_not_calibrated():
    said = " ".join(slimsfm("methods").out.split())
    (named,) = re.findall(r"confidence not calibrated for these extractors: ([^,\s]+(?:, [^,\s]+)*)", said)
    assert set(named.split(", ")) == {*EXTRACTORS, *plugins("extractor")} - CALIBRATED


def test_classical_methods_need_no_network_stack(boulder, tmp_path):
    assert slimsfm_without_torch("methods").returncode == 0
    out = tmp_path / "poses.json"
    done = slimsfm_without_torch("localize", boulder.map_path, boulder.queries, "-o", out)
    assert done.returncode == 0, done.stderr
    assert out.exists()


@pytest.mark.parametrize("extractor", ["aliked", "disk", "superpoint", "xfeat"])
def test_without_it_a_learned_method_says_which_extra_to_install(boulder, tmp_path, extractor):
    done = slimsfm_without_torch("build", boulder.photos, "-o", tmp_path / "map", "--extractor", extractor)
    assert done.returncode == 2
    assert done.stderr.startswith(f"slimsfm: extractor '{extractor}' needs ")
    assert done.stderr.endswith("which is not installed: pip install 'slimsfm[learned]'\n")
    assert not (tmp_path / "map").exists()


def test_an_unknown_extractor_or_matcher_or_folder_is_named(boulder, tmp_path):
    out = tmp_path / "map"
    found = slimsfm("build", boulder.photos, "-o", out, "--extractor", "orb")
    assert (found.code, found.err.count("\n")) == (2, 1)
    assert "extractor 'orb' is unknown; known are aliked, disk, loftr, sift, superpoint, xfeat" in found.err
    found = slimsfm("build", boulder.photos, "-o", out, "--matcher", "guess")
    assert found.code == 2
    assert "matcher 'guess' is unknown; known are lighterglue, lightglue, nearest, superglue" in found.err
    found = slimsfm("build", boulder.photos, "-o", out, "--matcher", "superglue")
    assert found.code == 2
    assert "features must be superpoint" in found.err or "pip install 'slimsfm[learned]'" in found.err
    found = slimsfm("build", boulder.photos, "-o", out, "--weights", tmp_path / "nowhere")
    assert found.code == 2
    assert "nowhere: no such folder of weights" in found.err
    assert not out.exists()


def test_missing_weights_are_named_before_anything_is_written(boulder, tmp_path):
    pytest.importorskip("slimsfm.networks.loading", exc_type=ImportError)
    out, cache = tmp_path / "map", tmp_path / "cache"
    options = ("-o", out, "--extractor", "superpoint", "--weights", tmp_path)
    found = subprocess.run(
        [sys.executable, "-m", "slimsfm", *map(str, ("build", boulder.photos, *options))],
        env={**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(cache)},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 2
    (line,) = messages(found.stderr)
    assert (
        "weights superpoint_v1.pth are missing and could not be downloaded; get them from the SuperGlue"
        in line
    )
    assert not out.exists()
