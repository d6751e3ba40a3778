import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from commands import slimsfm
from slimsfm.features import load_matcher, match_nearest, unit_rows
from slimsfm.features.registry import plugins
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.strategy import MatchingOptions

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_matcher"


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """What installing the example would put beside its module: the entry points of its project file."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    told = tmp_path / f"own_matcher-{project['version']}.dist-info"
    told.mkdir()
    (told / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    lines = []
    for group, offered in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {path}" for name, path in offered.items())]
    (told / "entry_points.txt").write_text("\n".join(lines) + "\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), str(EXAMPLE), *sys.path])
    plugins.cache_clear()
    yield
    plugins.cache_clear()
    sys.modules.pop("own_matcher", None)


def test_it_is_as_short_as_the_guide_says():
    assert len((EXAMPLE / "own_matcher.py").read_text().splitlines()) < 40


@pytest.mark.usefixtures("installed")
def test_an_installed_matcher_is_listed_and_loaded():
    assert "softmax" in slimsfm("methods").out
    assert type(load_matcher("softmax", "sift")).__name__ == "SoftmaxMatcher"


@pytest.mark.usefixtures("installed")
def test_it_matches_about_what_nearest_neighbours_do(exact):
    one, other = (exact.features[name] for name in ("001.png", "004.png"))
    pairs = load_matcher("softmax", "sift").match(one, other)
    nearest = match_nearest(unit_rows(one.descriptors), unit_rows(other.descriptors))
    assert len({*map(tuple, pairs)} & {*map(tuple, nearest)}) > 0.9 * len(nearest)


@pytest.mark.usefixtures("installed")
def test_a_map_is_localized_with_it(exact):
    options = LocalizationOptions(strategy="exhaustive", matching=MatchingOptions(matcher="softmax"))
    name = "003.png"
    found = Localizer(exact, options).localize_features(exact.features[name], exact.camera(name))
    assert np.allclose(
        found.pose.cam_from_world.matrix(), exact.images[name].cam_from_world().matrix(), atol=1e-3
    )


def test_the_guide_shows_all_of_it():
    guide = (EXAMPLE.parents[1] / "docs" / "learned.md").read_text()
    assert (EXAMPLE / "own_matcher.py").read_text().strip() in guide
