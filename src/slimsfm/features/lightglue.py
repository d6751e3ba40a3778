"""LightGlue [1], by kornia.

References:
    [1] Lindenberger, Sarlin and Pollefeys, LightGlue: Local Feature Matching at Light Speed, ICCV 2023.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from kornia.feature import LightGlue as Network
from kornia.feature.lightglue import CrossBlock
from torch import Tensor, nn

from slimsfm.arrays import IndexPairs
from slimsfm.errors import InputError
from slimsfm.features.base import Features, unit_rows
from slimsfm.networks.devices import choose_device, inference
from slimsfm.networks.loading import load_network
from slimsfm.networks.onnx import Exportable, onnx_run

KNOWN = ("aliked", "disk", "sift", "superpoint")
"""Extractors for whose features there are trained weights."""


class LightGlue:
    """Matches the features of two images by attention between them."""

    def __init__(self, features: str) -> None:
        """Of features of this extractor."""
        if features not in KNOWN:
            raise ValueError(f"features must be of one of {', '.join(KNOWN)}, got {features!r}")
        self._features = features

    @cached_property
    def network(self) -> Network:
        """The network with its trained weights."""
        made, weights = network_for(self._features), f"lightglue-{self._features}"
        loaded = load_network(made, weights, lightglue_state, derived={"confidence_thresholds"})
        for layer in loaded.transformers:
            layer.cross_attn = CrossAttention(layer.cross_attn)  # pyright: ignore[reportArgumentType]
        return loaded

    def match(self, features1: Features, features2: Features) -> IndexPairs:
        """Match two images; no feature occurs twice. Sorted by the feature of the first.

        The network stops as soon as it is sure, and drops what finds no match; an ONNX file runs through.
        """
        if not len(features1) or not len(features2):
            return np.zeros((0, 2), np.int64)
        device = choose_device()
        run = onnx_run(f"lightglue-{self._features}")
        given1, given2 = self._input(features1, device), self._input(features2, device)
        with torch.inference_mode(), inference(device):
            if run:
                matches = run(*given1.values(), *given2.values())[0]
            else:
                matches = self.network({"image0": given1, "image1": given2})["matches0"]
        columns = matches[0].cpu().numpy().astype(np.int64)
        rows = np.flatnonzero(columns >= 0)
        return np.stack([rows, columns[rows]], axis=1)

    def _input(self, features: Features, device: torch.device) -> dict[str, Tensor]:
        given: dict[str, Any] = {
            "keypoints": features.keypoints - np.float32(0.5),
            "descriptors": unit_rows(features.descriptors),
            "image_size": np.array(features.image_size, np.float32),
        }
        if self._features == "sift":
            if features.frames is None:
                raise InputError(
                    "lightglue looks at the scales and orientations of SIFT features, and these have none: "
                    "build or import the map again, or match by nearest"
                )
            given["scales"], given["oris"] = features.frames.T
        return {
            key: torch.from_numpy(np.ascontiguousarray(value)).to(device)[None]
            for key, value in given.items()
        }


class CrossAttention(nn.Module):
    """Attention between two images, without ever holding a table of all their pairs.

    Equal to the library's layer but for rounding, and the faster the more keypoints there are.
    """

    def __init__(self, layer: CrossBlock) -> None:
        """Of a layer of the library, whose weights are shared."""
        super().__init__()
        self.layer = layer

    def forward(
        self, one: Float[Tensor, "1 n d"], other: Float[Tensor, "1 m d"]
    ) -> tuple[Float[Tensor, "1 n d"], Float[Tensor, "1 m d"]]:
        """Tell the keypoints of each image what those of the other are like."""
        (keys1, values1), (keys2, values2) = self._heads(one), self._heads(other)
        seen1 = F.scaled_dot_product_attention(keys1, keys2, values2)
        seen2 = F.scaled_dot_product_attention(keys2, keys1, values1)
        return self._changed(one, seen1), self._changed(other, seen2)

    def _heads(self, features: Tensor) -> tuple[Tensor, ...]:
        """Keys, which are queries, too, and values: (1, heads, n, d / heads)."""
        both = self.layer.to_qk(features), self.layer.to_v(features)
        return tuple(one.unflatten(-1, (self.layer.heads, -1)).transpose(1, 2) for one in both)

    def _changed(self, features: Tensor, seen: Tensor) -> Tensor:
        message = self.layer.to_out(seen.transpose(1, 2).flatten(start_dim=2))
        return features + self.layer.ffn(torch.cat([features, message], dim=-1))


class _WithoutStops(nn.Module):
    """All layers for all keypoints, which makes a static graph."""

    def __init__(self, network: Network, names: Sequence[str]) -> None:
        super().__init__()
        self.network, self.names = network, names
        network.conf.depth_confidence = network.conf.width_confidence = -1

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        half = len(self.names)
        given = [dict(zip(self.names, part, strict=True)) for part in (inputs[:half], inputs[half:])]
        found = self.network({"image0": given[0], "image1": given[1]})
        return found["matches0"], found["matching_scores0"]


def exportable(method: str) -> Exportable:
    """What an ONNX file holds: keypoints of two images in; for each of the first its match, or -1, out."""
    network = LightGlue(method.removeprefix("lightglue-")).network.cpu()
    given = [_example(network, count) for count in (24, 32)]
    inputs = {f"{name}{i + 1}": value for i, one in enumerate(given) for name, value in one.items()}
    return Exportable(
        network=_WithoutStops(network, list(given[0])),
        inputs=inputs,
        dynamic={name: (1,) for name in inputs if not name.startswith("image_size")},
        outputs=("matches", "scores"),
    )


def _example(network: Network, count: int) -> dict[str, Tensor]:
    """What the network takes of one image, all of it nothing."""
    given = {
        "keypoints": torch.zeros(1, count, 2),
        "descriptors": torch.zeros(1, count, network.conf.input_dim),
        "image_size": torch.ones(1, 2),
    }
    frames = ("scales", "oris") if network.conf.add_scale_ori else ()
    return given | {name: torch.zeros(1, count) for name in frames}


def network_for(features: str) -> Network:
    """The network for features of an extractor, as long as it is without its weights."""
    own = {key: value for key, value in Network.features[features].items() if key != "weights"}
    return Network(features=None, weights=None, **own)  # pyright: ignore[reportArgumentType]


def lightglue_state(checkpoint: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The library's state dict of the authors' one, which counts layers within their kind."""
    state = {}
    for key, value in checkpoint.items():
        for kind in ("self_attn", "cross_attn"):
            if key.startswith(f"{kind}."):
                _, layer, rest = key.split(".", 2)
                key = f"transformers.{layer}.{kind}.{rest}"
        state[key] = value
    return state
