from pathlib import Path

import pytest

from slimsfm.errors import InputError, MapError
from slimsfm.files import contents_of, read_json

PATH = Path("folder/a.json")


@pytest.mark.parametrize(
    "error",
    [ValueError("bad"), KeyError("x"), MemoryError(), RecursionError("deep"), UnicodeError("no text")],
)
def test_whatever_parsing_raises_is_the_error_of_the_file(error):
    pattern = r"^folder/a\.json: damaged \(.+\); write it again$"
    with pytest.raises(InputError, match=pattern), contents_of(PATH, "damaged", "write it again"):
        raise error


def test_errors_that_a_user_can_fix_keep_their_kind_and_name_the_file_once():
    for told in ("too large", "folder/a.json: too large"):
        with pytest.raises(MapError, match=r"^folder/a\.json: too large$"), contents_of(PATH, "damaged"):
            raise MapError(told)


def test_interruptions_pass():
    with pytest.raises(KeyboardInterrupt), contents_of(PATH, "damaged"):
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"[" * 100_000, "recursion"),
        (b"\xff", "decode"),
        (b"{", "Expecting"),
        (b"9" * 5000, "digits"),
        (None, "there is no such file"),
    ],
)
def test_json_that_cannot_be_read_is_named(tmp_path, data, reason):
    path = tmp_path / "a.json"
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.json: damaged \(.*{reason}"), contents_of(path, "damaged"):
        read_json(path)
