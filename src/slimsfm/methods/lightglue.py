"""LightGlue [1], with the network of kornia.

References:
    [1] Lindenberger, Sarlin and Pollefeys, LightGlue: Local Feature Matching at Light Speed, ICCV 2023.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from kornia.feature import LightGlue as Network
from torch import Tensor, nn

from slimsfm.arrays import IndexPairs
from slimsfm.errors import InputError
from slimsfm.features.base import Features, unit_rows
from slimsfm.networks.batches import OnDevice, in_batches
from slimsfm.networks.lightglue import given_to, match_batch, with_fused_attention
from slimsfm.networks.loading import choose_device, inference, load_network
from slimsfm.networks.onnx import Exportable, Run, onnx_run

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
        return with_fused_attention(loaded)

    def match(self, features1: Features, features2: Features) -> IndexPairs:
        """Match two images. Each feature occurs at most once; pairs are sorted by the first feature.

        The network stops early and prunes unmatched keypoints; its ONNX export runs all layers.
        """
        return self.match_many([(features1, features2)])[0]

    def match_many(self, pairs: Sequence[tuple[Features, Features]]) -> list[IndexPairs]:
        """Match pairs of images, on a GPU many at once; equal to `match` of each up to rounding.

        Raises:
            InputError: The GPU has not enough memory for a pair, or SIFT features lack what they need.
        """
        device = choose_device()
        run = onnx_run(self._weights)

        def solve(batch: Sequence[tuple[Features, Features]]) -> list[IndexPairs]:
            with torch.inference_mode(), inference(device):
                if run:
                    return [self._by_onnx(run, one, other) for one, other in batch]
                given = [(self._given(one, device), self._given(other, device)) for one, other in batch]
                return match_batch(self.network, given)

        return in_batches(solve, pairs, device)

    @cached_property
    def _given(self) -> OnDevice[Features]:
        return OnDevice(lambda features, device: given_to(self.network, self._input(features, device)))

    def _by_onnx(self, run: Run, features1: Features, features2: Features) -> IndexPairs:
        both = [self._input(features, torch.device("cpu")).values() for features in (features1, features2)]
        columns = run(*(value[None] for values in both for value in values))[0][0].numpy().astype(np.int64)
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
        return {key: torch.from_numpy(np.ascontiguousarray(value)).to(device) for key, value in given.items()}


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
