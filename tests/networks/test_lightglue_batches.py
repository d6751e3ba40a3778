"""Batches of LightGlue against kornia's network, which matches one pair of images after the other.

The seeded network reads from a descriptor's first value whether the keypoint is certain, and from its second
whether it has a match, so that pairs stop at different layers and drop different keypoints.
"""

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("kornia")

from kornia.feature import LightGlue  # noqa: E402
from torch import Tensor  # noqa: E402

from networks.seeded import fill  # noqa: E402
from slimsfm.errors import InputError  # noqa: E402
from slimsfm.features import load_extractor  # noqa: E402
from slimsfm.methods.lightglue import lightglue_state, network_for  # noqa: E402
from slimsfm.networks.lightglue import given_to, match_batch, with_fused_attention  # noqa: E402
from slimsfm.networks.loading import load_state  # noqa: E402
from slimsfm.photos import read_image  # noqa: E402
from slimsfm.weights import FOLDER  # noqa: E402

SHARED = Path(__file__).parents[3] / "shared"
SIZE = (640.0, 480.0)

CONFIGURATIONS = {
    "both": {},
    "no pruning": {"width_confidence": -1},
    "no early stop": {"depth_confidence": -1},
    "neither": {"width_confidence": -1, "depth_confidence": -1},
    "small": {"descriptor_dim": 96, "n_layers": 6, "num_heads": 1, "depth_confidence": -1},
    "scales": {"add_scale_ori": True, "scale_coef": 1 / 6},
}


def seeded(**conf) -> LightGlue:
    """A network that matches similar descriptors."""
    network = LightGlue(features=None, weights=None, input_dim=128, **conf).eval().requires_grad_(False)
    thresholds = network.confidence_thresholds.clone()
    fill(network, 0)
    network.confidence_thresholds.copy_(thresholds)
    project = network.get_parameter("input_proj.weight").mul_(4)
    for layer in network.transformers:
        for block in (layer.self_attn, layer.cross_attn):
            block.ffn[3].weight.mul_(0.1)
    towards = [2 * column / column.square().sum() for column in project.T[:2]]
    for head in network.log_assignment:
        head.final_proj.weight.mul_(2)
        head.matchability.weight.copy_(8 * towards[1])
        head.matchability.bias.zero_()
    for depth, head in enumerate(network.token_confidence):
        head.token[0].weight.copy_(8 * towards[0])
        head.token[0].bias.fill_(1.5 * depth - 6)
    return network


