"""SuperGlue [1], with the layers of transformers and the authors' weights.

The library pads two images to the same number of keypoints, which changes the result of optimal transport.
Here padding, which only several pairs of images at once need, has no mass, so that results are those of the
authors' code, which does not pad.

References:
    [1] Sarlin, DeTone, Malisiewicz and Rabinovich, SuperGlue: Learning Feature Matching with Graph Neural
        Networks, CVPR 2020.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from transformers import SuperGlueConfig, SuperGlueForKeypointMatching
from transformers.models.superglue.modeling_superglue import normalize_keypoints

from slimsfm.arrays import IndexPairs
from slimsfm.features.base import Features, unit_rows
from slimsfm.networks.batches import OnDevice, in_batches
from slimsfm.networks.loading import choose_device, inference, load_network

_THRESHOLD = 0.2  # least probability of a match
_ITERATIONS = 100  # of Sinkhorn's algorithm
_HEADS = 4
_NEVER = -1e9  # score of padding; finite, because the difference of two infinities is undefined


@dataclass(frozen=True, kw_only=True, eq=False)
class _Side:
    """The first or the second images of a batch of pairs, padded."""

    tokens: Float[Tensor, "b n d"]
    real: Bool[Tensor, "b n"]
    """Which keypoints are not padding."""

    mask: Bool[Tensor, "b 1 1 n"] | None
    """Keypoints to attend to; None for all, because attention is faster without a mask."""


class SuperGlue:
    """Matches the SuperPoint features of two images by attention and optimal transport."""

    def __init__(self, features: str) -> None:
        """Create a matcher; `features` must be superpoint, the only extractor with trained weights."""
        if features != "superpoint":
            raise ValueError(
                f"features must be superpoint, the only ones with trained weights, got {features!r}"
            )

    @cached_property
    def network(self) -> SuperGlueForKeypointMatching:
        """The network with its trained weights, without the library's built-in detector."""
        made = SuperGlueForKeypointMatching(SuperGlueConfig())
        del made.keypoint_detector
        return load_network(made, "superglue", superglue_state)

    def match(self, features1: Features, features2: Features) -> IndexPairs:
        """Match two images. Each feature occurs at most once; pairs are sorted by the first feature."""
        return self.match_many([(features1, features2)])[0]

    def match_many(self, pairs: Sequence[tuple[Features, Features]]) -> list[IndexPairs]:
        """Match pairs of images, on a GPU many at once; equal to `match` of each up to rounding.

        Raises:
            InputError: The GPU has not enough memory for a pair.
        """
        device = choose_device()

        def solve(batch: Sequence[tuple[Features, Features]]) -> list[IndexPairs]:
            with torch.inference_mode(), inference(device):
                return _mutual(self.scores(batch, device)[:, :-1, :-1])

        return in_batches(solve, pairs, device)

    def scores(
        self, pairs: Sequence[tuple[Features, Features]], device: torch.device
    ) -> Float[Tensor, "b rows columns"]:
        """Logarithms of the probabilities of all matches, minus infinity for padding.

        The last row and column mean no match.
        """
        one, other = (
            self._encoded([self._given(features, device) for features in images])
            for images in zip(*pairs, strict=True)
        )
        gnn = self.network.gnn
        for layer, kind in zip(gnn.layers, gnn.layers_types or (), strict=True):
            sources = (other, one) if kind == "cross" else (one, other)
            one, other = (
                replace(target, tokens=_attended(layer, target.tokens, source))
                for target, source in zip((one, other), sources, strict=True)
            )
        projected = [self.network.final_projection(side.tokens) for side in (one, other)]
        products = (projected[0] @ projected[1].transpose(1, 2) / projected[0].shape[2] ** 0.5).float()
        return _transport(products, self.network.get_parameter("bin_score"), one.real, other.real)

    @cached_property
    def _given(self) -> OnDevice[Features]:
        return OnDevice(_input)

    def _encoded(self, images: Sequence[tuple[Tensor, ...]]) -> _Side:
        """Images padded to the same number of keypoints."""
        places, descriptors, scores = (
            pad_sequence(list(values), batch_first=True) for values in zip(*images, strict=True)
        )
        counts = torch.tensor([len(values) for values, *_ in images], device=places.device)
        real = torch.arange(places.shape[1], device=places.device) < counts[:, None]
        is_padded = min(map(len, next(zip(*images, strict=True)))) < places.shape[1]
        tokens = descriptors + self.network.keypoint_encoder(places, scores)[0]
        return _Side(tokens=tokens, real=real, mask=real[:, None, None] if is_padded else None)


def _input(features: Features, device: torch.device) -> tuple[Tensor, ...]:
    """Places of keypoints relative to the image, descriptors, scores."""
    pixels, descriptors, scores = (
        torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(device)
        for values in (features.keypoints - 0.5, unit_rows(features.descriptors), features.scores)
    )
    width, height = features.image_size
    return normalize_keypoints(pixels[None], height, width)[0], descriptors, scores


