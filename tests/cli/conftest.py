import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from commands import Outcome, slimsfm
from rendered import Rendered, rendered


@pytest.fixture(scope="session")
def boulder(tmp_path_factory) -> Rendered:
    return rendered(tmp_path_factory.getbasetemp() / "rendered")


@dataclass(frozen=True)
class Reduced:
    path: Path
    graph: Path
    outcome: Outcome


@pytest.fixture(scope="session")
def reduced(boulder, tmp_path_factory) -> Reduced:
    """A dominating set of the rendered object's images, kept by the command; the graph is in the full map."""
    path = tmp_path_factory.mktemp("reduced") / "slim"
    outcome = slimsfm("reduce", boulder.map_path, "-o", path, "--solver", "exact")
    return Reduced(path, boulder.map_path / "graph-matches.npz", outcome)


@pytest.fixture
def a_map(boulder, tmp_path) -> Path:
    """A copy of the rendered object's map, which a test may damage."""
    return Path(shutil.copytree(boulder.map_path, tmp_path / "map"))