def image(rng, count: int, certain: float, like: Tensor | None = None) -> dict[str, Tensor]:
    """An image with some keypoints of another one, whose descriptors are `like`, first."""
    descriptors = rng.normal(size=(count, 128))
    same = min(count // 2, 0 if like is None else len(like))
    if like is not None:
        descriptors[:same] = 10 * like.numpy()[rng.permutation(len(like))[:same]] + 0.2 * rng.normal(
            size=(same, 128)
        )
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    descriptors[:, 0] = rng.uniform(certain - 0.5, certain + 0.5, count)
    descriptors[same:, 1] = np.where(rng.uniform(size=count - same) < 0.5, -1, 0.5)
    return {
        "keypoints": torch.from_numpy(rng.uniform((0, 0), SIZE, (count, 2)).astype(np.float32)),
        "descriptors": torch.from_numpy(descriptors.astype(np.float32)),
        "image_size": torch.tensor(SIZE),
        "scales": torch.from_numpy(rng.uniform(1, 3, count).astype(np.float32)),
        "oris": torch.from_numpy(rng.uniform(-3, 3, count).astype(np.float32)),
    }


@pytest.fixture
def pairs():
    rng = np.random.default_rng(0)
    one = image(rng, 60, 0.8)
    sizes = ((40, 1.5), (120, 0.6), (1, 0.3), (90, 0.0), (60, 1.2), (7, 0.5), (60, -0.4))
    return [(one, image(rng, count, certain, one["descriptors"])) for count, certain in sizes]


def by_kornia(network: LightGlue, pairs) -> list[dict]:
    with torch.inference_mode():
        return [
            network(
                {f"image{i}": {key: value[None] for key, value in one.items()} for i, one in enumerate(pair)}
            )
            for pair in pairs
        ]


def batch(network: LightGlue, pairs) -> list[np.ndarray]:
    with torch.inference_mode():
        return match_batch(network, [(given_to(network, a), given_to(network, b)) for a, b in pairs])


def equal(found: list[np.ndarray], expected: list[np.ndarray]) -> bool:
    return len(found) == len(expected) and all(map(np.array_equal, found, expected))


@pytest.mark.parametrize("conf", CONFIGURATIONS.values(), ids=CONFIGURATIONS.keys())
def test_a_batch_has_the_matches_of_each_pair_alone(pairs, conf):
    expected = by_kornia(seeded(**conf), pairs)
    matches = [one["matches"][0].numpy() for one in expected]
    network = with_fused_attention(seeded(**conf))
    assert equal(batch(network, pairs), matches)
    assert equal([batch(network, [pair])[0] for pair in pairs], matches)
    assert equal(batch(network, pairs[::-1])[::-1], matches)
    assert min(map(len, matches)) == 0
    assert max(map(len, matches)) > 10


def test_the_pairs_of_the_tests_stop_at_several_layers_and_drop_some_of_their_keypoints(pairs):
    found = by_kornia(seeded(), pairs)
    assert len({one["stop"] for one in found}) >= 4
    assert sum(len(one["prune1"].unique()) > 1 for one in found) >= 4
    lost = by_kornia(seeded(depth_confidence=-1), pairs)[2]
    assert (lost["prune1"] == 1).all()  # its only keypoint is dropped after the first layer


def test_padding_and_other_pairs_change_nothing_but_rounding(pairs):
    """The products from which matches are chosen, without any keypoint dropped."""
    network = with_fused_attention(seeded(width_confidence=-1, depth_confidence=-1, filter_threshold=0.0))
    assert equal(batch(network, pairs), [batch(network, [pair])[0] for pair in pairs])


def test_half_precision_finds_almost_the_same_matches(pairs):
    """As on a GPU, where kornia's network would run in single precision within its own context."""
    expected = [one["matches"][0].numpy() for one in by_kornia(seeded(), pairs)]
    with torch.autocast("cpu", dtype=torch.float16):
        found = batch(with_fused_attention(seeded()), pairs)
    common = sum(len(set(map(tuple, a)) & set(map(tuple, b))) for a, b in zip(found, expected, strict=True))
    assert common > 0.9 * sum(map(len, expected))
    assert common > 0.9 * sum(map(len, found))


def test_keypoints_outside_of_the_image_are_refused():
    outside = image(np.random.default_rng(0), 5, 0.5)
    outside["keypoints"][3, 0] = 641
    with pytest.raises(InputError, match="keypoints outside of their image"):
        given_to(seeded(), outside)


@pytest.fixture
def photographed(monkeypatch):
    """Features of photos of one object, different numbers of them, and the network with trained weights."""
    weights, photos = SHARED / "weights", sorted((SHARED / "data" / "plush").rglob("*.jpg"))
    if not (weights / "aliked_lightglue.pth").is_file() or not photos:
        pytest.skip("needs trained weights and photos in ../shared, which are not here")
    monkeypatch.setenv(FOLDER, str(weights))
    extractor = load_extractor("aliked", {"max_features": 300, "max_image_size": 480})
    counts = (300, 120, 250, 30, 300, 1)
    found = [extractor.extract(read_image(path)) for path in photos[:24:4]]
    features = [one[np.arange(min(count, len(one)))] for one, count in zip(found, counts, strict=True)]
    network = network_for("aliked").eval().requires_grad_(False)
    load_state(network, weights / "aliked_lightglue.pth", lightglue_state, {"confidence_thresholds"})
    return network, [
        {
            "keypoints": torch.from_numpy(one.keypoints - np.float32(0.5)),
            "descriptors": torch.from_numpy(one.descriptors.astype(np.float32)),
            "image_size": torch.tensor(one.image_size, dtype=torch.float32),
        }
        for one in features
    ]


def test_trained_a_batch_has_the_matches_of_each_pair_alone(photographed):
    network, (query, *references) = photographed
    pairs = [(query, reference) for reference in references]
    expected = [one["matches"][0].numpy() for one in by_kornia(network, pairs)]
    assert equal(batch(with_fused_attention(network), pairs), expected)
    assert max(map(len, expected)) > 30
