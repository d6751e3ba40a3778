import shutil
from dataclasses import replace

import numpy as np
import pytest

from slimsfm.datasets.base import ObjectModel, ObjectSequences, PosedSequence
from slimsfm.domination import dominates
from slimsfm.evaluation.benchmark import (
    IN_ROUNDS,
    BenchmarkOptions,
    BenchmarkSetup,
    benchmark_object,
    graph_options,
    parse_method,
)
from slimsfm.evaluation.results import evaluate, map_path, prepare_queries
from slimsfm.evaluation.table import rows_of
from slimsfm.geometry import corner_error
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.mapping.build import BuildOptions
from slimsfm.mapping.io import bytes_by_part, read_map
from slimsfm.reduction import DominatingSetOptions, keep_random_images

OPTIONS = BenchmarkOptions(strategies=("exhaustive", "direct"))
SPAN, QUERIES = range(14, 22), (16, 19)


def frames_of(sequence, numbers):
    chosen = [sequence.names.index(f"{number}.png") for number in numbers]
    return PosedSequence(
        folder=sequence.folder,
        names=tuple(sequence.names[i] for i in chosen),
        cameras=tuple(sequence.cameras[i] for i in chosen),
        cam_from_world=tuple(sequence.cam_from_world[i] for i in chosen),
    )


@pytest.fixture(scope="module")
def sequences(boulder):
    """Eight neighboring frames of the rendered object, two of them queries, without a map."""
    return ObjectSequences(
        name="boulder",
        mapping=frames_of(boulder.mapping, [one for one in SPAN if one not in QUERIES]),
        query=frames_of(boulder.mapping, QUERIES),
        box=boulder.map.box,
    )


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return BenchmarkSetup(folder=tmp_path_factory.mktemp("benchmark") / "run", options=OPTIONS)


@pytest.fixture(scope="module")
def result(sequences, bench):
    return benchmark_object(sequences, bench)


def kept(bench, variant):
    return map_path(bench.folder, "boulder", "sift", variant)


def test_each_strategy_is_measured_on_each_variant_that_supports_it(result):
    images, points = ["full", "dominating", "random"], ["full", "dominating", "default", "random"]
    assert [cell.key for cell in result.measurements] == [
        *(("sift", "exhaustive", variant) for variant in images),
        *(("sift", "direct", variant) for variant in points),
    ]
    assert [len(cell.map_runs) for cell in result.measurements] == [1, 1, 5, 1, 1, 1, 5]


def test_the_result_describes_the_object(result, sequences):
    assert (result.name, result.unit, result.images) == ("boulder", "metre", sequences.mapping.folder)
    assert result.box is sequences.box
    assert [query.path for query in result.queries] == list(sequences.query.image_paths)
    assert [query.cam_from_world for query in result.queries] == list(sequences.query.cam_from_world)


def test_queries_are_localized_well_against_the_full_map(result):
    for strategy in OPTIONS.strategies:
        outcomes = result.measurement("sift", strategy, "full").outcomes
        assert (outcomes.error < 0.05).all()
        assert (outcomes.confidence > 0.5).all()


def test_errors_match_the_poses(result):
    for cell in result.measurements:
        for trial in cell.map_runs:
            for pose, error, query in zip(
                trial.outcomes.cam_from_world, trial.outcomes.error, result.queries, strict=True
            ):
                expected = corner_error(pose, query.cam_from_world, result.box) if pose else np.inf
                assert error == expected


def test_the_dominating_set_dominates_the_stored_graph(result, bench):
    (mapped,) = result.maps
    path = kept(bench, "full")
    full = read_map(path)
    labels = []

    def watch(items, label):
        labels.append(label)
        return iter(items)

    graph = load_or_compute_graph(
        full, path, graph_options(OPTIONS, parse_method("sift")), progress=watch
    ).graph
    assert labels == []  # read, not computed
    chosen = [graph.names.index(name) for name in mapped.dominating_set]
    assert dominates(graph.adjacency(), chosen)
    assert mapped.lower_bound == len(chosen) < mapped.references == len(full.images) == 6
    assert mapped.edges == graph.num_edges(0.05)
    assert mapped.points == len(full.point3D_ids)


def test_the_stored_maps_are_the_measured_ones(result, bench):
    assert {path.name for path in kept(bench, "full").parent.iterdir()} == {"full", "dominating", "default"}
    for variant in ("full", "dominating", "default"):
        (trial,) = result.measurement("sift", "direct", variant).map_runs
        made = read_map(kept(bench, variant))
        assert (trial.references, trial.points) == (len(made.images), len(made.point3D_ids))
        assert trial.map_bytes == bytes_by_part(kept(bench, variant))["total"]
    (mapped,) = result.maps
    assert list(read_map(kept(bench, "dominating")).images) == list(mapped.dominating_set)
    assert result.measurement("sift", "direct", "dominating").map_runs[0].points == mapped.dominating_points
    assert read_map(kept(bench, "default")).is_for_direct_matching


