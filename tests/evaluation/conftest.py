import pytest

from rendered import Rendered, rendered


@pytest.fixture(scope="session")
def boulder(tmp_path_factory) -> Rendered:
    return rendered(tmp_path_factory.getbasetemp() / "rendered")
