import lzma
import os
import tracemalloc
from contextlib import suppress

import numpy as np
import pytest

from mutations import mutations
from slimsfm.errors import InputError
from slimsfm.files import contents_of, read_npz, unpacked
from slimsfm.limits import Limits, use_limits

ARRAYS = {
    "numbers": np.arange(12.0).reshape(3, 4),
    "turned": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
    "text": np.array(["a", "bc"]),
    "scalar": np.array(7, np.uint32),
    "empty": np.zeros((0, 3), np.float32),
}


@pytest.fixture
def path(tmp_path):
    np.savez(tmp_path / "a.npz", **ARRAYS)
    return tmp_path / "a.npz"


def read(path):
    with contents_of(path, "damaged"):
        return read_npz(path)


def test_arrays_come_back_as_they_were(path):
    found = read(path)
    assert list(found) == list(ARRAYS)
    for name, values in ARRAYS.items():
        assert found[name].dtype == values.dtype
        assert np.array_equal(found[name], values)


def test_a_damaged_file_gives_equal_arrays_or_is_refused_by_name(path):
    whole = path.read_bytes()
    for name, damaged in mutations(whole, seed=2, count=300):
        path.write_bytes(damaged)
        with suppress(InputError):
            found = read(path)
            assert all(np.array_equal(found[key], ARRAYS[key]) for key in ARRAYS.keys() & found), name


@pytest.mark.parametrize("damage", ["compressed", "objects", "not there", "text"])
def test_files_of_other_kinds_are_refused(path, damage):
    if damage == "compressed":
        np.savez_compressed(path, zeros=np.zeros(10**8, np.uint8))
    elif damage == "objects":
        np.savez(path, objects=np.array([{}], object))
    else:
        path.unlink()
        if damage == "text":
            path.write_text("numbers")
    tracemalloc.start()
    with pytest.raises(
        InputError, match=r"a\.npz: damaged \((its arrays are compressed|it holds|there is|File)"
    ):
        read(path)
    assert tracemalloc.get_traced_memory()[1] < 10**7
    tracemalloc.stop()


def test_a_header_that_claims_more_than_there_is_is_refused(path):
    whole = path.read_bytes()
    claimed = whole.replace(b"(3, 4)", b"(9**9)").replace(b"(9**9)", b"(3,9,)")
    assert claimed != whole
    path.write_bytes(claimed)
    with pytest.raises(InputError, match=r"a\.npz: damaged"):
        read(path)


def test_a_file_beyond_the_limit_is_refused_with_its_name(path):
    with (
        use_limits(Limits(max_file_gb=1e-7)),
        pytest.raises(InputError, match=r"a\.npz.*SLIMSFM_MAX_FILE_GB"),
    ):
        read(path)


@pytest.mark.parametrize("count", [0, 1, 1000, 200_000])
def test_packed_values_unpack_to_at_most_their_size(count):
    values = os.urandom(count)
    packed = lzma.compress(values)
    assert unpacked(packed, count) == unpacked(packed, count + 7) == values
    for bad in (packed[:-1], packed + b"x", packed[:20]):
        with pytest.raises((ValueError, lzma.LZMAError)):
            unpacked(bad, count)
    if count:
        with pytest.raises(ValueError, match="more than"):
            unpacked(packed, count - 1)


def test_a_bomb_is_not_unpacked():
    packed = lzma.compress(bytes(2 * 10**8), preset=1)
    tracemalloc.start()
    with pytest.raises(ValueError, match="more than 1000 bytes"):
        unpacked(packed, 1000)
    assert tracemalloc.get_traced_memory()[1] < 10**7
    tracemalloc.stop()
