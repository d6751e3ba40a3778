import os
import shutil
import subprocess
from contextlib import nullcontext

import numpy as np
import pytest

from slimsfm.errors import OutputError, OutputExistsError
from slimsfm.files import check_writable, remove, replacing
from slimsfm.mapping.io import read_map, write_map


def write_file(partial, text="new"):
    partial.write_text(text)


def write_folder(partial, text="new"):
    partial.mkdir()
    (partial / "part").write_text(text)


WRITERS = [write_file, write_folder]


def content(path):
    return (path / "part" if path.is_dir() else path).read_text()


@pytest.mark.parametrize("write", WRITERS)
def test_result_appears_when_the_block_ends_and_not_before(tmp_path, write):
    path = tmp_path / "new" / "folder" / "result"
    with replacing(path, overwrite=False) as partial:
        write(partial)
        assert not path.exists()
        assert partial.parent == path.parent
    assert content(path) == "new"
    assert list(path.parent.iterdir()) == [path]


def test_paths_may_be_strings(tmp_path):
    path = str(tmp_path / "result")
    check_writable(path, overwrite=False)
    with replacing(path, overwrite=False) as partial:
        write_file(partial)
    with pytest.raises(OutputExistsError, match="exists already"):
        check_writable(path, overwrite=False)
    remove(path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("old", [None, *WRITERS])
@pytest.mark.parametrize("write", WRITERS)
def test_failed_block_changes_nothing(tmp_path, write, old, failure):
    path = tmp_path / "result"
    if old:
        old(path, "old")

    def fail():
        with replacing(path, overwrite=True) as partial:
            write(partial)
            raise failure

    with pytest.raises(failure):
        fail()
    assert [content(item) for item in tmp_path.iterdir()] == (["old"] if old else [])


@pytest.mark.parametrize("old", WRITERS)
@pytest.mark.parametrize("write", WRITERS)
def test_overwriting_swaps_files_and_folders(tmp_path, write, old):
    path = tmp_path / "result"
    old(path, "old")
    with replacing(path, overwrite=True) as partial:
        write(partial)
    assert content(path) == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("old", WRITERS)
def test_existing_output_is_not_overwritten_by_default(tmp_path, old):
    path = tmp_path / "result"
    old(path, "old")
    with pytest.raises(OutputError, match="exists already"), replacing(path, overwrite=False):
        pytest.fail("the block must not run")
    assert content(path) == "old"


def test_leftovers_of_a_killed_run_are_removed(tmp_path):
    path = tmp_path / "result"
    with replacing(path, overwrite=False) as partial:
        write_folder(partial, "first")
    write_folder(partial, "remains")
    write_folder(partial.with_suffix(".old"), "remains")
    with replacing(path, overwrite=True) as partial:
        write_folder(partial)
    assert content(path) == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_block_that_writes_nothing_keeps_the_old_output(tmp_path):
    path = tmp_path / "result"
    path.write_text("old")
    with pytest.raises(OutputError, match="cannot be written"), replacing(path, overwrite=True):
        pass
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_failure_to_read_an_input_is_not_reported_as_a_failure_to_write(tmp_path):
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "result", overwrite=False) as partial:
        partial.write_text((tmp_path / "missing").read_text())
    assert list(tmp_path.iterdir()) == []


def test_error_names_a_file_in_place_of_a_folder(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="file is not a folder"):
        check_writable(tmp_path / "file" / "deep" / "result", overwrite=True)


def test_impossible_file_name_is_an_output_error(tmp_path):
    path = tmp_path / ("x" * 300)
    with pytest.raises(OutputError, match="cannot be written"), replacing(path, overwrite=False):
        pytest.fail("the block must not run")


def test_removing_a_link_keeps_its_target(tmp_path):
    write_folder(tmp_path / "kept")
    (tmp_path / "link").symlink_to(tmp_path / "kept")
    remove(tmp_path / "link")
    remove(tmp_path / "missing")
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


@pytest.fixture
def mount(tmp_path):
    """Mounts a small file system in memory, where permitted."""
    folder = tmp_path / "mounted"
    folder.mkdir()

    def mounted(options):
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        if os.geteuid() != 0 or shutil.which("mount") is None:
            pytest.skip("only root can mount a file system")
        if subprocess.run(command, capture_output=True).returncode != 0:
            pytest.skip("mounting is not permitted here")
        return folder

    yield mounted
    if os.path.ismount(folder):
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.parametrize("depth", ["result", "deep/result", "deep/deeper/result"])
def test_read_only_file_system_is_an_output_error(mount, depth):
    folder = mount("size=64k,ro")
    with pytest.raises(OutputError, match="cannot be written"), replacing(folder / depth, overwrite=False):
        pytest.fail("the block must not run")


def test_read_only_parent_is_an_output_error(tmp_path):
    if os.geteuid() == 0:
        pytest.skip("root may write anywhere")
    tmp_path.chmod(0o500)
    try:
        for path in (tmp_path / "result", tmp_path / "deep" / "deeper" / "result"):
            with pytest.raises(OutputError, match="cannot be written"), replacing(path, overwrite=False) as p:
                p.write_text("new")
    finally:
        tmp_path.chmod(0o700)


def test_full_disk_is_an_output_error_and_keeps_the_old_result(mount):
    folder = mount("size=64k")
    path = folder / "result"
    path.write_text("old")
    with (
        pytest.raises(OutputError, match="No space left"),
        replacing(path, overwrite=True) as partial,
        partial.open("wb") as file,
    ):
        file.write(np.zeros(1_000_000, np.uint8).tobytes())
    assert path.read_text() == "old"
    assert list(folder.iterdir()) == [path]


@pytest.mark.parametrize("kilobytes", [*range(8, 128, 8), 200, 300])
def test_map_on_a_small_disk_is_written_completely_or_not_at_all(mount, exact, kilobytes):
    folder = mount(f"size={kilobytes}k")
    fits = kilobytes >= 200
    with nullcontext() if fits else pytest.raises(OutputError, match="cannot be written"):
        write_map(exact, folder / "map")
    if fits:
        assert set(read_map(folder / "map").matches) == set(exact.matches)
    else:
        assert list(folder.iterdir()) == []
