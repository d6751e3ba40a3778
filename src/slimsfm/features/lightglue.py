"""LightGlue [1], by kornia.

References:
    [1] Lindenberger, Sarlin and Pollefeys, LightGlue: Local Feature Matching at Light Speed, ICCV 2023.
"""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import torch
from kornia.feature import LightGlue as Network
from torch import Tensor

from slimsfm.arrays import IndexPairs
from slimsfm.features.base import Features, unit_rows
from slimsfm.networks.devices import choose_device, inference
from slimsfm.networks.loading import load_network

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
        return load_network(made, weights, lightglue_state, derived={"confidence_thresholds"})

    def match(self, features1: Features, features2: Features) -> IndexPairs:
        """Match two images; no feature occurs twice. Sorted by the feature of the first."""
        if not len(features1) or not len(features2):
            return np.zeros((0, 2), np.int64)
        network, device = self.network, choose_device()
        data = {"image0": self._input(features1, device), "image1": self._input(features2, device)}
        with torch.inference_mode(), inference(device):
            pairs = network(data)["matches"][0].cpu().numpy().astype(np.int64)
        return pairs[np.argsort(pairs[:, 0], kind="stable")]

    def _input(self, features: Features, device: torch.device) -> dict[str, Tensor]:
        given: dict[str, Any] = {
            "keypoints": features.keypoints - np.float32(0.5),
            "descriptors": unit_rows(features.descriptors),
            "image_size": np.array(features.image_size, np.float32),
        }
        if self._features == "sift":
            if features.frames is None:
                raise ValueError("features must have scales and orientations; extract them anew")
            given["scales"], given["oris"] = features.frames.T
        return {
            key: torch.from_numpy(np.ascontiguousarray(value)).to(device)[None]
            for key, value in given.items()
        }


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
