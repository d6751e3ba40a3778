import os
import shutil
import subprocess
import sys
from contextlib import nullcontext
from threading import Thread
from time import sleep

import numpy as np
import pytest

from slimsfm.errors import OutputError, OutputExistsError
from slimsfm.files import (
    check_writable,
    read_unchanged,
    remove,
    remove_abandoned,
    renaming,
    replacing,
    working_folder,
)
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
        assert partial.name == path.name
        assert partial.parent.parent == path.parent
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


def test_working_folders_of_killed_processes_are_removed_and_others_kept(tmp_path):
    code = f"""
import os, signal
from pathlib import Path
from slimsfm.files import replacing
with replacing({str(tmp_path / "result")!r}, overwrite=False) as partial:
    partial.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    subprocess.run([sys.executable, "-c", code], check=False)
    assert len(list(tmp_path.iterdir())) == 1
    with working_folder(tmp_path) as used:
        with replacing(tmp_path / "other", overwrite=False) as partial:
            write_file(partial)
        assert sorted(tmp_path.iterdir()) == sorted([used, tmp_path / "other"])
    assert list(tmp_path.iterdir()) == [tmp_path / "other"]


def test_temporary_working_folders_of_killed_processes_are_removed(tmp_path):
    code = """
import os, signal
from slimsfm.files import working_folder
with working_folder():
    os.kill(os.getpid(), signal.SIGKILL)
"""
    subprocess.run([sys.executable, "-c", code], env={**os.environ, "TMPDIR": str(tmp_path)}, check=False)
    (tmp_path / ".slimsfm-mine").mkdir()
    assert len(list(tmp_path.iterdir())) == 2
    remove_abandoned(tmp_path)
    assert list(tmp_path.iterdir()) == [tmp_path / ".slimsfm-mine"]


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("old", [None, *WRITERS])
def test_of_two_writers_the_first_wins_and_the_other_says_so(tmp_path, write, old):
    path = tmp_path / "result"
    if old:
        old(path, "old")

    def write_inside_another():
        with replacing(path, overwrite=True) as second:
            with replacing(path, overwrite=True) as first:
                write(first, "first")
            write(second, "second")

    with pytest.raises(OutputExistsError, match="another process wrote it at the same time"):
        write_inside_another()
    assert content(path) == "first"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("exists", [True, False])
def test_a_link_is_kept_and_what_it_points_to_is_written(tmp_path, write, exists):
    target, link = tmp_path / "target", tmp_path / "link"
    if exists:
        write(target, "old")
    link.symlink_to(target)
    with replacing(link, overwrite=True) as partial:
        write(partial, "new")
    assert link.is_symlink()
    assert content(target) == "new"
    assert sorted(tmp_path.iterdir()) == [link, target]


def test_a_link_in_a_circle_and_a_device_are_refused(tmp_path):
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    with (
        pytest.raises(OutputError, match="cannot be written"),
        replacing(tmp_path / "circle", overwrite=True),
    ):
        pytest.fail("the block must not run")
    with pytest.raises(OutputError, match="neither a file nor a folder"):
        check_writable("/dev/null", overwrite=True)


@pytest.mark.parametrize("supported", [True, False], ids=["in one step", "in several"])
def test_renames_exchange_and_replace_nothing(tmp_path, monkeypatch, supported):
    if not supported:
        monkeypatch.setattr(renaming, "_renameat2", lambda *_: False)
    a, b = tmp_path / "a", tmp_path / "b"
    write_file(a, "a")
    write_folder(b, "b")
    renaming.exchange(a, b)
    assert (content(a), content(b)) == ("b", "a")
    with pytest.raises(FileExistsError):
        renaming.rename_new(a, b)
    b.unlink()
    renaming.rename_new(a, b)
    assert content(b) == "b"
    with pytest.raises(FileNotFoundError):
        renaming.exchange(a, b)
    assert list(tmp_path.iterdir()) == [b]


def test_a_folder_that_is_replaced_while_it_is_read_is_read_again(tmp_path):
    path, versions = tmp_path / "result", iter("bcd")
    write_folder(path, "a")

    def read():
        first = content(path)
        if version := next(versions, None):
            renaming.exchange(path, new(version))
        return first + content(path)

    def new(version):
        write_folder(tmp_path / version, version)
        return tmp_path / version

    assert read_unchanged(path, read) == "dd"


def test_a_writer_waits_for_a_reader(tmp_path):
    path = tmp_path / "result"
    write_folder(path, "old")
    seen = []

    def read():
        writer.start()
        for _ in range(20):
            seen.append(content(path))
            sleep(0.005)

    def write():
        with replacing(path, overwrite=True) as partial:
            write_folder(partial, "new")

    writer = Thread(target=write)
    read_unchanged(path, read)
    writer.join()
    assert set(seen) == {"old"}
    assert content(path) == "new"


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
