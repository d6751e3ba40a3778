from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from networks.seeded import fill  # noqa: E402
from slimsfm.methods.onepose.network import GraphAttentionMatcher, mutual_matches  # noqa: E402
from slimsfm.networks.loading import matcher_state  # noqa: E402

GOLDEN = np.load(Path(__file__).parent / "golden" / "onepose.npz")
POINTS, LEAVES, KEYPOINTS = 90, 8, 70


def unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def inputs() -> list:
    """Descriptors of keypoints, points and observations, as the golden numbers were made with."""
    rng = np.random.default_rng(1)
    points = unit(rng.standard_normal((POINTS, 256)))
    leaves = unit(points[:, None] + 0.05 * rng.standard_normal((POINTS, LEAVES, 256)))
    means = leaves.mean(axis=1)
    for row in range(0, POINTS, 5):
        count = row // 5 % 7 + 1
        means[row], leaves[row, count:] = leaves[row, :count].mean(axis=0), 1
    order = rng.permutation(POINTS)[:KEYPOINTS]
    query = unit(points[order] + 0.05 * rng.standard_normal((KEYPOINTS, 256)))
    query[50:] = unit(rng.standard_normal((KEYPOINTS - 50, 256)))
    arrays = query, means, leaves.reshape(-1, 256)
    return [torch.from_numpy(array.astype(np.float32)).T[None] for array in arrays]


def filled() -> GraphAttentionMatcher:
    made = GraphAttentionMatcher().eval().requires_grad_(False)
    fill(made, 0)
    return made


@pytest.fixture(scope="module")
def network() -> GraphAttentionMatcher:
    made = filled()
    for key, value in made.state_dict().items():
        if ".mlp.3." in key:
            value *= 0.05
    made.final_proj.weight *= 8
    return made


@pytest.fixture(scope="module")
def confidence(network, inputs):
    return network(*inputs)


def permuted(inputs: list, keypoints, points, leaves) -> list:
    """The inputs in another order."""
    query, means, observations = inputs
    observations = observations.unflatten(2, (POINTS, LEAVES))[:, :, points][:, :, :, leaves]
    return [query[:, :, keypoints], means[:, :, points], observations.flatten(2)]


def test_state_dict_is_that_of_the_published_weights(network):
    state = sorted(network.state_dict().items())
    assert [f"{key} {' '.join(map(str, value.shape))}" for key, value in state] == GOLDEN["keys"].tolist()


def test_checkpoint_of_the_training_framework_becomes_the_state_dict(network):
    state = network.state_dict()
    other = {"extractor.conv1a.weight": torch.zeros(1)}
    checkpoint = {"epoch": 3, "state_dict": {**other, **{f"matcher.{key}": state[key] for key in state}}}
    assert matcher_state(checkpoint).keys() == state.keys()


def test_confidences_and_matches_are_those_of_the_authors(confidence):
    np.testing.assert_allclose(confidence[0], GOLDEN["confidence"], rtol=0, atol=1e-4)
    found = mutual_matches(confidence[0])
    np.testing.assert_array_equal(found.pairs, GOLDEN["pairs"])
    np.testing.assert_allclose(found.scores, GOLDEN["scores"], rtol=0, atol=1e-4)


def test_strong_attention_is_that_of_the_authors(inputs):
    np.testing.assert_allclose(filled()(*inputs)[0], GOLDEN["flat_confidence"], rtol=0, atol=1e-4)


def test_order_of_keypoints_points_and_observations_is_of_no_account(network, inputs, confidence):
    rng = np.random.default_rng(0)
    keypoints, points, leaves = (torch.from_numpy(rng.permutation(n)) for n in (KEYPOINTS, POINTS, LEAVES))
    other = network(*permuted(inputs, keypoints, points, leaves))
    np.testing.assert_allclose(other, confidence[:, keypoints][:, :, points], atol=1e-5)


def test_queries_of_a_batch_are_matched_alone(network, inputs, confidence):
    shuffled = permuted(inputs, torch.arange(KEYPOINTS), torch.arange(POINTS).flip(0), torch.arange(LEAVES))
    both = network(*(torch.cat(two) for two in zip(inputs, shuffled, strict=True)))
    np.testing.assert_allclose(both[0], confidence[0], atol=1e-5)
    np.testing.assert_allclose(both[1], confidence[0].flip(1), atol=1e-5)


def test_half_precision_around_it_changes_nothing(network, inputs, confidence):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        again = network(*inputs)
    assert again.dtype == torch.float32
    np.testing.assert_array_equal(again, confidence)


def test_matches_are_mutual_and_sure_enough():
    confidence = torch.from_numpy(np.random.default_rng(0).random((30, 40), np.float32))
    found = mutual_matches(confidence, threshold=0.95)
    wanted = [
        (row, column)
        for row in range(30)
        for column in range(40)
        if confidence[row, column] == max(confidence[row].max(), confidence[:, column].max(), 0.95)
    ]
    assert [tuple(pair) for pair in found.pairs.tolist()] == wanted
    assert len(wanted) > 5
    assert found.scores.tolist() == [float(confidence[pair]) for pair in wanted]
