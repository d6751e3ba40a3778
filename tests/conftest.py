import logging
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import jaxtyping
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from scenes import exact_map, with_matches
from slimsfm.limits import use_limits
from slimsfm.mapping.map import Map
from slimsfm.weights import use_runtime

if "PYTEST_XDIST_WORKER" in os.environ:  # there are as many processes as cores: threads of each would collide
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"
    threadpool_limits(1)


AS_USERS_RUN_IT = ("cli", "docs", "evaluation", "examples", "serve", "report")
"""Folders of tests of the whole program, without the checks of types that double its time; the tests of the
library, which all of it is made of, have them."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Check types or not."""
    folder = item.path.relative_to(Path(__file__).parent).parts[0]
    jaxtyping.config.update("jaxtyping_disable", folder in AS_USERS_RUN_IT)


@pytest.fixture(autouse=True)
def restored_runtime() -> Iterator[None]:
    """Start each test without a runtime and limits: a command that ran in this process may have left some."""
    with use_runtime(None), use_limits(None):
        yield


@pytest.fixture(scope="session")
def exact() -> Map:
    """Six images, every point in each of them, no error anywhere."""
    return with_matches(exact_map())


@pytest.fixture(scope="session")
def photos() -> Path:
    """The folder of real photographs, which lies beside the checkout where there is one."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("needs the real photographs in ../shared/data, which are not here")
    return folder


@pytest.fixture(scope="session")
def scheduler() -> Iterator[str]:
    """The address of a Dask cluster of two worker processes; a task that kills one of them is not sent on."""
    dask, distributed = pytest.importorskip("dask"), pytest.importorskip("distributed")
    with (
        dask.config.set(
            {"distributed.scheduler.allowed-failures": 0, "distributed.comm.timeouts.connect": "10s"}
        ),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=logging.CRITICAL
        ) as cluster,
    ):
        yield cluster.scheduler_address


@pytest.fixture(scope="session")
def textured() -> np.ndarray:
    """Noise of several scales: blobs and corners of every size."""
    rng = np.random.default_rng(0)
    layers = [
        cv2.GaussianBlur(rng.normal(size=(240, 320, 3)).astype(np.float32), None, sigma) * sigma
        for sigma in (1.0, 2.0, 4.0, 8.0)
    ]
    return np.clip(128 + 90 * np.sum(layers, axis=0), 0, 255).astype(np.uint8)
