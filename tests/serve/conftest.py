from collections.abc import Iterator
from pathlib import Path

import pytest

for package in ("starlette", "uvicorn", "httpx", "segno", "cryptography"):
    pytest.importorskip(package, reason="the server needs its packages: pip install 'slimsfm[serve]'")

from poster import poster_map  # noqa: E402
from serving import Served, served  # noqa: E402
from slimsfm.mapping.io import write_map  # noqa: E402
from slimsfm.mapping.subset import keep_images  # noqa: E402


@pytest.fixture(scope="session")
def poster(tmp_path_factory) -> Path:
    """The folder of a map."""
    folder = tmp_path_factory.mktemp("maps") / "poster"
    write_map(poster_map(), folder)
    return folder


@pytest.fixture(scope="session")
def small(poster) -> Path:
    """The folder of a map with two of the images."""
    folder = poster.parent / "small poster"
    write_map(keep_images(poster_map(), ["1.png", "3.png"]), folder)
    return folder


@pytest.fixture(scope="module")
def server(poster) -> Iterator[Served]:
    with served(poster) as found:
        yield found
