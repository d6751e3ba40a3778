"""SuperPoint [1] keypoints and descriptors, by transformers, from the weights that its authors published.

References:
    [1] DeTone, Malisiewicz and Rabinovich, SuperPoint: Self-Supervised Interest Point Detection and
        Description, CVPR Workshops 2018.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property

import torch
from torch import Tensor
from transformers import SuperPointConfig, SuperPointForKeypointDetection

from slimsfm.arrays import GrayImage, Image
from slimsfm.features.base import Features
from slimsfm.features.learned import check_sizes, features_of, network_input
from slimsfm.networks.devices import choose_device, inference
from slimsfm.networks.loading import load_network
from slimsfm.networks.onnx import Exportable, onnx_run
from slimsfm.networks.superpoint import SuperPointMaps, describe_pixels, strongest_pixels

_GRAY = (0.299, 0.587, 0.114)  # weights of red, green and blue

# The authors' names of the layers, and the library's.
_LAYERS = {
    **{f"conv{i + 1}{part}": f"encoder.conv_blocks.{i}.conv_{part}" for i in range(4) for part in ("a", "b")},
    "convPa": "keypoint_decoder.conv_score_a",
    "convPb": "keypoint_decoder.conv_score_b",
    "convDa": "descriptor_decoder.conv_descriptor_a",
    "convDb": "descriptor_decoder.conv_descriptor_b",
}


@dataclass(frozen=True, kw_only=True)
class SuperPoint:
    """Extracts SuperPoint features."""

    max_features: int = 2048
    """Keep this many keypoints, those of highest score."""

    max_image_size: int = 1024
    """Shrink larger images so that their longer side has this many pixels."""

    nms_radius: int = 4
    """Pixels around a keypoint in which there is no other."""

    threshold: float = 0.005
    """Lowest score of a keypoint."""

    def __post_init__(self) -> None:
        check_sizes(self.max_features, self.max_image_size)
        if self.nms_radius < 0:
            raise ValueError(f"nms_radius must not be negative, got {self.nms_radius}")
        if not 0 < self.threshold < 1:
            raise ValueError(f"threshold must be between 0 and 1, got {self.threshold}")

    @property
    def name(self) -> str:
        """The name under which a map remembers its extractor."""
        return "superpoint"

    @property
    def options(self) -> dict:
        """What `load_extractor` needs to make an equal extractor."""
        return asdict(self)

    @cached_property
    def maps(self) -> SuperPointMaps:
        """What of the network sees the image, with its trained weights."""
        made = SuperPointForKeypointDetection(SuperPointConfig())
        return SuperPointMaps(load_network(made, "superpoint", superpoint_state))

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:
        """Find features; none where the mask, of the image's size, is 0."""
        taken = network_input(image, self.max_image_size, choose_device())
        gray = torch.einsum("bchw,c->bhw", taken.pixels, taken.pixels.new_tensor(_GRAY))[:, None]
        with torch.inference_mode(), inference(gray.device):
            scores, descriptors = (onnx_run("superpoint") or self.maps)(gray)
            pixels, strengths = strongest_pixels(scores, self.nms_radius, self.threshold)
            described = describe_pixels(descriptors, pixels)
        return features_of(taken, pixels.to(torch.float32), described, strengths, mask, self.max_features)


def exportable(_method: str) -> Exportable:
    """What an ONNX file holds: gray image in, scores of pixels and descriptors of cells out."""
    return Exportable(
        network=SuperPoint().maps.cpu(),
        inputs={"gray": torch.zeros(1, 1, 96, 128)},
        dynamic={"gray": (2, 3)},
        outputs=("scores", "descriptors"),
    )


def superpoint_state(checkpoint: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The library's state dict of the authors' one, or of its own."""
    if not any(key.startswith("conv1a.") for key in checkpoint):
        return dict(checkpoint)
    parts = {key: key.rpartition(".") for key in checkpoint}
    return {f"{_LAYERS[parts[key][0]]}.{parts[key][2]}": value for key, value in checkpoint.items()}
