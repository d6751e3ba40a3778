"""The network of OnePose [1], for inference with the published weights.

Keypoints of a query and points of a map attend to their own kind and to each other by linear attention, and
each point attends to some of its observations by graph attention. Then the most similar pairs match. Only
descriptors are used, not positions.

References:
    [1] Sun, Wang, Zhang, He, Zhao, Zhang and Zhou, OnePose: One-Shot Object Pose Estimation without CAD
        Models, CVPR 2022.
"""

from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float, Int64
from torch import Tensor, nn

DIMENSIONS = 256
"""Dimensions of a descriptor."""

THRESHOLD = 0.2
"""Least confidence of a match, as in training."""

_ROUNDS = 4
_HEADS = 4
_TEMPERATURE = 0.07  # of the dual softmax, as in training
_SLOPE = 0.2  # of negative attention logits


class MutualMatches(NamedTuple):
    """Pairs of a keypoint and a point that are mutual nearest neighbors, by keypoint."""

    pairs: Int64[Tensor, "k 2"]
    """Row of the keypoint and row of the point."""

    scores: Float[Tensor, " k"]
    """Confidence of each pair."""


class GraphAttentionMatcher(nn.Module):
    """Computes the confidence that a keypoint and a point match, for all pairs."""

    def __init__(self) -> None:
        super().__init__()
        # The published weights contain these three, but inference does not use them.
        self.kenc_2d = nn.ModuleDict({"encoder": _perceptron(3, 32, 64, 128, DIMENSIONS)})
        self.kenc_3d = nn.ModuleDict({"encoder": _perceptron(4, 32, 64, 128, DIMENSIONS)})
        self.bin_score = nn.Parameter(torch.ones(()))
        self.gnn = AttentionRounds()
        self.final_proj = nn.Conv1d(DIMENSIONS, DIMENSIONS, 1)

    def forward(
        self,
        query_descriptors: Float[Tensor, "b d n"],
        point_descriptors: Float[Tensor, "b d m"],
        leaf_descriptors: Float[Tensor, "b d all_leaves"],
    ) -> Float[Tensor, "b n m"]:
        """Confidences from 0 to 1 of all pairs, in single precision.

        O((n + m * leaves) d^2 + n m d) per round.

        Args:
            query_descriptors: SuperPoint descriptors of at least two keypoints.
            point_descriptors: Mean descriptor of the observations of each of at least two points.
            leaf_descriptors: The same number of observed descriptors of each point, point by point.
        """
        with torch.autocast(query_descriptors.device.type, enabled=False):
            leaves = leaf_descriptors.float().unflatten(2, (point_descriptors.shape[2], -1))
            updated = self.gnn(query_descriptors.float(), point_descriptors.float(), leaves)
            keypoints, points = (F.normalize(self.final_proj(one), dim=1) for one in updated)
            return dual_softmax(keypoints.transpose(1, 2) @ points / _TEMPERATURE)


class AttentionRounds(nn.Module):
    """Four rounds of attention: of points to observations, to the own kind, and to the other kind."""

    def __init__(self) -> None:
        super().__init__()
        kinds = (LeafAttention, Attention, Attention) * _ROUNDS
        self.layers = nn.ModuleList(kind() for kind in kinds)

    def forward(
        self,
        keypoints: Float[Tensor, "b d n"],
        points: Float[Tensor, "b d m"],
        leaves: Float[Tensor, "b d m leaves"],
    ) -> tuple[Float[Tensor, "b d n"], Float[Tensor, "b d m"]]:
        """Update the descriptors of keypoints and points."""
        for step, layer in enumerate(self.layers):
            if step % 3 == 0:
                points = layer(points, leaves)
            else:
                seen, seen_by_points = (keypoints, points) if step % 3 == 1 else (points, keypoints)
                # Both attend to the state before this step.
                keypoints, points = layer(keypoints, seen), layer(points, seen_by_points)
        return keypoints, points


