from pathlib import Path

import pytest

from scenes import exact_map, with_matches
from slimsfm.mapping.map import Map


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
