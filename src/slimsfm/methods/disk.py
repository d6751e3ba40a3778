"""DISK [1] keypoints and descriptors, with the network of kornia.

References:
    [1] Tyszkiewicz, Fua and Trulls, DISK: Learning Local Features with Policy Gradient, NeurIPS 2020.
"""

from dataclasses import asdict, dataclass
from functools import cached_property

import torch
import torch.nn.functional as F  # noqa: N812
from kornia.feature import DISK
from kornia.feature.disk.detector import heatmap_to_keypoints
from torch import Tensor, nn

from slimsfm.arrays import GrayImage, Image
from slimsfm.features.base import Features
from slimsfm.methods.keypoints import check_sizes
from slimsfm.methods.tensors import features_of, network_input
from slimsfm.networks.loading import choose_device, inference, load_network
from slimsfm.networks.onnx import Exportable, onnx_run

_STEP = 16  # pixels: the sides of the network's input must be multiples of it


@dataclass(frozen=True, kw_only=True)
class Disk:
    """Extracts DISK features."""

    max_features: int = 2048
    """Largest number of keypoints; those with the highest scores are kept."""

    max_image_size: int = 1024
    """Shrink larger images so that their longer side has this many pixels."""

    def __post_init__(self) -> None:
        check_sizes(self.max_features, self.max_image_size)

    @property
    def name(self) -> str:
        """Name of the extractor in a map's `map.json`."""
        return "disk"

    @property
    def options(self) -> dict:
        """Options with which `load_extractor` creates an equal extractor."""
        return asdict(self)

    @cached_property
    def network(self) -> DISK:
        """The network with its trained weights."""
        return load_network(DISK(), "disk", lambda checkpoint: dict(checkpoint["extractor"]))

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:
        """Extract features; the mask has the size of the image, and no feature lies where it is 0."""
        taken = network_input(image, self.max_image_size, choose_device())
        height, width = taken.pixels.shape[2:]
        padded = F.pad(taken.pixels, (0, -width % _STEP, 0, -height % _STEP))
        count = self.max_features if mask is None else None
        with torch.inference_mode(), inference(padded.device):
            maps = (onnx_run("disk") or self.network.heatmap_and_dense_descriptors)(padded)
            heatmap, descriptors = (one[..., :height, :width] for one in maps)
            found = heatmap_to_keypoints(heatmap, count)[0].merge_with_descriptors(descriptors[0])
        parts = found.keypoints.to(torch.float32), found.descriptors, found.detection_scores
        return features_of(taken, *parts, mask, self.max_features)


def exportable(_method: str) -> Exportable:
    """The convolutions: from an image (sides multiples of 16) to scores and descriptors of pixels."""
    return Exportable(
        network=_Maps(Disk().network.cpu()),
        inputs={"image": torch.zeros(1, 3, 96, 128)},
        dynamic={"image": (2, 3)},
        outputs=("scores", "descriptors"),
    )


class _Maps(nn.Module):
    def __init__(self, network: DISK) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        return self.network.heatmap_and_dense_descriptors(image)
