from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slimsfm.errors import InputError
from slimsfm.files import inside

PARTS = st.sampled_from(["..", ".", "", "a", "b c", "\0", "/", "...", "a[", "ä"])


@given(st.lists(PARTS, max_size=5).map("/".join))
def test_a_path_never_leaves_its_folder(name):
    with suppress(InputError):
        path = inside(Path("/no/such/folder"), name).resolve()
        assert path.is_relative_to("/no/such/folder")
        assert path != Path("/no/such/folder")


@pytest.mark.parametrize("name", ["a.jpg", "a/b.jpg", "./a", "a b", "IMG [edited].jpg", "...", "a..b"])
def test_ordinary_names_are_accepted(name):
    assert inside(Path("folder"), name) == Path("folder") / name


@pytest.mark.parametrize("name", ["", ".", "/etc/passwd", "../a", "a/../../b", "..", "a\0b", 256 * "x"])
def test_names_that_lead_elsewhere_are_refused(name):
    with pytest.raises(InputError, match="rename it"):
        inside(Path("folder"), name)
