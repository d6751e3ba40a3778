"""From features to matches: which cell shows a point, and where in its surroundings."""

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Int64
from torch import Tensor

TEMPERATURE = 0.0801  # of the dual softmax, as trained
BORDER = 2  # cells that are not matched, at the upper and the left rim
WINDOW = 5  # fine cells along a side of the window that a match is refined in
STRIDE = 4  # fine cells along a side of a cell


class CellMatches(NamedTuple):
    """Points of a map and the cells of an image that show them, sorted by point."""

    batches: Int64[Tensor, " k"]
    """Which image of the batch."""

    points: Int64[Tensor, " k"]
    """Which point."""

    cells: Int64[Tensor, " k"]
    """Which cell, numbered row by row."""

    scores: Float[Tensor, " k"]
    """Confidences."""


def dual_softmax(
    points: Float[Tensor, "b m c"], cells: Float[Tensor, "b s c"], temperature: float = TEMPERATURE
) -> Float[Tensor, "b m s"]:
    """How sure it is that point i and cell j match: softmax over cells times softmax over points [1].

    Their logarithms are added in place, for the matrix may have a hundred million entries.

    References:
        [1] Rocco, Cimpoi, Arandjelović, Torii, Pajdla and Sivic, Neighbourhood Consensus Networks,
            NeurIPS 2018.
    """
    scale = points.shape[2] ** -0.5
    similarities = (points * scale) @ (cells * scale).transpose(1, 2) / temperature
    over_cells = similarities.logsumexp(dim=2, keepdim=True)
    over_points = similarities.logsumexp(dim=1, keepdim=True)
    return similarities.mul_(2).sub_(over_cells).sub_(over_points).exp_()


def mutual_matches(
    confidence: Float[Tensor, "b m s"], grid: tuple[int, int], threshold: float
) -> CellMatches:
    """Points and cells that prefer each other to all others and are surer than a threshold.

    Args:
        confidence: Of each pair.
        grid: Rows and columns of cells.
        threshold: Lowest confidence.
    """
    best, cells = confidence.max(dim=2)
    is_mutual = confidence.amax(dim=1).gather(1, cells) == best
    is_good = is_mutual & (best > threshold) & _inside(grid, confidence.device)[cells]
    batches, points = torch.nonzero(is_good, as_tuple=True)
    return CellMatches(batches, points, cells[batches, points], best[batches, points])


def _inside(grid: tuple[int, int], device: torch.device) -> Bool[Tensor, " s"]:
    """Cells away from the upper and left rim. The others are kept, as by the code that was published."""
    inside = torch.zeros(grid, dtype=torch.bool, device=device)
    inside[BORDER:, BORDER:] = True
    return inside.flatten()


def windows(fine: Float[Tensor, "b f h4 w4"], matches: CellMatches, columns: int) -> Float[Tensor, "k ww f"]:
    """The fine features around the middle of matched cells, row by row; zeros beyond the rim.

    Args:
        fine: Fine features of the images.
        matches: The cells.
        columns: Cells in a row.
    """
    padded = F.pad(fine, [WINDOW // 2] * 4).permute(0, 2, 3, 1)
    steps = torch.arange(WINDOW, device=fine.device)
    rows = STRIDE * (matches.cells // columns)[:, None] + steps
    across = STRIDE * (matches.cells % columns)[:, None] + steps
    return padded[matches.batches[:, None, None], rows[:, :, None], across[:, None, :]].flatten(1, 2)


def expected_offsets(point: Float[Tensor, "k f"], window: Float[Tensor, "k ww f"]) -> Float[Tensor, "k 2"]:
    """Where in a window a point is, in fine cells (x, y) from its middle: the mean under a softmax [1].

    References:
        [1] Sun, Shen, Wang, Bao and Zhou, LoFTR: Detector-Free Local Feature Matching with Transformers,
            CVPR 2021.
    """
    similarities = torch.einsum("kf,kwf->kw", point, window) * point.shape[1] ** -0.5
    heat = similarities.softmax(dim=1).unflatten(1, (WINDOW, WINDOW))
    offsets = torch.arange(WINDOW, device=heat.device, dtype=heat.dtype) - WINDOW // 2
    return torch.stack([heat.sum(dim=1) @ offsets, heat.sum(dim=2) @ offsets], dim=1)