class LeafAttention(nn.Module):
    """Mixes each point's descriptor with the descriptors of its observations [1].

    The weight of an observation is the sum of a linear function of it and one of the point. Both have one
    output and are applied directly, whereas the authors' code maps all descriptors to 256 dimensions first:
    O(m leaves d) instead of O(m leaves d^2).

    References:
        [1] Velickovic, Cucurull, Casanova, Romero, Lio and Bengio, Graph Attention Networks, ICLR 2018.
    """

    def __init__(self) -> None:
        super().__init__()
        self.W = nn.Parameter(torch.zeros(DIMENSIONS, DIMENSIONS))
        self.a = nn.Parameter(torch.zeros(2 * DIMENSIONS, 1))

    def forward(
        self, points: Float[Tensor, "b d m"], leaves: Float[Tensor, "b d m leaves"]
    ) -> Float[Tensor, "b d m"]:
        """Mix descriptors."""
        of_leaf, of_point = (self.W @ half for half in self.a[:, 0].chunk(2))
        of_leaves = torch.einsum("bdml,d->bml", leaves, of_leaf)
        # The point itself is weighted by the function of points, as in training.
        wanted = torch.einsum("bdm,d->bm", points, of_point)[:, :, None]
        logits = torch.cat([wanted, of_leaves], dim=2) + wanted
        weights = F.leaky_relu(logits, _SLOPE).softmax(dim=2)
        mixed = points * weights[:, None, :, 0] + torch.einsum("bdml,bml->bdm", leaves, weights[:, :, 1:])
        return F.elu(mixed)


class Attention(nn.Module):
    """Attention with a residual connection."""

    def __init__(self) -> None:
        super().__init__()
        self.attn = Heads()
        self.mlp = _perceptron(2 * DIMENSIONS, 2 * DIMENSIONS, DIMENSIONS)

    def forward(self, x: Float[Tensor, "b d n"], source: Float[Tensor, "b d s"]) -> Float[Tensor, "b d n"]:
        """Attend from `x` to `source`."""
        return x + self.mlp(torch.cat([x, self.attn(x, source)], dim=1))


class Heads(nn.Module):
    """Several heads of linear attention."""

    def __init__(self) -> None:
        super().__init__()
        self.merge = nn.Conv1d(DIMENSIONS, DIMENSIONS, 1)
        self.proj = nn.ModuleList(nn.Conv1d(DIMENSIONS, DIMENSIONS, 1) for _ in range(3))

    def forward(self, x: Float[Tensor, "b d n"], source: Float[Tensor, "b d s"]) -> Float[Tensor, "b d n"]:
        """Attend from `x` to `source`."""
        query, key, value = (
            projection(one).unflatten(1, (-1, _HEADS))
            for projection, one in zip(self.proj, (x, source, source), strict=True)
        )
        return self.merge(linear_attention(query, key, value).flatten(1, 2))


def linear_attention(
    query: Float[Tensor, "b d heads n"],
    key: Float[Tensor, "b d heads s"],
    value: Float[Tensor, "b d heads s"],
) -> Float[Tensor, "b d heads n"]:
    """Average values, weighted by the dot products of queries and keys after the function elu + 1 [1].

    The sum over keys is computed once for all queries: O((n + s) heads d^2).

    References:
        [1] Katharopoulos, Vyas, Pappas and Fleuret, Transformers are RNNs: Fast Autoregressive Transformers
            with Linear Attention, ICML 2020.
    """
    query, key = F.elu(query) + 1, F.elu(key) + 1
    sums = torch.einsum("bdhs,bvhs->bhdv", key, value)
    weights = torch.einsum("bdhn,bdh->bhn", query, key.sum(dim=3))
    return torch.einsum("bdhn,bhdv->bvhn", query, sums) / (weights + 1e-6)[:, None]


def dual_softmax(similarities: Float[Tensor, "b n m"]) -> Float[Tensor, "b n m"]:
    """Softmax over rows times softmax over columns: high for mutual nearest neighbors."""
    over_rows = similarities.logsumexp(dim=1, keepdim=True)
    over_columns = similarities.logsumexp(dim=2, keepdim=True)
    return (2 * similarities).sub_(over_rows).sub_(over_columns).exp_()


def mutual_matches(confidence: Float[Tensor, "n m"], threshold: float = THRESHOLD) -> MutualMatches:
    """Find mutual nearest neighbors above a confidence threshold.

    Args:
        confidence: Confidence of each pair; not empty.
        threshold: Confidences must exceed it.
    """
    best, columns = confidence.max(dim=1)
    rows = torch.arange(len(best), device=best.device)
    is_mutual = confidence.argmax(dim=0)[columns] == rows
    found = torch.nonzero(is_mutual & (best > threshold))[:, 0]
    return MutualMatches(torch.stack([found, columns[found]], dim=1), best[found])


def _perceptron(*channels: int) -> nn.Sequential:
    """Layers applied to each item; between them, values are normalized over all items."""
    layers: list[nn.Module] = [nn.Conv1d(channels[0], channels[1], 1)]
    for before, after in pairwise(channels[1:]):
        layers += [nn.InstanceNorm1d(before), nn.ReLU(), nn.Conv1d(before, after, 1)]
    return nn.Sequential(*layers)
