"""What the program asks of an extractor or a strategy it knows only by its registry entry."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from slimsfm.errors import InputError
from slimsfm.features import NearestOptions
from slimsfm.features.registry import plugins
from slimsfm.localization import STRATEGIES, LocalizationOptions, Localizer
from slimsfm.localization.options import supports
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.localization.strategies import Direct
from slimsfm.mapping.hloc import write_hloc
from slimsfm.mapping.importing import ImportOptions, import_colmap
from slimsfm.mapping.subset import direct_map

METRIC = NearestOptions(max_ratio=0.99, max_distance=1.1)


class OwnExtractor:
    """An extractor of a third party."""

    descriptor_metric = METRIC
    descriptor_length = 128
    signed = True


class Recording(Direct):
    """Keeps the queries that it is given."""

    queries: list = []  # noqa: RUF012

    def rounds(self, query):
        self.queries.append(query)
        yield from super().rounds(query)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package with entry points for this module's extractor."""
    folder = tmp_path / "own-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Name: own\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(f"[slimsfm.extractors]\nown = {__name__}:OwnExtractor\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    plugins.cache_clear()
    yield
    plugins.cache_clear()


@pytest.mark.usefixtures("installed")
def test_a_plug_in_states_how_its_descriptors_compare(exact):
    own = replace(exact, info=replace(exact.info, extractor="own"))
    assert own.descriptor_metric == METRIC
    assert own.has_keypoints


@pytest.mark.usefixtures("installed")
def test_features_are_imported_by_what_a_plug_in_states(exact, tmp_path):
    def imported(change):
        wide = {
            name: replace(one, descriptors=change(np.tile(one.descriptors, 4)))
            for name, one in exact.features.items()
        }
        write_hloc(replace(exact, features=wide), tmp_path / "hloc", overwrite=True)
        options = ImportOptions(features=tmp_path / "hloc" / "features.h5", extractor="own")
        return import_colmap(tmp_path / "hloc" / "sfm", options=options)

    assert imported(lambda rows: rows).info.extractor == "own"
    for wrong in (lambda rows: rows[:, :127], np.abs):
        with pytest.raises(InputError, match="unlike those of 'own'"):
            imported(wrong)


def test_a_map_of_an_extractor_that_is_not_installed_has_the_default_metric(exact):
    unknown = replace(exact, info=replace(exact.info, extractor="gone"))
    assert unknown.descriptor_metric == exact.descriptor_metric == NearestOptions()
    assert unknown.has_keypoints


def test_strategies_are_supported_by_maps_that_have_what_they_require(exact):
    without = replace(exact, info=replace(exact.info, extractor="loftr"))
    direct = direct_map(exact, describe_points(exact)[np.arange(20)])
    assert not without.has_keypoints
    assert [supports(name, exact) for name in ("direct", "exhaustive")] == [True, True]
    assert [supports(name, without) for name in ("direct", "exhaustive")] == [False, True]
    assert [supports(name, direct) for name in ("direct", "exhaustive")] == [True, False]


def test_a_query_does_not_change_with_the_next_query(exact, monkeypatch):
    monkeypatch.setitem(STRATEGIES, "recording", f"{__name__}:Recording")
    monkeypatch.setattr(Recording, "queries", [])
    localizer = Localizer(exact, LocalizationOptions(strategy="recording"))
    first, second = list(exact.images)[:2]
    localizer.localize_features(exact.features[first], exact.camera(first))
    before = Recording.queries[0].descriptors.copy()
    localizer.localize_features(exact.features[second], exact.camera(second))
    np.testing.assert_array_equal(Recording.queries[0].descriptors, before)
