"""Layers of the network of OnePose++: backbone, positional encodings and linear transformer.

The backbone is a residual network with a feature pyramid [1, 2], with a coarse feature every 8 pixels and a
fine one every 2. The attention of the transformer [3] is linear in the number of cells and points [4].

References:
    [1] He, Zhang, Ren and Sun, Deep Residual Learning for Image Recognition, CVPR 2016.
    [2] Lin, Dollár, Girshick, He, Hariharan and Belongie, Feature Pyramid Networks for Object Detection,
        CVPR 2017.
    [3] Sun, Shen, Wang, Bao and Zhou, LoFTR: Detector-Free Local Feature Matching with Transformers,
        CVPR 2021.
    [4] Katharopoulos, Vyas, Pappas and Fleuret, Transformers are RNNs: Fast Autoregressive Transformers with
        Linear Attention, ICML 2020.
"""

from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
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