def test_random_rows_are_the_mean_over_the_five_seeds(result, bench):
    full, count = read_map(kept(bench, "full")), len(result.maps[0].dominating_set)
    prepared = prepare_queries(full, list(result.queries))
    cell = result.measurement("sift", "direct", "random")
    found = []
    for seed, trial in enumerate(cell.map_runs):
        drawn = keep_random_images(full, count, seed=seed)
        assert (trial.references, trial.points) == (count, len(drawn.point3D_ids))
        outcomes = evaluate(drawn, prepared, "direct", extraction="rounds")
        assert outcomes.error == pytest.approx(trial.outcomes.error)
        found.append(outcomes.error)
    row = rows_of(result)[-1]
    assert (row.strategy, row.variant, row.scores.queries) == ("direct", "random", 2)
    assert row.scores.add[0.1] == pytest.approx(100 * np.mean(np.array(found) < 0.1))
    assert row.points == pytest.approx(np.mean([trial.points for trial in cell.map_runs]))
    assert row.map_bytes == pytest.approx(np.mean([trial.map_bytes for trial in cell.map_runs]))


def test_features_of_whole_images_are_extracted_once_for_all_measurements(result):
    whole = [cell for cell in result.measurements if cell.key[1] not in IN_ROUNDS]
    extract = [trial.outcomes.seconds[:, 0].tolist() for cell in whole for trial in cell.map_runs]
    assert len(extract) > 1
    assert all(one == extract[0] for one in extract)
    assert all((trial.outcomes.seconds > 0).all() for cell in result.measurements for trial in cell.map_runs)


@pytest.fixture
def again(bench, result, tmp_path):
    """Measures the object with other options, starting from the stored map."""
    assert result.maps
    shutil.copytree(kept(bench, "full"), map_path(tmp_path, "boulder", "sift", "full"))

    def measure(sequences, variants=("dominating",), reduction=DominatingSetOptions()):
        options = BenchmarkOptions(strategies=("direct",), variants=variants, reduction=reduction)
        return benchmark_object(sequences, BenchmarkSetup(folder=tmp_path, options=options))

    return measure


def test_the_threshold_of_the_reduction_is_obeyed(again, sequences):
    found = again(sequences, reduction=DominatingSetOptions(threshold=1e-12))
    assert len(found.maps[0].dominating_set) == found.maps[0].references == 6
    assert found.maps[0].edges == 0


def test_an_object_with_a_model_is_measured_by_its_vertices(again, sequences, result):
    """One vertex far from the box: its distance over the diameter."""
    far = np.array([[0.0, 0.0, 3.0]])
    model = ObjectModel(vertices=far, diameter=2.0, symmetric=False)
    found = again(replace(sequences, model=model))
    outcomes = found.measurements[0].outcomes
    for pose, error, query in zip(outcomes.cam_from_world, outcomes.error, found.queries, strict=True):
        if pose is not None:
            assert error == pytest.approx(np.linalg.norm(pose * far - query.cam_from_world * far) / 2)
    before = result.measurement("sift", "direct", "dominating").outcomes
    assert [pose is None for pose in outcomes.cam_from_world] == [
        pose is None for pose in before.cam_from_world
    ]
    assert not np.array_equal(outcomes.error, before.error)


def test_random_variants_of_several_sizes_do_not_interfere(again, sequences):
    """They are stored in temporary folders, and a map reads its features on demand."""
    two, three = again(sequences, variants=("random:2", "random:3")).measurements
    assert [trial.references for trial in two.map_runs] == [2] * 5
    assert [trial.references for trial in three.map_runs] == [3] * 5
    (alone,) = again(sequences, variants=("random:2",)).measurements
    for one, other in zip(two.map_runs, alone.map_runs, strict=True):
        assert one.outcomes.error.tolist() == other.outcomes.error.tolist()


def test_maps_are_built_with_the_extractor_of_the_method(tmp_path):
    bench = BenchmarkSetup(
        folder=tmp_path, options=OPTIONS, build=BuildOptions(max_features=500, matcher="lightglue")
    )
    built = bench.build_options(parse_method("aliked+superglue"))
    assert (built.extractor, built.matcher, built.max_features) == ("aliked", "superglue", 500)
    assert bench.build_options(parse_method("aliked")).matcher == "lightglue"
    assert bench.load_options("toy").folder == tmp_path / "truth" / "toy"


def test_graphs_use_the_matcher_of_the_method():
    options = BenchmarkOptions(edges="hybrid", reduction=DominatingSetOptions(threshold=0.02))
    found = graph_options(options, parse_method("aliked+lightglue"))
    assert (found.edges, found.candidates, found.threshold, found.matcher) == (
        *("hybrid", "all"),
        *(0.02, "lightglue"),
    )
    assert graph_options(options, parse_method("sift")).matcher == "auto"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"strategies": ("direct", "guess")}, "strategy must be auto or one of .*, got 'guess'"),
        ({"strategies": ()}, "strategies must be distinct and not empty, got none"),
        (
            {"strategies": ("direct", "direct")},
            "strategies must be distinct .*, got direct, direct",
        ),
        ({"variants": ("half",)}, "variants must be among full, .*, got 'half'"),
        ({"variants": ()}, "variants must be distinct and not empty, got none"),
        ({"variants": ("random:3", "random:3")}, "variants must be distinct"),
        ({"variants": ("points",)}, "variants: points takes a number of points"),
        ({"methods": ("guess",)}, "the extractor of a method must be one of .*, got 'guess'"),
        ({"methods": ()}, "methods must be distinct and not empty, got none"),
    ],
)
def test_invalid_options_are_named_in_the_error(values, message):
    with pytest.raises(ValueError, match=message):
        BenchmarkOptions(**values)


def test_a_variant_may_occur_with_several_settings():
    options = BenchmarkOptions(variants=("random:3", "random:4", "dominating", "dominating:k=2"))
    assert [one.kind for one in options.parsed_variants] == ["random", "random", "dominating", "dominating"]
