"""Where cells and points are, told to the transformer by adding it to their features."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

_EXTENT = 0.6  # of the longest side of the points' bounding box: unit of length of normalized points


def encoded_cells(coarse: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
    """Features of cells plus sines and cosines of their column and row, counted from 1.

    The frequencies fall by the factor e from one group of four channels to the next, which is how the
    published weights were trained; as the formula is usually written [1] they would fall far slower.

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
    """Points shifted and scaled alike for objects of any place and size: mean 0, about 1 in extent.

    Each set of a batch by itself, where the authors' code scales all by the first.
    """
    size = (points3D.amax(dim=1) - points3D.amin(dim=1)).amax(dim=1)
    return (points3D - points3D.mean(dim=1, keepdim=True)) / (_EXTENT * size)[:, None, None]


class PointEncoding(nn.Module):
    """A perceptron that makes a feature of a normalized position. Each layer is normalized by itself."""

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
        """Descriptors plus the features of the points' positions, a row a point."""
        return descriptors.transpose(1, 2) + self.encoder(normalized(points3D))
