"""SuperGlue [1], with the layers of transformers and the authors' weights.

The library pads two images to the same number of keypoints, which changes the result of optimal transport.
Here its layers run on each image without padding, as in the authors' code.

References:
    [1] Sarlin, DeTone, Malisiewicz and Rabinovich, SuperGlue: Learning Feature Matching with Graph Neural
        Networks, CVPR 2020.
"""

from collections.abc import Mapping
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from transformers import SuperGlueConfig, SuperGlueForKeypointMatching
from transformers.models.superglue.modeling_superglue import log_optimal_transport, normalize_keypoints

from slimsfm.arrays import IndexPairs
from slimsfm.features.base import Features, unit_rows
from slimsfm.networks.loading import choose_device, inference, load_network

_THRESHOLD = 0.2  # least probability of a match
_ITERATIONS = 100  # of Sinkhorn's algorithm
_HEADS = 4


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
        if not len(features1) or not len(features2):
            return np.zeros((0, 2), np.int64)
        device = choose_device()
        with torch.inference_mode(), inference(device):
            scores = self.scores(features1, features2, device)[0, :-1, :-1]
        best, columns = scores.max(dim=1)
        mutual = scores.argmax(dim=0)[columns] == torch.arange(len(columns), device=device)
        rows = torch.nonzero(mutual & (best.exp() > _THRESHOLD))[:, 0]
        return torch.stack([rows, columns[rows]], dim=1).cpu().numpy().astype(np.int64)

    def scores(
        self, features1: Features, features2: Features, device: torch.device
    ) -> Float[Tensor, "1 rows columns"]:
        """Logarithms of the probabilities of all matches; the last row and column mean no match."""
        one, other = (self._encoded(features, device) for features in (features1, features2))
        gnn = self.network.gnn
        for layer, kind in zip(gnn.layers, gnn.layers_types or (), strict=True):
            sources = (other, one) if kind == "cross" else (one, other)
            changes = [
                layer(target, encoder_hidden_states=source)[0]
                for target, source in zip((one, other), sources, strict=True)
            ]
            one, other = one + changes[0], other + changes[1]
        one, other = self.network.final_projection(one), self.network.final_projection(other)
        products = (one @ other.transpose(1, 2) / one.shape[2] ** 0.5).to(torch.float32)
        return log_optimal_transport(products, self.network.get_parameter("bin_score"), _ITERATIONS)

    def _encoded(self, features: Features, device: torch.device) -> Float[Tensor, "1 n d"]:
        width, height = features.image_size
        pixels, descriptors, scores = (
            torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(device)[None]
            for values in (features.keypoints - 0.5, unit_rows(features.descriptors), features.scores)
        )
        places = normalize_keypoints(pixels, height, width)
        return descriptors + self.network.keypoint_encoder(places, scores)[0]


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
