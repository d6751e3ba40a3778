import shutil
from dataclasses import replace

import numpy as np
import pytest

from slimsfm.datasets.base import ObjectModel, ObjectSequences, PosedSequence
from slimsfm.domination import dominates
from slimsfm.evaluation.benchmark import Bench, BenchmarkOptions, benchmark_object, graph_options
from slimsfm.evaluation.methods import parse_method
from slimsfm.evaluation.protocol import evaluate, prepare
from slimsfm.evaluation.results import map_path
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
    """Eight neighbouring frames of the rendered object, two of them queries, whose map is yet to be built."""
    return ObjectSequences(
        name="boulder",
        mapping=frames_of(boulder.mapping, [one for one in SPAN if one not in QUERIES]),
        query=frames_of(boulder.mapping, QUERIES),
        box=boulder.map.box,
    )


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return Bench(folder=tmp_path_factory.mktemp("benchmark") / "run", options=OPTIONS)


@pytest.fixture(scope="module")
def result(sequences, bench):
    return benchmark_object(sequences, bench)


def kept(bench, variant):
    return map_path(bench.folder, "boulder", "sift", variant)


def test_there_is_a_line_of_every_strategy_and_every_variant_that_it_can_use(result):
    images, points = ["full", "dominating", "random"], ["full", "dominating", "default", "random"]
    assert [cell.key for cell in result.cells] == [
        *(("sift", "exhaustive", variant) for variant in images),
        *(("sift", "direct", variant) for variant in points),
    ]
    assert [len(cell.trials) for cell in result.cells] == [1, 1, 5, 1, 1, 1, 5]


def test_the_object_is_told_as_it_was_given(result, sequences):
    assert (result.name, result.unit, result.images) == ("boulder", "metre", sequences.mapping.folder)
    assert result.box is sequences.box
    assert [query.path for query in result.queries] == list(sequences.query.image_paths)
    assert [query.cam_from_world for query in result.queries] == list(sequences.query.cam_from_world)


def test_queries_are_localized_well_against_the_full_map(result):
    for strategy in OPTIONS.strategies:
        outcomes = result.cell("sift", strategy, "full").outcomes
        assert (outcomes.error < 0.05).all()
        assert (outcomes.confidence > 0.5).all()


def test_errors_are_those_of_the_poses(result):
    for cell in result.cells:
        for trial in cell.trials:
            for pose, error, query in zip(
                trial.outcomes.cam_from_world, trial.outcomes.error, result.queries, strict=True
            ):
                expected = corner_error(pose, query.cam_from_world, result.box) if pose else np.inf
                assert error == expected


def test_the_dominating_set_dominates_the_graph_that_is_kept(result, bench):
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


def test_maps_are_kept_and_are_those_that_were_measured(result, bench):
    assert {path.name for path in kept(bench, "full").parent.iterdir()} == {"full", "dominating", "default"}
    for variant in ("full", "dominating", "default"):
        (trial,) = result.cell("sift", "direct", variant).trials
        made = read_map(kept(bench, variant))
        assert (trial.references, trial.points) == (len(made.images), len(made.point3D_ids))
        assert trial.map_bytes == bytes_by_part(kept(bench, variant))["total"]
    (mapped,) = result.maps
    assert list(read_map(kept(bench, "dominating")).images) == list(mapped.dominating_set)
    assert result.cell("sift", "direct", "dominating").trials[0].points == mapped.dominating_points
    assert read_map(kept(bench, "default")).is_for_direct_matching


def test_random_rows_are_the_mean_over_the_five_seeds(result, bench):
    full, count = read_map(kept(bench, "full")), len(result.maps[0].dominating_set)
    prepared = prepare(full, list(result.queries))
    cell = result.cell("sift", "direct", "random")
    found = []
    for seed, trial in enumerate(cell.trials):
        drawn = keep_random_images(full, count, seed=seed)
        assert (trial.references, trial.points) == (count, len(drawn.point3D_ids))
        outcomes = evaluate(drawn, prepared, "direct")
        assert outcomes.error == pytest.approx(trial.outcomes.error)
        found.append(outcomes.error)
    row = rows_of(result)[-1]
    assert (row.strategy, row.variant, row.scores.queries) == ("direct", "random", 2)
    assert row.scores.add[0.1] == pytest.approx(100 * np.mean(np.array(found) < 0.1))
    assert row.points == pytest.approx(np.mean([trial.points for trial in cell.trials]))
    assert row.map_bytes == pytest.approx(np.mean([trial.map_bytes for trial in cell.trials]))


