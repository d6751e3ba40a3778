"""The network of OnePose++ [1], for inference with the published weights.

An image is divided into cells of 8x8 pixels. Cells and points of a map attend to each other, and the most
similar pairs match. A second, smaller transformer refines the position of a point within the surroundings of
its cell, by the point's fine feature.

References:
    [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation without
        CAD Models, NeurIPS 2022.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

HALF, QUARTER, EIGHTH = 128, 196, 256
"""Channels at a half, a quarter and an eighth of the image's resolution."""


class Backbone(nn.Module):
    """Features of a gray image. The center of cell (c, r) is the center of pixel (8 c, 8 r)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(1, HALF, kernel_size=7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(HALF)
        self.layer1 = nn.Sequential(Residual(HALF, HALF), Residual(HALF, HALF))
        self.layer2 = nn.Sequential(Residual(HALF, QUARTER, stride=2), Residual(QUARTER, QUARTER))
        self.layer3 = nn.Sequential(Residual(QUARTER, EIGHTH, stride=2), Residual(EIGHTH, EIGHTH))
        self.layer3_outconv = _conv1x1(EIGHTH, EIGHTH)
        self.layer2_outconv = _conv1x1(QUARTER, EIGHTH)
        self.layer2_outconv2 = _smoothing(EIGHTH, QUARTER)
        self.layer1_outconv = _conv1x1(HALF, QUARTER)
        self.layer1_outconv2 = _smoothing(QUARTER, HALF)

    def forward(
        self, image: Float[Tensor, "b 1 height width"]
    ) -> tuple[Float[Tensor, "b 256 h w"], Float[Tensor, "b 128 h4 w4"]]:
        """Compute coarse and fine features; the sides of the image are multiples of 8."""
        half = self.layer1(F.relu(self.bn1(self.conv1(image))))
        quarter = self.layer2(half)
        eighth = self.layer3(quarter)
        coarse = self.layer3_outconv(eighth)
        medium = self.layer2_outconv2(self.layer2_outconv(quarter) + _doubled(coarse))
        fine = self.layer1_outconv2(self.layer1_outconv(half) + _doubled(medium))
        return coarse, fine


class Residual(nn.Module):
    """Two 3x3 convolutions with a residual connection."""

    def __init__(self, channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = _conv3x3(channels, out_channels, stride)
        self.conv2 = _conv3x3(out_channels, out_channels)
        self.bn1 = nn.BatchNorm2d(out_channels)
        self.bn2 = nn.BatchNorm2d(out_channels)
        self.downsample = (
            nn.Identity()
            if stride == 1
            else nn.Sequential(_conv1x1(channels, out_channels, stride), nn.BatchNorm2d(out_channels))
        )

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        """Compute features; the stride divides the resolution."""
        change = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(self.downsample(x) + change)


def _smoothing(channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(
        _conv3x3(channels, channels),
        nn.BatchNorm2d(channels),
        nn.LeakyReLU(),
        _conv3x3(channels, out_channels),
    )


def _conv1x1(channels: int, out_channels: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(channels, out_channels, kernel_size=1, stride=stride, bias=False)


def _conv3x3(channels: int, out_channels: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(channels, out_channels, kernel_size=3, stride=stride, padding=1, bias=False)


def _doubled(features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h2 w2"]:
    return F.interpolate(features, scale_factor=2.0, mode="bilinear", align_corners=True)


_EXTENT = 0.6  # unit of length of normalized points, relative to the longest side of their bounding box


def encoded_cells(coarse: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
    """Add sines and cosines of column and row, counted from 1, to the features of cells.

    Frequencies fall by the factor e from one group of four channels to the next, as in the training of the
    published weights; in the usual formula [1] they fall much more slowly.

    References:
        [1] Carion, Massa, Synnaeve, Usunier, Kirillov and Zagoruyko, End-to-End Object Detection with
            Transformers, ECCV 2020.
    """
    _, channels, height, width = coarse.shape
    frequencies = torch.exp(-torch.arange(0, channels // 2, 2, device=coarse.device).float())
    columns = torch.arange(1, width + 1, device=coarse.device) * frequencies[:, None]
    rows = torch.arange(1, height + 1, device=coarse.device) * frequencies[:, None]
    waves = [
        columns.sin()[:, None].expand(-1, height, -1),
        columns.cos()[:, None].expand(-1, height, -1),
        rows.sin()[:, :, None].expand(-1, -1, width),
        rows.cos()[:, :, None].expand(-1, -1, width),
    ]
    return coarse + torch.stack(waves, dim=1).flatten(0, 1)


def normalized(points3D: Float[Tensor, "b m 3"]) -> Float[Tensor, "b m 3"]:
    """Normalize points to mean 0 and an extent of about 1.

    Each set of a batch is scaled separately, whereas the authors' code scales all by the first.
    """
    size = (points3D.amax(dim=1) - points3D.amin(dim=1)).amax(dim=1)
    return (points3D - points3D.mean(dim=1, keepdim=True)) / (_EXTENT * size)[:, None, None]


class PointEncoding(nn.Module):
    """A perceptron from normalized positions to features, with layer normalization."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        widths = [3, 32, 64, 128]
        layers: list[nn.Module] = []
        for width, out_width in pairwise(widths):
            norm = nn.LayerNorm(out_width, elementwise_affine=False)
            layers += [nn.Linear(width, out_width), norm, nn.ReLU()]
        self.encoder = nn.Sequential(*layers, nn.Linear(widths[-1], channels))

    def forward(
        self, points3D: Float[Tensor, "b m 3"], descriptors: Float[Tensor, "b c m"]
    ) -> Float[Tensor, "b m c"]:
        """Add the features of the points' positions to their descriptors, one row per point."""
        return descriptors.transpose(1, 2) + self.encoder(normalized(points3D))


