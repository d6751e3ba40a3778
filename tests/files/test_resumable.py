"""The hidden folder beside an output: of one process, removed in the end, kept where work was interrupted."""

import errno

import pytest

from slimsfm.errors import InputError, OutputError
from slimsfm.files.resumable import KEY_FILE, RESUME, resumable_folder


def begin(folder):
    (folder / KEY_FILE).write_text("{}")
    (folder / "part").mkdir()
    (folder / "part" / "done").write_bytes(b"")


def work(output, ends_with):
    """Work that has a part when it ends with an exception."""
    with resumable_folder(output) as folder:
        begin(folder)
        raise ends_with


def test_the_folder_is_removed_after_success_and_errors_with_the_folders_made_for_it(tmp_path):
    output = tmp_path / "new" / "map"
    with resumable_folder(output) as folder:
        begin(folder)
        assert folder == tmp_path / "new" / ".map.build"
    assert list((tmp_path / "new").iterdir()) == []
    (tmp_path / "new").rmdir()
    with pytest.raises(InputError):
        work(output, InputError())
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_keeps_the_folder_if_there_is_work_in_it(tmp_path):
    with pytest.raises(KeyboardInterrupt) as nothing, resumable_folder(tmp_path / "map"):
        raise KeyboardInterrupt
    assert str(nothing.value) == ""
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(KeyboardInterrupt, match=RESUME):
        work(tmp_path / "map", KeyboardInterrupt())
    with resumable_folder(tmp_path / "map") as folder:
        assert (folder / "part" / "done").exists()


def test_two_processes_do_not_share_the_folder(tmp_path):
    with resumable_folder(tmp_path / "map") as folder:
        begin(folder)
        with pytest.raises(OutputError, match=r"map: another process is making it now"):
            resumable_folder(tmp_path / "map").__enter__()
        assert (folder / "part" / "done").exists()
        with resumable_folder(tmp_path / "other"):
            pass


def test_a_full_disk_is_an_error_of_the_output(tmp_path):
    with pytest.raises(OutputError, match=r"map: cannot be written"):
        work(tmp_path / "map", OSError(errno.ENOSPC, "No space left on device"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("what", ["link", "file", "folder"])
def test_what_no_build_left_is_kept_and_named(tmp_path, what):
    foreign, mine = tmp_path / ".map.build", tmp_path / "mine"
    mine.mkdir()
    (mine / "photo").write_bytes(b"")
    if what == "link":
        foreign.symlink_to(mine)
    elif what == "file":
        foreign.write_bytes(b"")
    else:
        mine.rename(foreign)
    with pytest.raises(OutputError, match=r"\.map\.build: is in the way"):
        resumable_folder(tmp_path / "map").__enter__()
    assert foreign.is_file() or (foreign / "photo").exists()
