import logging

import pytest

from slimsfm import weights
from slimsfm.errors import InputError
from slimsfm.weights import FOLDER, WEIGHTS, find_weights, remind_of_licence, weights_folder


def test_every_file_has_a_name_of_its_own_a_source_and_a_licence():
    files = [one.file for one in WEIGHTS.values()]
    assert len(set(files)) == len(files)
    assert all(one.source and one.licence for one in WEIGHTS.values())


def test_just_what_magic_leap_published_is_for_research_only():
    assert [name for name, one in WEIGHTS.items() if one.is_research_only] == ["superpoint", "superglue"]


def test_without_a_folder_nothing_is_found_there(monkeypatch):
    monkeypatch.delenv(FOLDER, raising=False)
    assert weights_folder() is None
    assert find_weights("disk") is None


def test_a_folder_that_is_none_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv(FOLDER, str(tmp_path / "nowhere"))
    with pytest.raises(
        InputError, match="nowhere: no such folder of weights; mend --weights or SLIMSFM_WEIGHTS"
    ):
        find_weights("disk")


def test_files_are_found_by_their_published_names(monkeypatch, tmp_path):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    assert find_weights("disk") is None
    (tmp_path / "depth-save.pth").write_bytes(b"something")
    assert find_weights("disk") == tmp_path / "depth-save.pth"


def test_another_file_under_a_published_name_is_told_by_its_checksum(monkeypatch, tmp_path):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    (tmp_path / "aliked-n16.pth").write_bytes(b"something")
    with pytest.raises(InputError, match=r"aliked-n16\.pth: not the weights that were published .* ALIKED"):
        find_weights("aliked-n16")


def test_research_only_weights_say_so_once(caplog):
    remind_of_licence.cache_clear()
    with caplog.at_level(logging.WARNING, logger="slimsfm"):
        for name in ("superpoint", "superpoint", "disk"):
            remind_of_licence(name)
    assert [record.getMessage() for record in caplog.records] == [
        "superpoint_v1.pth: its licence (Magic Leap) allows research only, no commercial use"
    ]


def test_what_is_missing_says_which_file_from_where_and_what_to_do():
    assert str(weights.missing(WEIGHTS["onepose"])) == (
        "weights GATsSPG.ckpt are missing; get them from the OnePose repository of zju3dv, whose README "
        "links it, put them into a folder and name it by --weights or SLIMSFM_WEIGHTS"
    )