def test_features_of_a_query_are_found_once_for_all_lines(result):
    extract = [trial.outcomes.seconds[:, 0].tolist() for cell in result.cells for trial in cell.trials]
    assert all(one == extract[0] for one in extract)
    assert min(extract[0]) > 0
    assert all((trial.outcomes.seconds > 0).all() for cell in result.cells for trial in cell.trials)


@pytest.fixture
def again(bench, result, tmp_path):
    """Measures the object with other options, from the map that is there already."""
    assert result.maps
    shutil.copytree(kept(bench, "full"), map_path(tmp_path, "boulder", "sift", "full"))

    def measure(sequences, variants=("dominating",), reduction=DominatingSetOptions()):
        options = BenchmarkOptions(strategies=("direct",), variants=variants, reduction=reduction)
        return benchmark_object(sequences, Bench(folder=tmp_path, options=options))

    return measure


def test_the_threshold_of_the_reduction_is_obeyed(again, sequences):
    found = again(sequences, reduction=DominatingSetOptions(threshold=1e-12))
    assert len(found.maps[0].dominating_set) == found.maps[0].references == 6
    assert found.maps[0].edges == 0


def test_an_object_with_a_model_is_measured_by_its_vertices(again, sequences, result):
    """One vertex, where the box is far from it: its distance over the diameter."""
    far = np.array([[0.0, 0.0, 3.0]])
    model = ObjectModel(vertices=far, diameter=2.0, symmetric=False)
    found = again(replace(sequences, model=model))
    outcomes = found.cells[0].outcomes
    for pose, error, query in zip(outcomes.cam_from_world, outcomes.error, found.queries, strict=True):
        if pose is not None:
            assert error == pytest.approx(np.linalg.norm(pose * far - query.cam_from_world * far) / 2)
    before = result.cell("sift", "direct", "dominating").outcomes
    assert [pose is None for pose in outcomes.cam_from_world] == [
        pose is None for pose in before.cam_from_world
    ]
    assert not np.array_equal(outcomes.error, before.error)


def test_random_variants_of_several_sizes_do_not_get_into_each_others_way(again, sequences):
    """They lie at temporary places, and a map reads its features when it needs them."""
    two, three = again(sequences, variants=("random:2", "random:3")).cells
    assert [trial.references for trial in two.trials] == [2] * 5
    assert [trial.references for trial in three.trials] == [3] * 5
    (alone,) = again(sequences, variants=("random:2",)).cells
    for one, other in zip(two.trials, alone.trials, strict=True):
        assert one.outcomes.error.tolist() == other.outcomes.error.tolist()


def test_maps_are_built_with_the_features_of_the_method(tmp_path):
    bench = Bench(folder=tmp_path, options=OPTIONS, build=BuildOptions(max_features=500, matcher="lightglue"))
    built = bench.build_with(parse_method("aliked+superglue"))
    assert (built.extractor, built.matcher, built.max_features) == ("aliked", "superglue", 500)
    assert bench.build_with(parse_method("aliked")).matcher == "lightglue"
    assert bench.dataset_making("toy").folder == tmp_path / "truth" / "toy"


def test_graphs_are_matched_as_the_method_says():
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
        ({"strategies": ()}, "strategies must be different ones, got none"),
        ({"strategies": ("direct", "direct")}, "strategies must be different ones, got direct, direct"),
        ({"variants": ("half",)}, "variants must be among full, .*, got 'half'"),
        ({"variants": ()}, "variants must be different ones, got none"),
        ({"variants": ("random:3", "random:3")}, "variants must be different ones"),
        ({"variants": ("points",)}, "variants: points takes a number of points"),
        ({"methods": ("guess",)}, "methods must be made of .*, got 'guess'"),
        ({"methods": ()}, "methods must be different ones, got none"),
    ],
)
def test_bad_options_are_named(values, message):
    with pytest.raises(ValueError, match=message):
        BenchmarkOptions(**values)


def test_a_variant_may_be_compared_in_several_settings():
    options = BenchmarkOptions(variants=("random:3", "random:4", "dominating", "dominating:k=2"))
    assert [one.kind for one in options.parsed_variants] == ["random", "random", "dominating", "dominating"]
