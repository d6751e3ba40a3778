"""Pairs of images in batches: how many fit into memory, and tensors that stay on the GPU."""

from collections.abc import Callable, Hashable, Sequence, Sized
from contextlib import nullcontext
from threading import Lock
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from slimsfm.arrays import IndexPairs
from slimsfm.errors import InputError

_BYTES = 64  # of memory per pair of keypoints: products and logarithms of probabilities, several at a time
_AS_PAIRS = 256  # a keypoint's activations in a layer take as much memory as this many pairs of keypoints
_LARGEST = 2**28  # 64 pairs of images with 2048 keypoints: more at once are no faster
_KEPT_BYTES = 2**30  # of the tensors of one matcher that stay on the GPU

Image = TypeVar("Image", bound=Sized)
Key = TypeVar("Key", bound=Hashable)

_GPU = Lock()  # one batch at a time, because each may take half of what is free


def in_batches(
    solve: Callable[[Sequence[tuple[Image, Image]]], list[IndexPairs]],
    pairs: Sequence[tuple[Image, Image]],
    device: torch.device,
) -> list[IndexPairs]:
    """Match pairs of images in batches that fit into memory, pairs of similar size together.

    A CPU matches one pair at a time, because padding costs it more than a batch saves. If the memory of a GPU
    does not suffice, a batch of half the size is tried.

    Args:
        solve: Matches the pairs of a batch.
        pairs: The features of two images each; the length of an image is its number of keypoints.
        device: Where `solve` runs.

    Returns:
        The matches of each pair, in the order of `pairs`; none where an image has no keypoints.

    Raises:
        InputError: The GPU has not enough memory for a single pair.
    """
    found = [np.zeros((0, 2), np.int64) for _ in pairs]
    sizes = [(len(one), len(other)) for one, other in pairs]
    left = sorted((row for row in range(len(pairs)) if min(sizes[row])), key=lambda row: sizes[row])[::-1]
    most = len(left)
    while left:
        with _GPU if device.type == "cuda" else nullcontext():
            count = min(most, num_fitting([sizes[row] for row in left], keypoint_pairs_of(device)))
            solved = _or_none(solve, [pairs[row] for row in left[:count]])
        if solved is None and count == 1:
            raise _too_large(sizes[left[0]])
        if solved is None:
            most = count // 2
            continue
        for row, matches in zip(left, solved, strict=False):
            found[row] = matches
        left = left[count:]
    return found


def keypoint_pairs_of(device: torch.device) -> int:
    """How many pairs of keypoints a batch may have: on a GPU as many as fit into half of its free memory."""
    if device.type != "cuda":
        return 0
    free, _ = torch.cuda.mem_get_info(device)
    unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return min((free + unused) // (2 * _BYTES), _LARGEST)


def num_fitting(sizes: Sequence[tuple[int, int]], keypoint_pairs: int) -> int:
    """How many of the first pairs of images fit into a batch; at least one.

    All are padded to the largest numbers of keypoints among them, and keypoints take memory too.

    Args:
        sizes: Number of keypoints of both images of each pair.
        keypoint_pairs: Most pairs of keypoints in a batch.
    """
    rows = columns = 0
    for count, size in enumerate(sizes, start=1):
        rows, columns = max(rows, size[0]), max(columns, size[1])
        if count > 1 and count * (rows * columns + _AS_PAIRS * (rows + columns)) > keypoint_pairs:
            return count - 1
    return len(sizes)


def _or_none(
    solve: Callable[[Sequence[tuple[Image, Image]]], list[IndexPairs]], batch: Sequence[tuple[Image, Image]]
) -> list[IndexPairs] | None:
    """The matches of a batch; None if the memory of the GPU does not suffice."""
    try:
        return solve(batch)
    except torch.OutOfMemoryError:
        pass  # the exception holds the tensors of the batch until here
    torch.cuda.empty_cache()
    return None


def _too_large(size: tuple[int, int]) -> InputError:
    return InputError(
        f"device cuda: the GPU has not enough memory to match images of {size[0]} and {size[1]} keypoints; "
        "free some of it, extract fewer features, or set the device to cpu"
    )


class OnDevice(Generic[Key]):
    """Keeps tensors on a GPU as long as the object lives that they were made from, up to a limit of memory.

    Reference images, which are matched with every query, are sent there once. What exceeds the limit is made
    again each time, as is everything on a CPU, where this costs less than the memory.
    """

    def __init__(
        self, make: Callable[[Key, torch.device], tuple[Tensor, ...]], most_bytes: int = _KEPT_BYTES
    ) -> None:
        """Take the function that makes the tensors of an object, and the limit."""
        self._make, self._most_bytes = make, most_bytes
        self._kept: WeakKeyDictionary[Key, tuple[Tensor, ...]] = WeakKeyDictionary()
        self._lock = Lock()

    def __call__(self, key: Key, device: torch.device) -> tuple[Tensor, ...]:
        """The tensors of an object on a device."""
        if device.type == "cpu":
            return self._make(key, device)
        with self._lock:
            kept = self._kept.get(key)
            if kept is not None and kept[0].device.type == device.type:
                return kept
            made = self._make(key, device)
            if _bytes(made) + sum(map(_bytes, self._kept.values())) <= self._most_bytes:
                self._kept[key] = made
            return made


def _bytes(tensors: tuple[Tensor, ...]) -> int:
    return sum(one.nbytes for one in tensors)
