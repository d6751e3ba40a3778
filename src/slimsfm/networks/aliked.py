"""What of ALIKED [1] sees the image, from the layers of kornia, in an order that costs a CPU less.

The scores' first layer is linear and does not look around, so that it runs before the maps are enlarged to
the image's size; deformable convolutions sample with one call instead of gathering four neighbours in turn.
Both change nothing but the rounding.

References:
    [1] Zhao, Wu, Chen, Chen, Xu and Lee, ALIKED: A Lighter Keypoint and Descriptor Extraction Network via
        Deformable Transformation, TIM 2023.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from kornia.feature import ALIKED
from kornia.feature.aliked.aliked import DeformableConv2d
from torch import Tensor, nn

from slimsfm.networks.onnx import Run

_STEP = 32  # pixels: what the image's sides must be multiples of


class DenseMaps(NamedTuple):
    """What ALIKED makes of an image, for each of its pixels."""

    features: Float[Tensor, "1 d height width"]
    """Of unit length."""

    scores: Float[Tensor, "1 1 height width"]
    """From 0 to 1."""


class AlikedMaps(nn.Module):
    """Scores of pixels, and features in four resolutions."""

    def __init__(self, network: ALIKED) -> None:
        """Of a network; its layers are shared, and laid out as convolutions on the CPU are fastest."""
        super().__init__()
        for block in (network.block3, network.block4):
            block.conv1 = Deformable(block.conv1)  # pyright: ignore[reportArgumentType]
            block.conv2 = Deformable(block.conv2)  # pyright: ignore[reportArgumentType]
        self.network = network
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def forward(self, image: Float[Tensor, "1 3 height width"]) -> tuple[Tensor, ...]:
        """Run the convolutions on an RGB image, from 0 to 1, whose sides are multiples of 32.

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
    """A deformable convolution of 3 x 3 that looks where another convolution tells each pixel to."""

    def __init__(self, layer: DeformableConv2d) -> None:
        """Of a layer of the library, whose weights are shared."""
        super().__init__()
        self.offset_conv, self.regular_conv = layer.offset_conv, layer.regular_conv

    def forward(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        """Sample around each pixel; zeros beyond the rim."""
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
    """Scores and features of all pixels of an RGB image from 0 to 1, of any size.

    Args:
        run: `AlikedMaps`, or what stands for it.
        pixels: The image; its rim is repeated until its sides are what the network can take.
    """
    height, width = pixels.shape[2:]
    more = -height % _STEP, -width % _STEP
    top, left = more[0] // 2, more[1] // 2
    padded = F.pad(pixels, (left, more[1] - left, top, more[0] - top), mode="replicate")
    scores, *maps = run(padded)
    inside = ..., slice(top, top + height), slice(left, left + width)
    return DenseMaps(features=_joined(maps)[inside], scores=scores[inside])


def _joined(maps: list[Tensor]) -> Float[Tensor, "1 d height width"]:
    """Features of unit length from maps of several resolutions, the finest of which comes first."""
    with torch.autocast(maps[0].device.type, enabled=False):
        single = [one.float().contiguous(memory_format=torch.channels_last) for one in maps]
        features = torch.cat([single[0], *(enlarged(one, single[0]) for one in single[1:])], dim=1)
        lengths = torch.einsum("bchw,bchw->bhw", features, features).sqrt_()
        return features.div_(lengths.clamp_(min=1e-12)[:, None])


def enlarged(features: Float[Tensor, "1 c h w"], like: Float[Tensor, "1 d height width"]) -> Tensor:
    """Interpolate features to the size of others, corner pixel on corner pixel."""
    return F.interpolate(features, size=like.shape[2:], mode="bilinear", align_corners=True)
