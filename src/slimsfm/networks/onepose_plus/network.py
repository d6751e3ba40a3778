"""The network of OnePose++ [1], for inference with the weights that its authors published.

It lays a grid of cells of 8x8 pixels over an image, lets cells and the points of a map look at each other,
and matches those that then resemble each other most. Where exactly in the surroundings of its cell a point
is, a second, smaller transformer says by the point's fine feature.

References:
    [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation without
        CAD Models, NeurIPS 2022.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from slimsfm.networks.onepose_plus.backbone import EIGHTH, HALF, Backbone
from slimsfm.networks.onepose_plus.matching import (
    CellMatches,
    dual_softmax,
    expected_offsets,
    mutual_matches,
    windows,
)
from slimsfm.networks.onepose_plus.positions import PointEncoding, encoded_cells
from slimsfm.networks.onepose_plus.transformer import Transformer

CELL, FINE_CELL = 8, 2  # pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class CoarseToFine:
    """Points that were found in images; row i of each array but the first describes match i."""

    confidence: Float[Tensor, "b m s"]
    """How sure it is that a cell shows a point, for all pairs; cells are numbered row by row."""

    batches: Int64[Tensor, " k"]
    """Which image of the batch, ascending."""

    points: Int64[Tensor, " k"]
    """Which point, ascending within an image; none occurs twice there."""

    cells: Int64[Tensor, " k"]
    """Which cell; none occurs twice in an image."""

    points2D: Float[Tensor, "k 2"]
    """Where exactly, pixels (x, y), the centre of the top-left pixel at (0, 0)."""

    scores: Float[Tensor, " k"]
    """Confidences."""


class OnePosePlusMatcher(nn.Module):
    """Finds points of a map in gray images. In the mode `eval` only."""

    def __init__(self, threshold: float = 0.1) -> None:
        """Make the network, untrained.

        Args:
            threshold: Lowest confidence of a match.
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

        The convolutions may run in half precision; what follows is done in single, for sums over thousands of
        cells and points overflow half.

        Args:
            image: Gray, from 0 to 1; both sides are multiples of 8.
            points3D: At least two different points, in any frame and unit.
            coarse_descriptors: The mean over each point's observations of the coarse feature of LoFTR.
            fine_descriptors: Likewise of the fine feature.

        Raises:
            ValueError: A side of the image is no multiple of 8.
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
        """Where exactly the matched points are."""
        middles = CELL * torch.stack([found.cells % columns, found.cells // columns], dim=1)
        if not len(middles):
            return middles.to(fine.dtype)
        points = fine_descriptors.transpose(1, 2)[found.batches, found.points]
        told, window = self.loftr_fine(points[:, None], windows(fine, found, columns))
        return middles + FINE_CELL * expected_offsets(told[:, 0], window)


def state_of(checkpoint: Mapping) -> dict[str, Tensor]:
    """The network's own state dict from a checkpoint of the authors' training framework."""
    return {key.removeprefix("matcher."): value for key, value in checkpoint["state_dict"].items()}
