from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from networks.seeded import fill  # noqa: E402
from slimsfm.methods.onepose_plus.network import CoarseToFine, OnePosePlusMatcher  # noqa: E402
from slimsfm.networks.loading import matcher_state  # noqa: E402

GOLDEN = np.load(Path(__file__).parent / "golden" / "onepose_plus.npz")


@pytest.fixture(scope="module")
def network() -> OnePosePlusMatcher:
    made = OnePosePlusMatcher(threshold=1e-3).eval().requires_grad_(False)
    fill(made, 0)
    return made


@pytest.fixture(scope="module")
def inputs() -> list:
    rng = np.random.default_rng(1)
    image = rng.random((1, 1, 96, 128), np.float32)
    points3D = rng.standard_normal((1, 120, 3)) * (0.1, 0.2, 0.05) + (3, 2, 1)
    fine = 3 * rng.standard_normal((1, 128, 120))
    arrays = image, points3D, GOLDEN["coarse_descriptors"], fine
    return [torch.from_numpy(array.astype(np.float32)) for array in arrays]


@pytest.fixture(scope="module")
def found(network, inputs) -> CoarseToFine:
    return network(*inputs)


def test_state_dict_is_that_of_the_published_weights(network):
    state = sorted(network.state_dict().items())
    assert [f"{key} {' '.join(map(str, value.shape))}" for key, value in state] == GOLDEN["keys"].tolist()


def test_checkpoint_of_the_training_framework_becomes_the_state_dict(network):
    state = network.state_dict()
    checkpoint = {"epoch": 3, "state_dict": {f"matcher.{key}": value for key, value in state.items()}}
    assert matcher_state(checkpoint).keys() == state.keys()


def test_confidences_matches_and_places_are_those_of_the_authors(found):
    np.testing.assert_allclose(found.confidence[0], GOLDEN["confidence"], rtol=0, atol=1e-4)
    np.testing.assert_array_equal(found.points, GOLDEN["points"])
    np.testing.assert_array_equal(found.cells, GOLDEN["cells"])
    np.testing.assert_allclose(found.points2D, GOLDEN["points2D"], rtol=0, atol=1e-4)
    np.testing.assert_allclose(found.scores, GOLDEN["scores"], rtol=0, atol=1e-4)


def test_frame_and_unit_of_the_points_are_of_no_account(network, inputs, found):
    image, points3D, *descriptors = inputs
    moved = network(image, 7 * points3D - 20, *descriptors)
    np.testing.assert_allclose(moved.confidence, found.confidence, atol=1e-3)


def test_order_of_the_points_is_of_no_account(network, inputs, found):
    order = torch.randperm(120, generator=torch.Generator().manual_seed(0))
    image, points3D, *descriptors = inputs
    shuffled = network(image, points3D[:, order], *(one[:, :, order] for one in descriptors))
    np.testing.assert_allclose(shuffled.confidence, found.confidence[:, order], atol=1e-4)
    back = torch.argsort(order[shuffled.points])
    np.testing.assert_array_equal(order[shuffled.points][back], found.points)
    np.testing.assert_allclose(shuffled.points2D[back], found.points2D, atol=1e-3)


def test_images_of_a_batch_are_matched_alone(network, inputs, found):
    dark, far = 0.2 * inputs[0], 3 * inputs[1]
    both = network(*(torch.cat(two) for two in zip(inputs, [dark, far, *inputs[2:]], strict=True)))
    first = both.batches == 0
    assert 0 < int(first.sum()) < len(both.batches)
    np.testing.assert_array_equal(both.points[first], found.points)
    np.testing.assert_allclose(both.points2D[first], found.points2D, atol=1e-3)


def test_an_image_may_show_no_point(network, inputs):
    nothing = OnePosePlusMatcher(threshold=0.999).eval().requires_grad_(False)
    nothing.load_state_dict(network.state_dict())
    found = nothing(*inputs)
    assert found.points2D.shape == (0, 2)
    assert len(found.points) == len(found.scores) == 0


def test_convolutions_in_half_precision_do_not_spoil_the_rest(network, inputs, found):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rough = network(*inputs)
    assert rough.confidence.dtype == rough.points2D.dtype == torch.float32
    np.testing.assert_allclose(rough.confidence, found.confidence, atol=0.2)
    assert len(np.intersect1d(rough.points, found.points)) > 20


def test_sides_of_the_image_must_be_multiples_of_8(network, inputs):
    with pytest.raises(ValueError, match="multiples of 8"):
        network(inputs[0][:, :, :-4], *inputs[1:])
