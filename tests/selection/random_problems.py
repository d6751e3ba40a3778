"""Random selection problems: each image is a camera of its own before points of its own."""

import numpy as np
from hypothesis import strategies as st
from scipy.sparse import csr_array

from slimsfm.selection import SelectionProblem


def motions(in_cam: np.ndarray) -> np.ndarray:
    """How points move when the camera's frame turns, by the cross product, or shifts."""
    turned = np.stack([np.cross(axis, in_cam) for axis in np.eye(3)], axis=2)
    return np.concatenate([turned, np.broadcast_to(np.eye(3), (len(in_cam), 3, 3))], axis=2)


def problem_of(uses: np.ndarray, seed: int = 0) -> SelectionProblem:
    """The problem of a dense matrix of uses, seen by cameras of focal length 500."""
    rng = np.random.default_rng(seed)
    x, y, z = in_cam = rng.uniform([[-0.5], [-0.5], [1]], [[0.5], [0.5], [2]], (3, uses.size))
    zero = np.zeros_like(x)
    pixels = 500 * np.array([[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]]).transpose(2, 0, 1)
    twists = (pixels @ motions(in_cam.T)).astype(np.float32).reshape(*uses.shape, 2, 6)
    corners = rng.uniform([-0.4, -0.4, 1], [0.4, 0.4, 2], (len(uses), 8, 3))
    corner_twists = motions(corners.reshape(-1, 3)).reshape(len(uses), 24, 6).astype(np.float32)
    return SelectionProblem(usable=csr_array(uses), twists=twists[uses], corner_twists=corner_twists)


def reordered(problem: SelectionProblem, images: np.ndarray) -> SelectionProblem:
    """The same problem with its images in another order."""
    numbers = csr_array(problem.usable.astype(np.int64))
    numbers.data = np.arange(1, numbers.nnz + 1)
    numbers = csr_array(numbers[images])
    return SelectionProblem(
        usable=csr_array(numbers.astype(bool)),
        twists=problem.twists[numbers.data - 1],
        corner_twists=problem.corner_twists[images],
    )


def users(problem: SelectionProblem) -> np.ndarray:
    """The uses as a dense matrix [images, points]."""
    return problem.usable.toarray().astype(bool)


@st.composite
def problems(draw, max_images: int = 8, max_points: int = 30) -> SelectionProblem:
    """Problems of any density, some of whose images and points are of no use."""
    shape = (draw(st.integers(0, max_images)), draw(st.integers(0, max_points)))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    uses = rng.random(shape) < draw(st.floats(0, 1))
    uses[rng.random(shape[0]) < 0.1] = False
    return problem_of(uses, seed)
