"""ALIKED [1] keypoints and descriptors, by kornia.

References:
    [1] Zhao, Wu, Chen, Chen, Xu and Lee, ALIKED: A Lighter Keypoint and Descriptor Extraction Network via
        Deformable Transformation, TIM 2023.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Literal

import torch
from kornia.feature import ALIKED

from slimsfm.arrays import GrayImage, Image
from slimsfm.features.base import Features
from slimsfm.features.learned import check_sizes, features_of, network_input
from slimsfm.networks.aliked import AlikedMaps, dense_maps
from slimsfm.networks.devices import choose_device, inference
from slimsfm.networks.loading import load_network
from slimsfm.networks.onnx import Exportable, onnx_run


@dataclass(frozen=True, kw_only=True)
class Aliked:
    """Extracts ALIKED features."""

    model: Literal["aliked-n16", "aliked-t16"] = "aliked-n16"
    """The network: n16 is more accurate, t16, with half as long descriptors, twice as fast."""

    max_features: int = 2048
    """Keep this many keypoints, those of highest score."""

    max_image_size: int = 1024
    """Shrink larger images so that their longer side has this many pixels."""

    threshold: float = 0.2
    """Lowest score of a keypoint."""

    def __post_init__(self) -> None:
        check_sizes(self.max_features, self.max_image_size)
        if self.model not in ("aliked-n16", "aliked-t16"):
            raise ValueError(f"model must be aliked-n16 or aliked-t16, got {self.model!r}")
        if not 0 < self.threshold < 1:
            raise ValueError(f"threshold must be between 0 and 1, got {self.threshold}")

    @property
    def name(self) -> str:
        """The name under which a map remembers its extractor."""
        return "aliked"

    @property
    def options(self) -> dict:
        """What `load_extractor` needs to make an equal extractor."""
        return asdict(self)

    @cached_property
    def network(self) -> ALIKED:
        """The network with its trained weights."""
        made = ALIKED(self.model, self.max_features, self.threshold)
        return load_network(made, self.model, derived={"dkd.hw_grid"})

    @cached_property
    def maps(self) -> AlikedMaps:
        """What of the network sees the image."""
        return AlikedMaps(self.network)

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:
        """Find features; none where the mask, of the image's size, is 0."""
        taken = network_input(image, self.max_image_size, choose_device())
        with torch.inference_mode(), inference(taken.pixels.device):
            seen = dense_maps(onnx_run(self.model) or self.maps, taken.pixels)
            places, strengths, _ = self.network.dkd(seen.scores)
            descriptors, _ = self.network.desc_head(seen.features, places)
        height, width = taken.pixels.shape[2:]
        far = taken.pixels.new_tensor([width - 1, height - 1])
        keypoints = far * (places[0] + 1) / 2  # from -1 to 1, corner pixel to corner pixel
        return features_of(taken, keypoints, descriptors[0], strengths[0], mask, self.max_features)


def exportable(method: str) -> Exportable:
    """What an ONNX file holds: image in, scores of pixels and four maps of features out; sides by 32."""
    return Exportable(
        network=Aliked(model=method).maps.cpu(),  # pyright: ignore[reportArgumentType]
        inputs={"image": torch.zeros(1, 3, 96, 128)},
        dynamic={"image": (2, 3)},
        outputs=("scores", "features1", "features2", "features3", "features4"),
    )
