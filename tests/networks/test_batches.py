"""Batches of pairs of images: their sizes, their order, and what happens when memory does not suffice."""

import gc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

from slimsfm.errors import InputError  # noqa: E402
from slimsfm.networks import batches  # noqa: E402
from slimsfm.networks.batches import OnDevice, in_batches, keypoint_pairs_of, num_fitting  # noqa: E402

CPU = torch.device("cpu")
IMAGES = st.lists(st.integers(0, 30).map(range), max_size=8)


class Solver:
    """Matches the first keypoints of two images, if no more pairs of images come at once than fit."""

    def __init__(self, most: int = 100) -> None:
        self.most, self.batches = most, []

    def __call__(self, pairs):
        assert all(len(one) and len(other) for one, other in pairs)
        self.batches.append(len(pairs))
        if len(pairs) > self.most:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return [np.array([[len(one), len(other)]]) for one, other in pairs]


@pytest.fixture
def much_memory(monkeypatch):
    monkeypatch.setattr(batches, "keypoint_pairs_of", lambda _: 10**9)


def answers(found):
    return [one.tolist() for one in found]


@given(ones=IMAGES, others=IMAGES, most=st.integers(1, 4))
def test_each_pair_gets_its_own_matches_and_an_empty_image_none(ones, others, most):
    pairs = list(zip(ones, others, strict=False))
    expected = [[[len(a), len(b)]] if len(a) and len(b) else [] for a, b in pairs]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batches, "keypoint_pairs_of", lambda _: 10**9)
        assert answers(in_batches(Solver(most), pairs, CPU)) == expected


def test_a_cpu_matches_one_pair_at_a_time():
    solver = Solver()
    in_batches(solver, [(range(5), range(6))] * 3, CPU)
    assert solver.batches == [1, 1, 1]


@pytest.mark.usefixtures("much_memory")
def test_a_batch_is_halved_until_it_fits_and_stays_so():
    solver = Solver(most=2)
    assert len(in_batches(solver, [(range(5), range(6))] * 9, CPU)) == 9
    assert solver.batches == [9, 4, 2, 2, 2, 2, 1]


def test_a_pair_that_does_not_fit_alone_is_named():
    message = "^device cuda: the GPU has not enough memory to match images of 7 and 5 keypoints; free some"
    with pytest.raises(InputError, match=message) as raised:
        in_batches(Solver(most=0), [(range(7), range(5)), (range(1), range(2))], CPU)
    assert "\n" not in str(raised.value)


@given(
    sizes=st.lists(st.tuples(st.integers(1, 5000), st.integers(1, 5000)), min_size=1, max_size=20),
    memory=st.integers(0, 10**8),
)
def test_padded_images_fit_and_one_more_would_not(sizes, memory):
    def needed(count):
        rows, columns = np.max(sizes[:count], axis=0).tolist()
        return count * (rows * columns + 256 * (rows + columns))

    count = num_fitting(sizes, memory)
    assert 1 <= count <= len(sizes)
    assert count == 1 or needed(count) <= memory
    assert count == len(sizes) or needed(count + 1) > memory


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_takes_several_pairs_at_once():
    assert num_fitting([(512, 512)] * 8, keypoint_pairs_of(torch.device("cuda"))) > 1


class Image:
    """Something that tensors are made from."""


META = torch.device("meta")  # any device but the CPU; its tensors have sizes but no values


def maker(made, count=100):
    def make(image, device):
        made.append(image)
        return (torch.zeros(count, device=device),)

    return make


def test_tensors_stay_on_the_device_as_long_as_their_object_lives():
    made: list = []
    keep, image, other = OnDevice(maker(made), most_bytes=800), Image(), Image()
    first = keep(image, META)
    assert keep(image, META) is first
    keep(other, META)
    assert made == [image, other]
    third = Image()
    assert keep(third, META) is not keep(third, META)  # there is no place left
    made.clear()
    del other
    gc.collect()
    assert keep(third, META) is keep(third, META)
    assert keep(image, META) is first
    assert len(made) == 1


def test_a_cpu_keeps_nothing():
    made: list = []
    keep, image = OnDevice(maker(made)), Image()
    keep(image, CPU), keep(image, CPU)
    assert len(made) == 2
