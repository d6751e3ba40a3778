"""DISK [1] keypoints and descriptors, by kornia.

References:
    [1] Tyszkiewicz, Fua and Trulls, DISK: Learning Local Features with Policy Gradient, NeurIPS 2020.
"""

from dataclasses import asdict, dataclass
from functools import cached_property

import torch
from kornia.feature import DISK

from slimsfm.arrays import GrayImage, Image
from slimsfm.features.base import Features
from slimsfm.features.learned import check_sizes, features_of, network_input
from slimsfm.networks.devices import choose_device, inference
from slimsfm.networks.loading import load_network


@dataclass(frozen=True, kw_only=True)
class Disk:
    """Extracts DISK features."""

    max_features: int = 2048
    """Keep this many keypoints, those of highest score."""

    max_image_size: int = 1024
    """Shrink larger images so that their longer side has this many pixels."""

    def __post_init__(self) -> None:
        check_sizes(self.max_features, self.max_image_size)

    @property
    def name(self) -> str:
        """The name under which a map remembers its extractor."""
        return "disk"

    @property
    def options(self) -> dict:
        """What `load_extractor` needs to make an equal extractor."""
        return asdict(self)

    @cached_property
    def network(self) -> DISK:
        """The network with its trained weights."""
        return load_network(DISK(), "disk", lambda checkpoint: dict(checkpoint["extractor"]))

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:
        """Find features; none where the mask, of the image's size, is 0."""
        taken = network_input(image, self.max_image_size, choose_device())
        count = self.max_features if mask is None else None
        with torch.inference_mode(), inference(taken.pixels.device):
            found = self.network(taken.pixels, count, pad_if_not_divisible=True)[0]
        parts = found.keypoints.to(torch.float32), found.descriptors, found.detection_scores
        return features_of(taken, *parts, mask, self.max_features)
