"""The contracts of learned extractors and matchers, with seeded weights if no trained ones are available."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest
from scipy.spatial import KDTree

torch = pytest.importorskip("torch")
pytest.importorskip("kornia")
pytest.importorskip("transformers")

from transformers.models.superglue.modeling_superglue import log_optimal_transport  # noqa: E402

from networks.seeded_xfeat import accept_seeded_xfeat, write_seeded_xfeat  # noqa: E402
from slimsfm.errors import InputError  # noqa: E402
from slimsfm.features import (  # noqa: E402
    Extractor,
    Features,
    Matcher,
    load_extractor,
    load_matcher,
    match_many,
    match_nearest,
    unit_rows,
)
from slimsfm.features.registry import descriptor_metric_of  # noqa: E402
from slimsfm.methods.lightglue import lightglue_state  # noqa: E402
from slimsfm.methods.superglue import SuperGlue, _transport, superglue_state  # noqa: E402
from slimsfm.methods.superpoint import superpoint_state  # noqa: E402
from slimsfm.weights import FOLDER  # noqa: E402

SHARED = Path(__file__).parents[3] / "shared" / "weights"
RANDOM = ["disk", "superpoint", "xfeat"]
STEP = 32  # shift of pictures in pixels, a multiple of every network's grid


@pytest.fixture(scope="session")
def random_weights(tmp_path_factory):
    writer = run_path(str(Path(__file__).parents[2] / "benchmarks" / "random_weights.py"))
    return write_seeded_xfeat(writer["write_random_weights"](tmp_path_factory.mktemp("weights")))


@pytest.fixture
def weights(request, monkeypatch, random_weights):
    """The weights folder for the extractor under test."""
    accept_seeded_xfeat(monkeypatch)
    folder = SHARED if request.getfixturevalue("name") == "aliked" else random_weights
    if not folder.is_dir():
        pytest.skip("needs the trained ALIKED weights in ../shared/weights, which are not here")
    monkeypatch.setenv(FOLDER, str(folder))


@pytest.fixture
def untrained(monkeypatch, random_weights):
    accept_seeded_xfeat(monkeypatch)
    monkeypatch.setenv(FOLDER, str(random_weights))


@pytest.mark.usefixtures("weights")
@pytest.mark.parametrize("name", ["aliked", *RANDOM])
class TestExtractors:
    def test_the_contract_is_kept(self, name, textured):
        extractor = load_extractor(name, {"max_features": 300})
        assert isinstance(extractor, Extractor)
        assert extractor.name == name
        assert load_extractor(name, json.loads(json.dumps(extractor.options))) == extractor
        one, two = (extractor.extract(textured) for _ in range(2))
        for array in ("keypoints", "descriptors", "scores"):
            assert np.array_equal(getattr(one, array), getattr(two, array))
        assert one.image_size == (320, 240)
        assert 50 < len(one) == len(one.descriptors) == len(one.scores) <= 300
        assert np.all(np.diff(one.scores) <= 0)
        assert ((one.keypoints > 0) & (one.keypoints < (320, 240))).all()
        assert one.descriptors.dtype == np.float16
        assert np.linalg.norm(one.descriptors.astype(np.float32), axis=1) == pytest.approx(1, abs=2e-3)
        assert len(extractor.extract(textured, np.zeros((240, 320), np.uint8))) == 0

    def test_a_mask_leaves_keypoints_out_and_adds_none(self, name, textured):
        extractor = load_extractor(name, {"max_features": 4000})
        mask = np.zeros((240, 320), np.uint8)
        mask[:, 160:] = 255
        whole, half = extractor.extract(textured), extractor.extract(textured, mask)
        assert np.array_equal(half.keypoints, whole.keypoints[whole.keypoints[:, 0] >= 160])

    def test_shifting_the_picture_shifts_keypoints(self, name, textured):
        """Exactly for SuperPoint; with ALIKED and DISK the border has a weak influence everywhere."""
        extractor = load_extractor(name, {"max_features": 4000})
        picture = np.zeros((256 + STEP, 320 + STEP, 3), np.uint8)  # XFeat shrinks to multiples of 32
        here, there = picture.copy(), picture.copy()
        here[:240, :320], there[STEP : STEP + 240, STEP:] = textured, textured
        one, other = (inner(extractor.extract(p), shift) for p, shift in ((here, 0), (there, STEP)))
        distances, rows = KDTree(other).query(one)
        near = distances < 1
        assert near.mean() > 0.7
        offsets = (other[rows] - one)[near]
        assert np.abs(offsets.mean(axis=0)).max() < 0.05
        if name == "superpoint":
            assert near.all()
            assert np.abs(offsets).max() < 1e-3

    def test_keypoints_are_scaled_back_about_the_corner_of_the_image(self, name, textured):
        """A picture of twice the size, shrunk to the first, has keypoints at twice the coordinates."""
        extractor = load_extractor(name, {"max_features": 300, "max_image_size": 320})
        large = textured.repeat(2, axis=0).repeat(2, axis=1)
        one, two = extractor.extract(textured), extractor.extract(large)
        assert two.image_size == (640, 480)
        assert np.allclose(two.keypoints, 2 * one.keypoints, atol=1e-3)

    def test_bad_options_are_named(self, name):
        with pytest.raises(InputError, match=f"extractor '{name}': max_features must be at least 1, got 0"):
            load_extractor(name, {"max_features": 0})


def inner(features: Features, shift: int) -> np.ndarray:
    """Keypoints away from the border of the picture, shifted back."""
    pixels = features.keypoints - np.float32(shift)
    return pixels[((pixels > 90) & (pixels < (230, 150))).all(axis=1)]


def described(rng, count, dimensions, size=(640, 480)):
    return Features(
        keypoints=rng.uniform((1, 1), np.array(size) - 1, (count, 2)).astype(np.float32),
        descriptors=unit_rows(rng.normal(size=(count, dimensions))).astype(np.float16),
        scores=rng.uniform(0.1, 1, count).astype(np.float32),
        image_size=size,
        frames=rng.uniform(1, 3, (count, 2)).astype(np.float32),
    )


MATCHERS = [
    ("superglue", "superpoint", 256),
    ("lightglue", "superpoint", 256),
    ("lightglue", "aliked", 128),
    ("lightglue", "disk", 128),
    ("lightglue", "sift", 128),
    ("lighterglue", "xfeat", 64),
    ("nearest", "aliked", 128),
    ("nearest", "xfeat", 64),
]


@pytest.mark.usefixtures("untrained")
@pytest.mark.parametrize(
    ("method", "features", "dimensions"), MATCHERS, ids=["-".join(m[:2]) for m in MATCHERS]
)
def test_every_matcher_keeps_the_contract(method, features, dimensions, monkeypatch):
    rng = np.random.default_rng(0)
    one, other = described(rng, 60, dimensions), described(rng, 45, dimensions, (320, 240))
    matcher = load_matcher(method, features)
    assert isinstance(matcher, Matcher)
    pairs = matcher.match(one, other)
    assert pairs.dtype == np.int64
    assert pairs.shape[1] == 2
    assert np.array_equal(pairs, matcher.match(one, other))
    assert np.all(np.diff(pairs[:, 0]) > 0)
    assert len(set(pairs[:, 1])) == len(pairs)
    empty = one[np.zeros(0, np.int64)]
    assert matcher.match(empty, other).shape == matcher.match(other, empty).shape == (0, 2)
    many = [(one, other), (empty, other), (other, one), (one, one[np.arange(7)]), (other, empty)]
    for memory in (0, 10**9):  # keypoint pairs: on a CPU, and on a GPU, where they come in one batch
        monkeypatch.setattr("slimsfm.networks.batches.keypoint_pairs_of", lambda _, memory=memory: memory)
        found = match_many(matcher, many)
        assert len(found) == len(many)
        assert all(map(np.array_equal, found, [matcher.match(*pair) for pair in many]))
    assert match_many(matcher, []) == []


@pytest.fixture
def sharp():
    """SuperGlue with seeded weights that compares little but descriptors, and so matches similar ones."""
    matcher = SuperGlue("superpoint")
    with torch.no_grad():
        matcher.network.final_projection.final_proj.weight.copy_(16 * torch.eye(256))
    return matcher


@pytest.mark.usefixtures("untrained")
def test_superglue_scores_and_matches_in_a_batch_are_those_of_each_pair(sharp, monkeypatch):
    rng = np.random.default_rng(2)
    one = described(rng, 60, 256)
    pairs = []
    for count, others, size in (
        (40, 0, (640, 480)),
        (10, 70, (320, 240)),
        (1, 0, (640, 480)),
        (0, 30, (480, 640)),
    ):
        new = described(rng, count + others, 256, size)
        same = one.descriptors[rng.permutation(60)[:count]].astype(np.float32)
        noisy = unit_rows(same + 0.02 * rng.normal(size=same.shape))
        pairs.append((one, replace(new, descriptors=np.concatenate([noisy, new.descriptors[count:]]))))
    with torch.inference_mode():
        together = sharp.scores(pairs, torch.device("cpu"))
        for row, pair in enumerate(pairs):
            alone = sharp.scores([pair], torch.device("cpu"))[0]
            rows, columns = ([*range(len(features)), -1] for features in pair)
            assert torch.allclose(together[row][rows][:, columns], alone, atol=1e-4)
            assert (together[row][:-1, len(pair[1]) : -1] == -torch.inf).all()
    monkeypatch.setattr("slimsfm.networks.batches.keypoint_pairs_of", lambda _: 10**9)
    found = sharp.match_many(pairs)
    assert all(map(np.array_equal, found, [sharp.match(*pair) for pair in pairs]))
    assert [len(matches) > count / 2 for matches, count in zip(found, (40, 10, 1), strict=False)] == [
        True
    ] * 3


def test_superglue_transports_as_the_library_does():
    generator = torch.Generator().manual_seed(0)
    products, bin_score = 3 * torch.randn(2, 30, 20, generator=generator), torch.tensor(1.5)
    everything = torch.ones(2, 30, dtype=torch.bool), torch.ones(2, 20, dtype=torch.bool)
    expected = log_optimal_transport(products, bin_score, 100)
    assert torch.allclose(_transport(products, bin_score, *everything), expected, atol=1e-5)
    some = everything[0], torch.arange(20).expand(2, -1) < 12
    found = _transport(products, bin_score, *some)
    expected = log_optimal_transport(products[:, :, :12], bin_score, 100)
    assert torch.allclose(found[:, :, [*range(12), -1]], expected, atol=1e-5)
    assert (found[:, :, 12:-1] == -torch.inf).all()


def test_nearest_uses_the_metric_of_the_features():
    rng = np.random.default_rng(1)
    one = described(rng, 50, 128)
    noisy = unit_rows(one.descriptors.astype(np.float32) + 0.03 * rng.normal(size=(50, 128)))
    other = Features(keypoints=one.keypoints, descriptors=noisy, scores=one.scores, image_size=one.image_size)
    pairs = load_matcher("nearest", "aliked").match(one, other)
    assert len(pairs) > 40
    expected = match_nearest(unit_rows(one.descriptors), unit_rows(noisy), descriptor_metric_of("aliked"))
    assert np.array_equal(pairs, expected)


@pytest.mark.parametrize(
    ("method", "features", "known"),
    [
        ("superglue", "aliked", "superpoint"),
        ("lightglue", "orb", "aliked, disk, sift, superpoint"),
        ("lighterglue", "aliked", "xfeat"),
    ],
)
def test_features_that_a_matcher_does_not_know_are_named(method, features, known):
    with pytest.raises(
        InputError, match=f"matcher '{method}': features must be .*{known}.* got '{features}'"
    ):
        load_matcher(method, features)


@pytest.mark.usefixtures("untrained")
def test_sift_features_olderer_maps_lack_what_lightglue_needs():
    older = replace(described(np.random.default_rng(0), 20, 128), frames=None)
    with pytest.raises(InputError, match="scales and orientations of SIFT features"):
        load_matcher("lightglue", "sift").match(older, older)


def test_an_unknown_matcher_is_named():
    with pytest.raises(
        InputError, match="matcher 'guess' is unknown; known are lighterglue, lightglue, nearest, superglue"
    ):
        load_matcher("guess", "sift")


def test_the_authors_names_of_values_are_those_of_the_library(random_weights):
    """Each state dict under the authors' names gives the library's, every value of it once."""
    ours = torch.load(random_weights / "superglue_outdoor.pth", weights_only=True)
    own = {key: value for key, value in ours.items() if not key.startswith("keypoint_detector.")}
    assert superglue_state(superglue_of_the_authors()).keys() == own.keys()
    shapes = {key: value.shape for key, value in superglue_state(superglue_of_the_authors()).items()}
    assert shapes == {key: value.shape for key, value in own.items()}
    library = torch.load(random_weights / "superpoint_v1.pth", weights_only=True)
    assert superpoint_state(library).keys() == library.keys()


def test_values_of_published_files_that_lightglue_does_not_use_are_left_out():
    """The file of LighterGlue holds XFeat, and that for DISK a value `r` per layer."""
    names = {
        "matcher.transformers.0.self_attn.Wqkv.bias": "transformers.0.self_attn.Wqkv.bias",
        "cross_attn.8.to_v.bias": "transformers.8.cross_attn.to_v.bias",
        "log_assignment.0.matchability.bias": "log_assignment.0.matchability.bias",
        "log_assignment.0.r": None,
        "extractor.model.net.skip1.1.bias": None,
    }
    state = lightglue_state({name: torch.zeros(1) for name in names})
    assert list(state) == [name for name in names.values() if name]


def superglue_of_the_authors() -> dict:
    """A state dict of SuperGlue as its authors name and shape it."""
    state = {"bin_score": torch.zeros(()), **convolution("final_proj", 256, 256)}
    state |= perceptron("kenc.encoder", [3, 32, 64, 128, 256, 256])
    for layer in range(18):
        for name in ("proj.0", "proj.1", "proj.2", "merge"):
            state |= convolution(f"gnn.layers.{layer}.attn.{name}", 256, 256)
        state |= perceptron(f"gnn.layers.{layer}.mlp", [512, 512, 256])
    return state


def convolution(name: str, inputs: int, outputs: int) -> dict:
    return {f"{name}.weight": torch.zeros(outputs, inputs, 1), f"{name}.bias": torch.zeros(outputs)}


def perceptron(name: str, widths: list[int]) -> dict:
    state = {}
    for layer, (inputs, outputs) in enumerate(pairwise(widths)):
        state |= convolution(f"{name}.{3 * layer}", inputs, outputs)
        if layer < len(widths) - 2:
            for value in ("weight", "bias", "running_mean", "running_var"):
                state[f"{name}.{3 * layer + 1}.{value}"] = torch.zeros(outputs)
            state[f"{name}.{3 * layer + 1}.num_batches_tracked"] = torch.zeros((), dtype=torch.int64)
    return state
