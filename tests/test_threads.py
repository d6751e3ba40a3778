"""The matrix library runs on one thread meanwhile; threads of networks do not spin."""

import os
import subprocess
import sys

import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from slimsfm.threads import one_blas_thread


def _threads() -> set[int]:
    return {one["num_threads"] for one in ThreadpoolController().select(user_api="blas").info()}


@pytest.fixture(autouse=True)
def _two_threads():
    with threadpool_limits(2, user_api="blas"):
        yield


def test_one_thread_meanwhile_and_as_many_as_before_afterwards():
    with one_blas_thread():
        assert _threads() == {1}
        with one_blas_thread():
            assert _threads() == {1}
        assert _threads() == {1}
    assert _threads() == {2}


def test_an_error_restores_the_threads():
    with pytest.raises(KeyError), one_blas_thread():
        raise KeyError
    assert _threads() == {2}


def _policies_of_openmp(environment: dict[str, str]) -> list[str]:
    """What OpenMP libraries say of themselves as they are loaded; PyTorch's is the last."""
    pytest.importorskip("torch")
    code = "import os; from slimsfm.features.registry import load_extractor; load_extractor('xfeat'); " + (
        "print(os.environ.get('OMP_WAIT_POLICY'))"
    )
    inherited = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    found = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**inherited, "OMP_DISPLAY_ENV": "TRUE", **environment},
    )
    assert found.stdout.strip() == environment.get("OMP_WAIT_POLICY", "None")
    return [line for line in found.stderr.splitlines() if "OMP_WAIT_POLICY" in line]


def test_threads_of_networks_sleep_while_they_wait():
    assert "PASSIVE" in _policies_of_openmp({})[-1]


def test_a_policy_that_the_user_set_is_kept():
    assert all("ACTIVE" in line for line in _policies_of_openmp({"OMP_WAIT_POLICY": "ACTIVE"}))
