"""ALIKED [1] keypoints and descriptors, with the layers of kornia in an order that is faster on a CPU.

The first layer of the score head is linear and pointwise, so it runs before the maps are upsampled to the
size of the image. Deformable convolutions sample with one call instead of gathering four neighbors in turn.
Both change only the rounding.

References:
    [1] Zhao, Wu, Chen, Chen, Xu and Lee, ALIKED: A Lighter Keypoint and Descriptor Extraction Network via
        Deformable Transformation, TIM 2023.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from kornia.feature import ALIKED
from kornia.feature.aliked.aliked import DeformableConv2d
from torch import Tensor, nn

from slimsfm.arrays import GrayImage, Image
from slimsfm.features.base import Features
from slimsfm.methods.keypoints import check_sizes
from slimsfm.methods.tensors import features_of, network_input
from slimsfm.networks.loading import choose_device, inference, load_network
from slimsfm.networks.onnx import Exportable, Run, onnx_run

_STEP = 32  # pixels: the sides of the image must be multiples of it


class DenseMaps(NamedTuple):
    """Features and scores of each pixel of an image."""

    features: Float[Tensor, "1 d height width"]
    """Of unit length."""

    scores: Float[Tensor, "1 1 height width"]
    """From 0 to 1."""


class AlikedMaps(nn.Module):
    """Computes scores of pixels, and features at four resolutions."""

    def __init__(self, network: ALIKED) -> None:
        """Share the layers of a network, in the memory layout in which convolutions are fastest on a CPU."""
        super().__init__()
        for block in (network.block3, network.block4):
            block.conv1 = Deformable(block.conv1)  # pyright: ignore[reportArgumentType]
            block.conv2 = Deformable(block.conv2)  # pyright: ignore[reportArgumentType]
        self.network = network
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def forward(self, image: Float[Tensor, "1 3 height width"]) -> tuple[Tensor, ...]:
        """Run the convolutions on an RGB image from 0 to 1, whose sides are multiples of 32.

        Returns:
            Scores (1, 1, height, width) and four maps of features, the first of the image's size.
        """
        layers = self.network
        blocks = [layers.block1(image)]
        for pool, block in (
            (layers.pool2, layers.block2),
            (layers.pool4, layers.block3),
            (layers.pool4, layers.block4),
        ):
            blocks.append(block(pool(blocks[-1])))
        narrow = layers.conv1, layers.conv2, layers.conv3, layers.conv4
        maps = [layers.gate(conv(block)) for conv, block in zip(narrow, blocks, strict=True)]
        return self._scores(maps), *maps

    def _scores(self, maps: list[Tensor]) -> Tensor:
        head = self.network.score_head
        parts = head.get_parameter("0.weight").chunk(len(maps), dim=1)
        mixed = [F.conv2d(one, part) for one, part in zip(maps, parts, strict=True)]
        scores = sum((enlarged(one, maps[0]) for one in mixed[1:]), mixed[0])
        return head[1:](scores).sigmoid()


class Deformable(nn.Module):
    """A deformable 3x3 convolution: another convolution predicts where each pixel samples."""

    def __init__(self, layer: DeformableConv2d) -> None:
        """Share the weights of kornia's layer."""
        super().__init__()
        self.offset_conv, self.regular_conv = layer.offset_conv, layer.regular_conv

    def forward(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        """Sample around each pixel; zeros beyond the border."""
        height, width = features.shape[2:]
        limit = max(height, width) / 4
        offsets = self.offset_conv(features).float().clamp(-limit, limit)
        steps = torch.arange(-1.0, 2.0, device=features.device)
        rows = (
            torch.arange(height, device=features.device)[:, None] + steps.repeat_interleave(3)[:, None, None]
        )
        columns = torch.arange(width, device=features.device) + steps.repeat(3)[:, None, None]
        x = (2 * (offsets[:, 1::2] + columns) + 1) / width - 1
        y = (2 * (offsets[:, 0::2] + rows) + 1) / height - 1
        grid = torch.stack([x, y], dim=-1).flatten(1, 2)
        sampled = F.grid_sample(features.float(), grid, align_corners=False).unflatten(2, (9, -1))
        return F.conv2d(sampled.flatten(1, 2), self.regular_conv.weight.flatten(1)[:, :, None, None])


def dense_maps(run: Run, pixels: Float[Tensor, "1 3 height width"]) -> DenseMaps:
    """Compute scores and features of all pixels of an RGB image from 0 to 1, of any size.

    Args:
        run: `AlikedMaps`, or its ONNX export.
        pixels: The image; its border is repeated until the sides are multiples of 32.
    """
    height, width = pixels.shape[2:]
    more = -height % _STEP, -width % _STEP
    top, left = more[0] // 2, more[1] // 2
    padded = F.pad(pixels, (left, more[1] - left, top, more[0] - top), mode="replicate")
    scores, *maps = run(padded)
    inside = ..., slice(top, top + height), slice(left, left + width)
    return DenseMaps(features=_joined(maps)[inside], scores=scores[inside])


def _joined(maps: list[Tensor]) -> Float[Tensor, "1 d height width"]:
    """Join maps of several resolutions, the finest first, into features of unit length."""
    with torch.autocast(maps[0].device.type, enabled=False):
        single = [one.float().contiguous(memory_format=torch.channels_last) for one in maps]
        features = torch.cat([single[0], *(enlarged(one, single[0]) for one in single[1:])], dim=1)
        lengths = torch.einsum("bchw,bchw->bhw", features, features).sqrt_()
        return features.div_(lengths.clamp_(min=1e-12)[:, None])


def enlarged(features: Float[Tensor, "1 c h w"], like: Float[Tensor, "1 d height width"]) -> Tensor:
    """Interpolate features to the size of others; corner pixels coincide."""
    return F.interpolate(features, size=like.shape[2:], mode="bilinear", align_corners=True)


@dataclass(frozen=True, kw_only=True)
class Aliked:
    """Extracts ALIKED features."""

    model: Literal["aliked-n16", "aliked-t16"] = "aliked-n16"
    """The network: n16 is more accurate; t16 is twice as fast and has half as long descriptors."""

    max_features: int = 2048
    """Largest number of keypoints; those with the highest scores are kept."""

    max_image_size: int = 1024
    """Shrink larger images so that their longer side has this many pixels."""

    threshold: float = 0.2
    """Least score of a keypoint."""

    def __post_init__(self) -> None:
        check_sizes(self.max_features, self.max_image_size)
        if self.model not in ("aliked-n16", "aliked-t16"):
            raise ValueError(f"model must be aliked-n16 or aliked-t16, got {self.model!r}")
        if not 0 < self.threshold < 1:
            raise ValueError(f"threshold must be between 0 and 1, got {self.threshold}")

    @property
    def name(self) -> str:
        """Name of the extractor in a map's `map.json`."""
        return "aliked"

    @property
    def options(self) -> dict:
        """Options with which `load_extractor` creates an equal extractor."""
        return asdict(self)

    @cached_property
    def network(self) -> ALIKED:
        """The network with its trained weights."""
        made = ALIKED(self.model, self.max_features, self.threshold)
        return load_network(made, self.model, derived={"dkd.hw_grid"})

    @cached_property
    def maps(self) -> AlikedMaps:
        """The convolutional part of the network."""
        return AlikedMaps(self.network)

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:
        """Extract features; the mask has the size of the image, and no feature lies where it is 0."""
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
    """The convolutions: from an image with sides that are multiples of 32 to scores and four feature maps."""
    return Exportable(
        network=Aliked(model=method).maps.cpu(),  # pyright: ignore[reportArgumentType]
        inputs={"image": torch.zeros(1, 3, 96, 128)},
        dynamic={"image": (2, 3)},
        outputs=("scores", "features1", "features2", "features3", "features4"),
    )