def _attended(layer: Any, target: Float[Tensor, "b n d"], source: _Side) -> Float[Tensor, "b n d"]:
    """Keypoints of images after attention to those of the sources, without a table of all pairs of them."""
    attention = layer.attention.self
    heads = [
        project(tokens).unflatten(-1, (_HEADS, -1)).transpose(1, 2)
        for project, tokens in (
            (attention.query, target),
            (attention.key, source.tokens),
            (attention.value, source.tokens),
        )
    ]
    seen = F.scaled_dot_product_attention(*heads, attn_mask=source.mask)
    message = layer.attention.output(seen.transpose(1, 2).flatten(start_dim=2))
    changes = torch.cat([target, message], dim=2)
    for part in layer.mlp:
        changes = part(changes)
    return target + changes


def _transport(
    products: Float[Tensor, "b n m"],
    bin_score: Tensor,
    real1: Bool[Tensor, "b n"],
    real2: Bool[Tensor, "b m"],
) -> Float[Tensor, "b rows columns"]:
    """Optimal transport between the keypoints of pairs of images and bins for those without a match.

    Sinkhorn's algorithm as in the authors' code, for keypoints of which some are padding and have no mass.
    """
    padding = ~(real1[:, :, None] & real2[:, None])
    table = F.pad(products.masked_fill(padding, _NEVER), (0, 1, 0, 1))
    table[:, -1], table[:, :, -1] = bin_score, bin_score
    counts1, counts2 = (real.sum(dim=1, keepdim=True).float() for real in (real1, real2))
    total = (counts1 + counts2).log()
    mass1, mass2 = (
        torch.cat([torch.where(real, -total, -torch.inf), others.log() - total], dim=1)
        for real, others in ((real1, counts2), (real2, counts1))
    )
    scales1, scales2 = torch.zeros_like(mass1), torch.where(mass2.isinf(), mass2, 0.0)
    for _ in range(_ITERATIONS):
        scales1 = mass1 - torch.logsumexp(table + scales2[:, None], dim=2)
        scales2 = mass2 - torch.logsumexp(table + scales1[:, :, None], dim=1)
    return table + scales1[:, :, None] + scales2[:, None] + total[:, :, None]


def _mutual(scores: Float[Tensor, "b rows columns"]) -> list[IndexPairs]:
    """The pairs of keypoints of each pair of images that match each other best, and well enough."""
    best, columns = scores.max(dim=2)
    rows = torch.arange(scores.shape[1], device=scores.device)
    mutual = scores.argmax(dim=1).take_along_dim(columns, 1) == rows
    matched = (mutual & (best.exp() > _THRESHOLD)).cpu().numpy()
    found = columns.cpu().numpy()
    return [np.stack([np.flatnonzero(one), of[one]], axis=1) for one, of in zip(matched, found, strict=True)]


def superglue_state(checkpoint: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Convert the authors' state dict to that of transformers; from the latter, drop only the detector."""
    if "kenc.encoder.0.weight" not in checkpoint:
        return {k: v for k, v in checkpoint.items() if not k.startswith("keypoint_detector.")}
    return dict(_renamed(key, value) for key, value in checkpoint.items())


def _renamed(key: str, value: Tensor) -> tuple[str, Tensor]:
    value = (
        value.squeeze(-1) if key.endswith("weight") and value.ndim == 3 else value
    )  # convolutions of width 1
    if key.startswith("kenc.encoder."):
        return f"keypoint_encoder.{_perceptron(key.removeprefix('kenc.'), last=12)}", value
    if key.startswith("gnn.layers."):
        _, _, layer, rest = key.split(".", 3)
        name, value = _attention(rest, value)
        return f"gnn.layers.{layer}.{name}", value
    return key.replace("final_proj.", "final_projection.final_proj."), value


def _attention(key: str, value: Tensor) -> tuple[str, Tensor]:
    """Convert attention layers: the authors store channels first, transformers heads first."""
    if key.startswith("attn.proj."):
        name = ("query", "key", "value")[int(key.split(".")[2])]
        return f"attention.self.{name}.{key.rpartition('.')[2]}", _heads_first(value)
    if key == "attn.merge.weight":
        return "attention.output.dense.weight", _heads_first(value.T).T
    if key == "attn.merge.bias":
        return "attention.output.dense.bias", value
    return _perceptron(key, last=3), value


def _heads_first(value: Tensor) -> Tensor:
    return value.unflatten(0, (-1, _HEADS)).transpose(0, 1).flatten(0, 1)


def _perceptron(key: str, last: int) -> str:
    """Rename `STEM.i.REST`: the authors count layers, transformers blocks of three layers."""
    stem, number, rest = key.split(".", 2)
    block, part = divmod(int(number), 3)
    if int(number) == last:
        return f"{stem}.{block}.{rest}"
    return f"{stem}.{block}.{('linear', 'batch_norm')[part]}.{rest}"
