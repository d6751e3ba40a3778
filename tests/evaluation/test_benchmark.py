from dataclasses import replace

import pytest

from scenes import algorithm_1, camera, exact_map
from slimsfm.domination import dominates
from slimsfm.evaluation.benchmark import BenchmarkOptions, benchmark
from slimsfm.evaluation.protocol import (
    Label,
    PreparedQuery,
    Query,
    errors_of,
    evaluate,
    localize_all,
    prepare,
)
from slimsfm.reduction import ReductionOptions, keep_random_images
from strategies import CLASSICAL


@pytest.fixture(scope="module")
def narrow():
    return exact_map(num_images=10, reach_deg=65.0)


@pytest.fixture(scope="module")
def graph(narrow):
    return algorithm_1(narrow)


@pytest.fixture
def queries(narrow, tmp_path):
    """The references themselves, whose features are known and so need no file."""
    return [
        PreparedQuery(
            query=Query(path=tmp_path / name, camera=camera(), cam_from_world=image.cam_from_world()),
            features=narrow.features[name],
            extract_seconds=0.25,
        )
        for name, image in narrow.images.items()
    ]


@pytest.fixture
def stored():
    return {}


@pytest.fixture
def store(stored):
    def keep(map_, name):
        stored[name] = map_
        return map_, 1000 * len(map_.images)

    return keep


def weigh(map_):
    return 100 * len(map_.point3D_ids)


def test_a_benchmark_of_an_exact_scene(narrow, graph, queries, stored, store):
    result = benchmark(narrow, graph, queries, name="exact", store=store, weigh=weigh)
    labels = [(row.strategy, row.variant) for row in result.rows]
    images = ["full", "dominating", "random"]
    by_images = [(s, v) for s in ("exhaustive", "retrieval", "progressive") for v in images]
    assert labels == by_images + [("direct", v) for v in [*images[:2], "default", images[2]]]
    count = len(result.solution.chosen)
    assert dominates(graph.adjacency(), result.solution.chosen)
    for row in result.rows:
        assert row.object == "exact"
        assert row.references == (10 if row.variant in ("full", "default") else count)
        assert row.map_bytes == 1000 * row.references
        assert row.scores.queries == 10
        assert row.scores.seconds.extract == 0.25
        if row.variant != "random":  # a dominating set localizes every image, here without error
            assert row.scores.localized == 100.0
            assert row.scores.add == {0.1: 100.0, 0.05: 100.0, 0.02: 100.0}
            assert row.scores.deg_cm == {1: 100.0, 3: 100.0, 5: 100.0}
            assert row.scores.median_corner_error < 1e-4
    assert set(stored) == {"full-0", "dominating-0", "default-0", *(f"random-{i}" for i in range(5))}
    assert stored["default-0"].is_for_direct_matching
    assert len(stored["default-0"].point3D_ids) < len(narrow.point3D_ids)
    assert list(stored["dominating-0"].images) == [graph.names[i] for i in result.solution.chosen]


def test_random_variants_are_the_five_seeds_and_their_row_the_mean(narrow, graph, queries, stored, store):
    options = BenchmarkOptions(strategies=("direct",), variants=("random",))
    result = benchmark(narrow, graph, queries, name="exact", store=store, weigh=weigh, options=options)
    (row,) = result.rows
    count = len(result.solution.chosen)
    draws = [keep_random_images(narrow, count, seed=seed) for seed in range(5)]
    assert [list(stored[f"random-{i}"].images) for i in range(5)] == [list(one.images) for one in draws]
    found = [
        evaluate(one, queries, Label(object="exact", strategy="direct", variant="random"), map_bytes=1)
        for one in draws
    ]
    assert row.scores.localized == pytest.approx(sum(one.scores.localized for one in found) / 5)
    assert row.points == pytest.approx(sum(one.points for one in found) / 5)


def test_the_threshold_of_the_reduction_is_obeyed(narrow, graph, queries, store):
    strict = BenchmarkOptions(
        strategies=("direct",), variants=("dominating",), reduction=ReductionOptions(threshold=1e-12)
    )
    result = benchmark(narrow, graph, queries, name="exact", store=store, weigh=weigh, options=strict)
    assert len(result.solution.chosen) == 10


def test_a_map_of_unknown_unit_has_no_centimetres(narrow, queries):
    unknown = replace(narrow, info=replace(narrow.info, unit="unknown"))
    row = evaluate(unknown, queries, Label(object="exact", strategy="direct", variant="full"), map_bytes=1)
    assert row.scores.deg_cm is None
    assert row.scores.localized == 100.0


@pytest.mark.parametrize("strategy", CLASSICAL)
def test_queries_come_back_in_order_and_no_query_is_refused(narrow, queries, strategy):
    errors = errors_of(narrow, queries, localize_all(narrow, queries, strategy))
    assert len(errors) == 10
    assert max(error.relative_corner_error for error in errors) < 1e-4
    with pytest.raises(ValueError, match="queries must hold at least one"):
        localize_all(narrow, [], strategy)


def test_preparing_extracts_what_the_maps_extractor_finds(boulder):
    map_, sequence = boulder.map, boulder.mapping
    queries = [
        Query(path=path, camera=sequence.camera, cam_from_world=pose)
        for path, pose in zip(sequence.image_paths[:3], sequence.cam_from_world, strict=False)
    ]
    for query, prepared in zip(queries, prepare(map_, queries), strict=True):
        stored = map_.features[query.path.name]
        assert (prepared.features.keypoints == stored.keypoints).all()
        assert (prepared.features.descriptors == stored.descriptors).all()
        assert prepared.extract_seconds > 0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"strategies": ("direct", "guess")},
            "strategies must be among direct, exhaustive, .*, retrieval, got direct, guess",
        ),
        ({"strategies": ()}, "strategies must be among .* got none"),
        ({"variants": ("half",)}, "variants must be among full, dominating, default, random, got half"),
    ],
)
def test_bad_options_are_named(values, message):
    with pytest.raises(ValueError, match=message):
        BenchmarkOptions(**values)
