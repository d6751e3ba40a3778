import pytest

from slimsfm.errors import ImageError, InputError
from slimsfm.execution import processes, run_tasks
from slimsfm.limits import (
    FILE_GB,
    MEGAPIXELS,
    Limits,
    check_bytes,
    check_pixels,
    chosen_limits,
    current_limits,
    use_limits,
)


def test_limits_are_the_option_then_the_environment_then_the_default(monkeypatch):
    assert current_limits() == Limits()
    monkeypatch.setenv(MEGAPIXELS, "7")
    monkeypatch.setenv(FILE_GB, "3.5")
    assert current_limits() == Limits(max_megapixels=7.0, max_file_gb=3.5)
    assert Limits.from_environment(max_megapixels=2.0).max_megapixels == 2.0
    with use_limits(Limits(max_megapixels=1.0)):
        assert current_limits().max_megapixels == 1.0
    assert chosen_limits() is None


@pytest.mark.parametrize("value", ["many", "0", "-1", "nan", "inf"])
def test_impossible_limits_are_refused(monkeypatch, value):
    monkeypatch.setenv(MEGAPIXELS, value)
    with pytest.raises(InputError, match="must be a positive number"):
        current_limits()


def test_messages_name_the_limit_and_what_raises_it():
    check_pixels("a.png", 4000, 3000)
    with pytest.raises(
        ImageError,
        match="has 169 megapixels, more than the limit of 120; shrink it or pass `max_megapixels=169`",
    ):
        check_pixels("a.png", 13_000, 13_000)
    check_bytes("a.npz", 10**9)
    with pytest.raises(InputError, match=r"a\.npz: takes 8.5 GB of memory, more than the limit of 2 GB"):
        check_bytes("a.npz", 8_500_000_000)


def limit_of(_):
    return current_limits().max_megapixels


def test_limits_reach_worker_processes():
    with use_limits(Limits(max_megapixels=3.0)):
        assert dict(run_tasks(limit_of, [0, 1], lambda: processes(1))) == {0: 3.0, 1: 3.0}