HEADS = 8


class Transformer(nn.Module):
    """Several rounds in which points and cells attend to their own kind, then to the other kind.

    In each step both sides attend to the state before the step.
    """

    def __init__(self, channels: int, rounds: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Attending(channels) for _ in range(2 * rounds))

    def forward(
        self, points: Float[Tensor, "b m c"], cells: Float[Tensor, "b s c"]
    ) -> tuple[Float[Tensor, "b m c"], Float[Tensor, "b s c"]]:
        """Update the features of points and cells."""
        for step, layer in enumerate(self.layers):
            of_points, of_cells = (points, cells) if step % 2 == 0 else (cells, points)
            points, cells = layer(points, of_points), layer(cells, of_cells)
        return points, cells


class Attending(nn.Module):
    """Attention with a residual connection."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.q_proj, self.k_proj, self.v_proj, self.merge = (
            nn.Linear(channels, channels, bias=False) for _ in range(4)
        )
        self.mlp = nn.Sequential(
            nn.Linear(2 * channels, 2 * channels, bias=False),
            nn.ReLU(),
            nn.Linear(2 * channels, channels, bias=False),
        )
        self.norm1 = nn.LayerNorm(channels)
        self.norm2 = nn.LayerNorm(channels)

    def forward(self, x: Float[Tensor, "b n c"], source: Float[Tensor, "b s c"]) -> Float[Tensor, "b n c"]:
        """Attend from `x` to `source`."""
        query, key, value = (
            projected.unflatten(2, (HEADS, -1))
            for projected in (self.q_proj(x), self.k_proj(source), self.v_proj(source))
        )
        message = self.norm1(self.merge(linear_attention(query, key, value).flatten(2)))
        return x + self.norm2(self.mlp(torch.cat([x, message], dim=2)))


def linear_attention(
    query: Float[Tensor, "b n heads d"],
    key: Float[Tensor, "b s heads d"],
    value: Float[Tensor, "b s heads d"],
) -> Float[Tensor, "b n heads d"]:
    """Average values, weighted by the dot products of queries and keys after the function elu + 1.

    The sum over keys is computed once for all queries: O((n + s) heads d^2).
    """
    query, key = F.elu(query) + 1, F.elu(key) + 1
    sums = torch.einsum("bshd,bshv->bhdv", key, value)
    weights = torch.einsum("bnhd,bhd->bnh", query, key.sum(dim=1))
    return torch.einsum("bnhd,bhdv->bnhv", query, sums) / (weights + 1e-6)[..., None]


CELL, FINE_CELL = 8, 2  # pixels
TEMPERATURE = 0.0801  # of the dual softmax, as in training
BORDER = 2  # unmatched cells along the upper and the left border
WINDOW = 5  # fine cells along a side of the window in which a match is refined
STRIDE = 4  # fine cells along a side of a cell


class PointCellMatches(NamedTuple):
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
) -> PointCellMatches:
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
    return PointCellMatches(batches, points, cells[batches, points], best[batches, points])


def _inside(grid: tuple[int, int], device: torch.device) -> Bool[Tensor, " s"]:
    """Cells away from the upper and left border. The other borders stay, as in the published code."""
    inside = torch.zeros(grid, dtype=torch.bool, device=device)
    inside[BORDER:, BORDER:] = True
    return inside.flatten()


def windows(
    fine: Float[Tensor, "b f h4 w4"], matches: PointCellMatches, columns: int
) -> Float[Tensor, "k ww f"]:
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
        found: PointCellMatches,
        columns: int,
    ) -> Float[Tensor, "k 2"]:
        """Refined pixels of the matched points."""
        centers = CELL * torch.stack([found.cells % columns, found.cells // columns], dim=1)
        if not len(centers):
            return centers.to(fine.dtype)
        points = fine_descriptors.transpose(1, 2)[found.batches, found.points]
        refined, window = self.loftr_fine(points[:, None], windows(fine, found, columns))
        return centers + FINE_CELL * expected_offsets(refined[:, 0], window)
