"""Kornia's LightGlue on several pairs of images at once, with the results that each pair has alone.

Images are padded to the same number of keypoints, and attention ignores the padding. Pairs whose matches are
certain leave the batch, and keypoints without a match are dropped, in each pair as the network does alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Int64
from kornia.feature import LightGlue
from kornia.feature.lightglue import (
    CrossBlock,
    MatchAssignment,
    filter_matches,
    normalize_keypoints,
    sigmoid_log_double_softmax,
)
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from slimsfm.arrays import IndexPairs
from slimsfm.errors import InputError

Given = tuple[Tensor, ...]
"""What the network is given of an image: places (n, 2), or (n, 4) with scales and orientations, of keypoints
relative to the image, and descriptors (n, d)."""


class CrossAttention(nn.Module):
    """Cross-attention between two images without a table of all pairs of keypoints.

    Equal to kornia's layer up to rounding, and faster with many keypoints.
    """

    def __init__(self, layer: CrossBlock) -> None:
        """Share the weights of kornia's layer."""
        super().__init__()
        self.layer = layer

    def forward(
        self,
        one: Float[Tensor, "b n d"],
        other: Float[Tensor, "b m d"],
        mask1: Bool[Tensor, "b 1 1 n"] | None = None,
        mask2: Bool[Tensor, "b 1 1 m"] | None = None,
    ) -> tuple[Float[Tensor, "b n d"], Float[Tensor, "b m d"]]:
        """Update the keypoints of each image by attention to those of the other that its mask keeps."""
        (keys1, values1), (keys2, values2) = self._heads(one), self._heads(other)
        seen1 = F.scaled_dot_product_attention(keys1, keys2, values2, mask2)
        seen2 = F.scaled_dot_product_attention(keys2, keys1, values1, mask1)
        return self._changed(one, seen1), self._changed(other, seen2)

    def _heads(self, features: Tensor) -> tuple[Tensor, ...]:
        """Keys, which are also the queries, and values: (b, heads, n, d / heads)."""
        both = self.layer.to_qk(features), self.layer.to_v(features)
        return tuple(one.unflatten(-1, (self.layer.heads, -1)).transpose(1, 2) for one in both)

    def _changed(self, features: Tensor, seen: Tensor) -> Tensor:
        message = self.layer.to_out(seen.transpose(1, 2).flatten(start_dim=2))
        return features + self.layer.ffn(torch.cat([features, message], dim=-1))


def with_fused_attention(network: LightGlue) -> LightGlue:
    """Replace the network's layers of cross-attention, as `match_batch` needs it."""
    for layer in network.transformers:
        if isinstance(layer.cross_attn, CrossBlock):
            layer.cross_attn = CrossAttention(layer.cross_attn)
    return network


def given_to(network: LightGlue, image: Mapping[str, Tensor]) -> Given:
    """What the network is given of an image.

    Args:
        network: The network.
        image: As in kornia, without the dimension of the batch: keypoints (n, 2), descriptors (n, d),
            image_size (2), and scales and oris (n) if the network uses them.

    Raises:
        InputError: A keypoint is outside of the image.
    """
    places = normalize_keypoints(image["keypoints"][None], image["image_size"][None])[0]
    if not bool((places.abs() <= 1).all()):
        raise InputError("features have keypoints outside of their image; extract or import them again")
    if network.conf.add_scale_ori:
        scales = image["scales"] * network.conf.scale_coef
        places = torch.cat([places, scales[:, None], image["oris"][:, None]], dim=1)
    return places, image["descriptors"]


