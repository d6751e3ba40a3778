"""Products of matrices on one thread, so that results do not depend on the number of cores."""

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


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
