"""Threads of matrix libraries and networks: how many, and how they wait."""

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController

_POLICY = "OMP_WAIT_POLICY"


def one_blas_thread() -> AbstractContextManager[object]:
    """Let the matrix library use one thread meanwhile.

    With several, products round differently. And after a product, the library's threads wait for the next one
    by spinning for some milliseconds, on cores that the extraction of features could use: on two cores, whole
    queries took 1.4 times as long. Entering takes 10 microseconds.
    """
    return _controller().limit(limits=1)


@cache
def _controller() -> ThreadpoolController:
    """Looks through all loaded libraries, which takes milliseconds; those of NumPy and SciPy are loaded."""
    return ThreadpoolController().select(user_api="blas")


@contextmanager
def waiting_without_spinning() -> Iterator[None]:
    """Let the threads of OpenMP libraries that are loaded meanwhile sleep when they wait for each other.

    By default they spin. Where other work keeps a core busy, PyTorch's threads then wait for one that does
    not run: XFeat took up to twenty times as long. The user's `OMP_WAIT_POLICY` is respected.
    """
    if _POLICY in os.environ:
        yield
        return
    os.environ[_POLICY] = "PASSIVE"  # libraries only read it from there, once, when they are loaded
    try:
        yield
    finally:
        os.environ.pop(_POLICY, None)
