"""A transformer [1] whose attention is linear [2] in the number of cells and points.

References:
    [1] Sun, Shen, Wang, Bao and Zhou, LoFTR: Detector-Free Local Feature Matching with Transformers,
        CVPR 2021.
    [2] Katharopoulos, Vyas, Pappas and Fleuret, Transformers are RNNs: Fast Autoregressive Transformers with
        Linear Attention, ICML 2020.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor, nn

HEADS = 8


class Transformer(nn.Module):
    """Lets points and cells each look at their own kind, then at the other, several times over.

    Both sides look at what the other was before the step: neither is told what the other learns in it.
    """

    def __init__(self, channels: int, rounds: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Attending(channels) for _ in range(2 * rounds))

    def forward(
        self, points: Float[Tensor, "b m c"], cells: Float[Tensor, "b s c"]
    ) -> tuple[Float[Tensor, "b m c"], Float[Tensor, "b s c"]]:
        """Features of points and cells that know each other."""
        for step, layer in enumerate(self.layers):
            of_points, of_cells = (points, cells) if step % 2 == 0 else (cells, points)
            points, cells = layer(points, of_points), layer(cells, of_cells)
        return points, cells


class Attending(nn.Module):
    """Adds to each of some features what it takes from others."""

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
        """The features `x` after a look at `source`."""
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
    """Means of values, weighted by the dot products of queries and keys after the function elu + 1.

    The sum over keys is taken once for all queries: O((n + s) heads d^2).
    """
    query, key = F.elu(query) + 1, F.elu(key) + 1
    sums = torch.einsum("bshd,bshv->bhdv", key, value)
    weights = torch.einsum("bnhd,bhd->bnh", query, key.sum(dim=1))
    return torch.einsum("bnhd,bhdv->bnhv", query, sums) / (weights + 1e-6)[..., None]
