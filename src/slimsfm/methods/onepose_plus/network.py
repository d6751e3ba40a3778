"""The network of OnePose++ [1], for inference with the published weights.

An image is divided into cells of 8x8 pixels. Cells and points of a map attend to each other, and the most
similar pairs match. A second, smaller transformer refines the position of a point within the surroundings of
its cell, by the point's fine feature.

References:
    [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation without
        CAD Models, NeurIPS 2022.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from slimsfm.methods.onepose_plus.layers import (
    EIGHTH,
    HALF,
    Backbone,
    PointEncoding,
    Transformer,
    encoded_cells,
)

CELL, FINE_CELL = 8, 2  # pixels
TEMPERATURE = 0.0801  # of the dual softmax, as in training
BORDER = 2  # unmatched cells along the upper and the left border
WINDOW = 5  # fine cells along a side of the window in which a match is refined
STRIDE = 4  # fine cells along a side of a cell


class CellMatches(NamedTuple):
    """Points of a map and the matching cells of an image, sorted by point."""

    batches: Int64[Tensor, " k"]
    """Image of the batch."""

    points: Int64[Tensor, " k"]
    """Row of the point."""

    cells: Int64[Tensor, " k"]
    """Cell, numbered row by row."""

    scores: Float[Tensor, " k"]
    """Confidence of each match."""


def dual_softmax(
    points: Float[Tensor, "b m c"], cells: Float[Tensor, "b s c"], temperature: float = TEMPERATURE
) -> Float[Tensor, "b m s"]:
    """Confidence that point i and cell j match: softmax over cells times softmax over points [1].

    Logarithms are added in place, because the matrix may have a hundred million entries.

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
    """Find points and cells that are mutual nearest neighbors above a confidence threshold.

    Args:
        confidence: Confidence of each pair.
        grid: Number of rows and columns of cells.
        threshold: Confidences must exceed it.
    """
    best, cells = confidence.max(dim=2)
    is_mutual = confidence.amax(dim=1).gather(1, cells) == best
    is_good = is_mutual & (best > threshold) & _inside(grid, confidence.device)[cells]
    batches, points = torch.nonzero(is_good, as_tuple=True)
    return CellMatches(batches, points, cells[batches, points], best[batches, points])


def _inside(grid: tuple[int, int], device: torch.device) -> Bool[Tensor, " s"]:
    """Cells away from the upper and left border. The other borders stay, as in the published code."""
    inside = torch.zeros(grid, dtype=torch.bool, device=device)
    inside[BORDER:, BORDER:] = True
    return inside.flatten()


def windows(fine: Float[Tensor, "b f h4 w4"], matches: CellMatches, columns: int) -> Float[Tensor, "k ww f"]:
    """Fine features around the center of matched cells, row by row; zeros beyond the border.

    Args:
        fine: Fine features of the images.
        matches: The matched cells.
        columns: Number of cells in a row.
    """
    padded = F.pad(fine, [WINDOW // 2] * 4).permute(0, 2, 3, 1)
    steps = torch.arange(WINDOW, device=fine.device)
    rows = STRIDE * (matches.cells // columns)[:, None] + steps
    across = STRIDE * (matches.cells % columns)[:, None] + steps
    return padded[matches.batches[:, None, None], rows[:, :, None], across[:, None, :]].flatten(1, 2)


def expected_offsets(point: Float[Tensor, "k f"], window: Float[Tensor, "k ww f"]) -> Float[Tensor, "k 2"]:
    """Expected position of a point in a window under a softmax [1], in fine cells (x, y) from its center.

    References:
        [1] Sun, Shen, Wang, Bao and Zhou, LoFTR: Detector-Free Local Feature Matching with Transformers,
            CVPR 2021.
    """
    similarities = torch.einsum("kf,kwf->kw", point, window) * point.shape[1] ** -0.5
    heat = similarities.softmax(dim=1).unflatten(1, (WINDOW, WINDOW))
    offsets = torch.arange(WINDOW, device=heat.device, dtype=heat.dtype) - WINDOW // 2
    return torch.stack([heat.sum(dim=1) @ offsets, heat.sum(dim=2) @ offsets], dim=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class CoarseToFine:
    """Points found in images; row i of each array but the first describes match i."""

    confidence: Float[Tensor, "b m s"]
    """Confidence that a point and a cell match, for all pairs; cells are numbered row by row."""

    batches: Int64[Tensor, " k"]
    """Image of the batch, ascending."""

    points: Int64[Tensor, " k"]
    """Row of the point, ascending and unique within an image."""

    cells: Int64[Tensor, " k"]
    """Cell, unique within an image."""

    points2D: Float[Tensor, "k 2"]
    """Refined pixels (x, y); the center of the top-left pixel is (0, 0)."""

    scores: Float[Tensor, " k"]
    """Confidence of each match."""


class OnePosePlusMatcher(nn.Module):
    """Finds points of a map in gray images, in evaluation mode only."""

    def __init__(self, threshold: float = 0.1) -> None:
        """Create the untrained network.

        Args:
            threshold: Least confidence of a match.
        """
        super().__init__()
        self.threshold = threshold
        self.backbone = Backbone()
        self.kpt_3d_pos_encoding = PointEncoding(EIGHTH)
        self.loftr_coarse = Transformer(EIGHTH, rounds=3)
        self.loftr_fine = Transformer(HALF, rounds=1)

    def forward(
        self,
        image: Float[Tensor, "b 1 h w"],
        points3D: Float[Tensor, "b m 3"],
        coarse_descriptors: Float[Tensor, "b 256 m"],
        fine_descriptors: Float[Tensor, "b 128 m"],
    ) -> CoarseToFine:
        """Find points in images.

        The convolutions may run in half precision. The rest runs in single precision, because sums over
        thousands of cells and points overflow half precision.

        Args:
            image: Gray, from 0 to 1; both sides are multiples of 8.
            points3D: At least two different points, in any frame and unit.
            coarse_descriptors: Mean of LoFTR's coarse feature over the observations of each point.
            fine_descriptors: Mean of the fine feature.

        Raises:
            ValueError: A side of the image is not a multiple of 8.
        """
        rows, columns = (side // CELL for side in image.shape[2:])
        if image.shape[2:] != (CELL * rows, CELL * columns):
            raise ValueError(f"image must have sides that are multiples of {CELL}, got {image.shape[2:]}")
        coarse, fine = self.backbone(image)
        with torch.autocast(image.device.type, enabled=False):
            cells = encoded_cells(coarse.float()).flatten(2).transpose(1, 2)
            points = self.kpt_3d_pos_encoding(points3D, coarse_descriptors)
            confidence = dual_softmax(*self.loftr_coarse(points, cells))
            found = mutual_matches(confidence, (rows, columns), self.threshold)
            return CoarseToFine(
                confidence=confidence,
                batches=found.batches,
                points=found.points,
                cells=found.cells,
                points2D=self._refined(fine.float(), fine_descriptors, found, columns),
                scores=found.scores,
            )

    def _refined(
        self,
        fine: Float[Tensor, "b f h4 w4"],
        fine_descriptors: Float[Tensor, "b f m"],
        found: CellMatches,
        columns: int,
    ) -> Float[Tensor, "k 2"]:
        """Refined pixels of the matched points."""
        centers = CELL * torch.stack([found.cells % columns, found.cells // columns], dim=1)
        if not len(centers):
            return centers.to(fine.dtype)
        points = fine_descriptors.transpose(1, 2)[found.batches, found.points]
        refined, window = self.loftr_fine(points[:, None], windows(fine, found, columns))
        return centers + FINE_CELL * expected_offsets(refined[:, 0], window)