class _Certainty(NamedTuple):
    """What decides how a batch goes on after a layer."""

    stop: list[bool]
    """Whether the matches of each pair are certain."""

    kept: tuple[Bool[Tensor, "b n"], Bool[Tensor, "b m"]]
    """Keypoints of both images that may have a match."""

    counts: tuple[list[int], list[int]]
    """The number of them, for each pair."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Side:
    """The first or the second images of a batch of pairs, padded."""

    tokens: Float[Tensor, "b n d"]
    encoding: Float[Tensor, "2 b 1 n h"]
    rows: Int64[Tensor, "b n"]
    """Row of each keypoint in its image, which has other keypoints too once some are dropped."""

    counts: list[int]
    """Number of keypoints of each image; those after them are padding."""

    real: Bool[Tensor, "b n"]
    """Which keypoints are not padding."""

    @property
    def mask(self) -> Bool[Tensor, "b 1 1 n"] | None:
        """Keypoints to attend to; None for all, because attention is faster without a mask."""
        return None if min(self.counts) == self.rows.shape[1] else self.real[:, None, None]

    def of(self, pairs: list[int]) -> "_Side":
        """The images of some of the pairs."""
        if len(pairs) == len(self.counts):
            return self
        counts = [self.counts[pair] for pair in pairs]
        most, which = max(counts), torch.tensor(pairs, device=self.rows.device)
        return _Side(
            tokens=self.tokens[which, :most],
            encoding=self.encoding[:, which, :, :most],
            rows=self.rows[which, :most],
            counts=counts,
            real=self.real[which, :most],
        )

    def keeping(self, kept: Bool[Tensor, "b n"], counts: list[int]) -> "_Side":
        """Only some keypoints of each image, in their order."""
        if counts == self.counts:
            return self
        order = torch.argsort((~kept).to(torch.uint8), dim=1, stable=True)[:, : max(counts)]
        firsts = torch.arange(len(order), device=order.device)[:, None] * kept.shape[1]
        places, shape = (order + firsts).flatten(), order.shape
        return _Side(
            tokens=self.tokens.flatten(0, 1).index_select(0, places).unflatten(0, shape),
            encoding=self.encoding.flatten(1, 3)
            .index_select(1, places)
            .unflatten(1, (len(order), 1, shape[1])),
            rows=self.rows.flatten().index_select(0, places).unflatten(0, shape),
            counts=counts,
            real=kept.flatten().index_select(0, places).unflatten(0, shape),
        )


def match_batch(network: LightGlue, pairs: Sequence[tuple[Given, Given]]) -> list[IndexPairs]:
    """Match pairs of images, none of which is without keypoints, in one batch.

    Args:
        network: A network that `with_fused_attention` has changed.
        pairs: Both images of each pair, from `given_to`.

    Returns:
        Rows of the keypoints that match, sorted by the first; equal to those of each pair alone up to
        rounding.
    """
    found = [np.zeros((0, 2), np.int64) for _ in pairs]
    one, other = (_padded(network, images) for images in zip(*pairs, strict=True))
    totals = torch.tensor(
        [a + b for a, b in zip(one.counts, other.counts, strict=True)], device=one.tokens.device
    )
    left = list(range(len(pairs)))
    for layer in range(network.conf.n_layers):
        one, other = _attended(network.transformers[layer], one, other)
        certainty = _certainty(network, layer, one, other, totals[left])
        done = [place for place in range(len(left)) if certainty.stop[place]]
        if done:
            matched = _matches(network, layer, one.of(done), other.of(done))
            for place, matches in zip(done, matched, strict=True):
                found[left[place]] = matches
        one, other = (
            side.keeping(kept, counts)
            for side, kept, counts in zip((one, other), certainty.kept, certainty.counts, strict=True)
        )
        counts = zip(certainty.stop, one.counts, other.counts, strict=True)
        stay = [place for place, (stop, a, b) in enumerate(counts) if not stop and a and b]
        if not stay:
            break
        one, other, left = one.of(stay), other.of(stay), [left[place] for place in stay]
    return found


def _padded(network: LightGlue, images: Sequence[Given]) -> _Side:
    places, descriptors = (pad_sequence(list(one), batch_first=True) for one in zip(*images, strict=True))
    device = places.device
    with torch.autocast(device.type, enabled=False):
        encoding = network.posenc(places)  # angles of many turns, which half precision would round too much
    if torch.is_autocast_enabled(device.type):
        half = torch.get_autocast_dtype(device.type)
        descriptors, encoding = descriptors.to(half), encoding.to(half)
    rows = torch.arange(places.shape[1], device=device)
    counts = [len(one) for one, _ in images]
    return _Side(
        tokens=network.input_proj(descriptors),
        encoding=encoding,
        rows=rows.expand(len(images), -1),
        counts=counts,
        real=rows < torch.tensor(counts, device=device)[:, None],
    )


def _attended(layer: Any, one: _Side, other: _Side) -> tuple[_Side, _Side]:
    """Both images after a layer of the network."""
    masks = one.mask, other.mask
    within = [
        layer.self_attn(side.tokens, side.encoding, mask)
        for side, mask in zip((one, other), masks, strict=True)
    ]
    tokens = layer.cross_attn(*within, *masks)
    one, other = (replace(side, tokens=new) for new, side in zip(tokens, (one, other), strict=True))
    return one, other


def _certainty(network: Any, layer: int, one: _Side, other: _Side, totals: Tensor) -> _Certainty:
    """Which pairs stop and which keypoints they keep, by the network's criteria, each pair by itself."""
    real, conf = (one.real, other.real), network.conf
    counts = one.counts, other.counts
    if layer == conf.n_layers - 1:
        return _Certainty([True] * len(one.counts), real, counts)
    confidences, stop = (None, None), torch.zeros(len(one.counts), dtype=torch.bool, device=totals.device)
    if conf.depth_confidence > 0:
        confidences = network.token_confidence[layer](one.tokens, other.tokens)
        threshold = network.confidence_thresholds[layer]
        unsure = [((c < threshold) & r).sum(dim=1) for c, r in zip(confidences, real, strict=True)]
        stop = 1.0 - (unsure[0] + unsure[1]).float() / totals > conf.depth_confidence
    fewest = network.pruning_min_kpts(totals.device)
    kept = list(real)
    for which, side in enumerate((one, other)):
        if conf.width_confidence > 0 and max(side.counts) > fewest:
            scores = network.log_assignment[layer].get_matchability(side.tokens)
            few = real[which].sum(dim=1, keepdim=True) <= fewest
            kept[which] = real[which] & (few | network.get_pruning_mask(confidences[which], scores, layer))
    stops, *kept_counts = torch.stack([stop.long(), *(k.sum(dim=1) for k in kept)]).tolist()
    return _Certainty([bool(one) for one in stops], (kept[0], kept[1]), (kept_counts[0], kept_counts[1]))


def _matches(network: Any, layer: int, one: _Side, other: _Side) -> list[IndexPairs]:
    """The matches of each pair, which may be none."""
    head: MatchAssignment = network.log_assignment[layer]
    projected = [head.final_proj(side.tokens) / head.dim**0.25 for side in (one, other)]
    products = torch.einsum("bmd,bnd->bmn", *projected)
    if one.mask is not None or other.mask is not None:
        padding = ~(one.real[:, :, None] & other.real[:, None])
        products = products.masked_fill(padding, torch.finfo(products.dtype).min)
    scores = sigmoid_log_double_softmax(
        products, head.matchability(one.tokens), head.matchability(other.tokens)
    )
    columns = filter_matches(scores, network.conf.filter_threshold)[0]
    rows = torch.where(columns >= 0, one.rows, -1)
    columns = other.rows.take_along_dim(columns.clamp(min=0), 1)
    both = torch.stack([rows, columns], dim=2).cpu().numpy()
    return [pairs[pairs[:, 0] >= 0] for pairs in both]
