"""The matrix library runs on one thread meanwhile, and on as many as before afterwards."""

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
