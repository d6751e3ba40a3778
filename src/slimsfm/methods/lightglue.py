"""LightGlue [1], with the network of kornia.

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
from slimsfm.networks.loading import choose_device, inference, load_network
from slimsfm.networks.onnx import Exportable, onnx_run

KNOWN = ("aliked", "disk", "sift", "superpoint")
"""Extractors with trained weights."""


class LightGlue:
    """Matches the features of two images by attention between them."""

    def __init__(self, features: str) -> None:
        """Create a matcher for the features of an extractor, one of `KNOWN`."""
        if features not in KNOWN:
            raise ValueError(f"features must be of one of {', '.join(KNOWN)}, got {features!r}")
        self._features, self._weights = features, f"lightglue-{features}"

    @cached_property
    def network(self) -> Network:
        """The network with its trained weights."""
        made, derived = network_for(self._features), {"confidence_thresholds"}
        loaded = load_network(made, self._weights, lightglue_state, derived)
        for layer in loaded.transformers:
            layer.cross_attn = CrossAttention(layer.cross_attn)  # pyright: ignore[reportArgumentType]
        return loaded

    def match(self, features1: Features, features2: Features) -> IndexPairs:
        """Match two images. Each feature occurs at most once; pairs are sorted by the first feature.

        The network stops early and prunes unmatched keypoints; its ONNX export runs all layers.
        """
        if not len(features1) or not len(features2):
            return np.zeros((0, 2), np.int64)
        device = choose_device()
        run = onnx_run(self._weights)
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
                    "lightglue needs the scales and orientations of SIFT features, which are missing here; "
                    "build or import the map again, or use the matcher nearest"
                )
            given["scales"], given["oris"] = features.frames.T
        return {
            key: torch.from_numpy(np.ascontiguousarray(value)).to(device)[None]
            for key, value in given.items()
        }


class CrossAttention(nn.Module):
    """Cross-attention between two images without a table of all pairs of keypoints.

    Equal to kornia's layer up to rounding, and faster with many keypoints.
    """

    def __init__(self, layer: CrossBlock) -> None:
        """Share the weights of kornia's layer."""
        super().__init__()
        self.layer = layer

    def forward(
        self, one: Float[Tensor, "1 n d"], other: Float[Tensor, "1 m d"]
    ) -> tuple[Float[Tensor, "1 n d"], Float[Tensor, "1 m d"]]:
        """Update the keypoints of each image by attention to those of the other."""
        (keys1, values1), (keys2, values2) = self._heads(one), self._heads(other)
        seen1 = F.scaled_dot_product_attention(keys1, keys2, values2)
        seen2 = F.scaled_dot_product_attention(keys2, keys1, values1)
        return self._changed(one, seen1), self._changed(other, seen2)

    def _heads(self, features: Tensor) -> tuple[Tensor, ...]:
        """Keys, which are also the queries, and values: (1, heads, n, d / heads)."""
        both = self.layer.to_qk(features), self.layer.to_v(features)
        return tuple(one.unflatten(-1, (self.layer.heads, -1)).transpose(1, 2) for one in both)

    def _changed(self, features: Tensor, seen: Tensor) -> Tensor:
        message = self.layer.to_out(seen.transpose(1, 2).flatten(start_dim=2))
        return features + self.layer.ffn(torch.cat([features, message], dim=-1))


class _WithoutStops(nn.Module):
    """Runs all layers for all keypoints, as a static graph."""

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
    """The whole network: from the keypoints of two images to the match of each of the first, or -1."""
    return exportable_network(LightGlue(method.removeprefix("lightglue-")).network.cpu())


def exportable_network(network: Network) -> Exportable:
    """The whole of a network with weights, on the CPU."""
    given = [_example(network, count) for count in (24, 32)]
    inputs = {f"{name}{i + 1}": value for i, one in enumerate(given) for name, value in one.items()}
    return Exportable(
        network=_WithoutStops(network, list(given[0])),
        inputs=inputs,
        dynamic={name: (1,) for name in inputs if not name.startswith("image_size")},
        outputs=("matches", "scores"),
    )


def _example(network: Network, count: int) -> dict[str, Tensor]:
    """Dummy input of one image."""
    given = {
        "keypoints": torch.zeros(1, count, 2),
        "descriptors": torch.zeros(1, count, network.conf.input_dim),
        "image_size": torch.ones(1, 2),
    }
    frames = ("scales", "oris") if network.conf.add_scale_ori else ()
    return given | {name: torch.zeros(1, count) for name in frames}


def network_for(features: str) -> Network:
    """Create the untrained network for the features of an extractor."""
    own = {key: value for key, value in Network.features[features].items() if key != "weights"}
    return Network(features=None, weights=None, **own)  # pyright: ignore[reportArgumentType]


def lightglue_state(checkpoint: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Convert the authors' state dict, which numbers layers per kind, to that of kornia.

    The file of LighterGlue also holds XFeat, and that for DISK values `r` that the network has no use for.
    """
    state = {}
    for key, value in checkpoint.items():
        if key.startswith("extractor.") or (key.startswith("log_assignment.") and key.endswith(".r")):
            continue
        key = key.removeprefix("matcher.")
        for kind in ("self_attn", "cross_attn"):
            if key.startswith(f"{kind}."):
                _, layer, rest = key.split(".", 2)
                key = f"transformers.{layer}.{kind}.{rest}"
        state[key] = value
    return state
