from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from exif_photos import save_photo
from scenes import camera, exact_map
from slimsfm.errors import ImageError
from slimsfm.evaluation.results import (
    PosedQuery,
    PreparedQuery,
    evaluate,
    localize_all,
    prepare_queries,
    queries_of,
    readable_queries,
)
from slimsfm.photos import Orientation
from strategies import CLASSICAL


@pytest.fixture(scope="module")
def narrow():
    return exact_map(num_images=8, reach_deg=65.0)


@pytest.fixture
def queries(narrow, tmp_path):
    """The references as queries; their features are known, so no file is needed."""
    return [
        PreparedQuery(
            query=PosedQuery(path=tmp_path / name, camera=camera(), cam_from_world=image.cam_from_world()),
            features=narrow.features[name],
            extract_seconds=0.25,
        )
        for name, image in narrow.images.items()
    ]


@pytest.mark.parametrize("strategy", CLASSICAL)
def test_outcomes_come_in_the_order_of_the_queries(narrow, queries, strategy):
    outcomes = evaluate(narrow, queries, strategy)
    assert len(outcomes) == 8
    assert outcomes.error.max() < 1e-4
    assert outcomes.seconds[:, 0].tolist() == [0.25] * 8


@pytest.mark.parametrize("orientation", get_args(Orientation))
def test_queries_are_read_in_the_pixels_of_their_poses(narrow, textured, tmp_path, orientation):
    path = save_photo(tmp_path / "a.png", textured, 6)
    pose = narrow.images["001.png"].cam_from_world()
    query = PosedQuery(path=path, camera=camera(), cam_from_world=pose, orientation=orientation)
    (prepared,) = prepare_queries(narrow, [query])
    assert prepared.features.image_size == ((320, 240) if orientation == "upright" else (240, 320))


@pytest.mark.parametrize("strategy", CLASSICAL)
def test_no_query_is_an_error(narrow, strategy):
    with pytest.raises(ValueError, match="queries must hold at least one"):
        localize_all(narrow, [], strategy)


def test_queries_that_cannot_be_localized_stay_in_their_place(narrow, queries):
    """A query without any match to the map fails, and the others are not affected."""
    rng = np.random.default_rng(0)
    lost = queries[3].features
    strange = rng.normal(size=lost.descriptors.shape).astype(np.float32)
    queries[3] = PreparedQuery(
        query=queries[3].query,
        features=type(lost)(
            keypoints=lost.keypoints,
            descriptors=strange / np.linalg.norm(strange, axis=1, keepdims=True),
            scores=lost.scores,
            image_size=lost.image_size,
        ),
        extract_seconds=0.25,
    )
    outcomes = evaluate(narrow, queries, "exhaustive")
    assert np.flatnonzero(np.isinf(outcomes.error)).tolist() == [3]
    assert [pose is None for pose in outcomes.cam_from_world].index(True) == 3


def test_preparing_uses_the_extractor_of_the_map(boulder):
    map_, queries = boulder.map, queries_of(boulder.mapping)[:3]
    for query, prepared in zip(queries, prepare_queries(map_, queries), strict=True):
        stored = map_.features[query.path.name]
        assert (prepared.features.keypoints == stored.keypoints).all()
        assert (prepared.features.descriptors == stored.descriptors).all()
        assert prepared.query is query
        assert prepared.extract_seconds > 0


def test_the_frames_of_a_sequence_are_queries(boulder):
    queries = queries_of(boulder.query)
    assert [one.path for one in queries] == list(boulder.query.image_paths)
    assert [one.cam_from_world for one in queries] == list(boulder.query.cam_from_world)
    assert all(one.camera.width == 320 for one in queries)


def test_queries_that_cannot_be_read_are_left_out_and_named(boulder, tmp_path):
    good = queries_of(boulder.query)
    (tmp_path / "a.png").write_bytes(good[0].path.read_bytes()[:5000])
    broken = replace(good[1], path=tmp_path / "a.png")
    left, skipped = readable_queries([good[0], broken, *good[1:]], boulder.query.folder)
    assert left == good
    assert list(skipped) == [str(tmp_path / "a.png")]
    assert skipped[str(tmp_path / "a.png")].startswith("not a readable image")
    with pytest.raises(ImageError, match=r"a\.png: not a readable image"):
        readable_queries([broken], tmp_path)
