"""A residual network with a feature pyramid [1, 2]: a coarse feature every 8 pixels, a fine one every 2.

References:
    [1] He, Zhang, Ren and Sun, Deep Residual Learning for Image Recognition, CVPR 2016.
    [2] Lin, Dollár, Girshick, He, Hariharan and Belongie, Feature Pyramid Networks for Object Detection,
        CVPR 2017.
"""

import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor, nn

HALF, QUARTER, EIGHTH = 128, 196, 256
"""Channels at a half, a quarter and an eighth of the image's resolution."""


class Backbone(nn.Module):
    """Features of a gray image. Centres coincide: that of cell (c, r) is the centre of pixel (8 c, 8 r)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(1, HALF, kernel_size=7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(HALF)
        self.layer1 = nn.Sequential(Residual(HALF, HALF), Residual(HALF, HALF))
        self.layer2 = nn.Sequential(Residual(HALF, QUARTER, stride=2), Residual(QUARTER, QUARTER))
        self.layer3 = nn.Sequential(Residual(QUARTER, EIGHTH, stride=2), Residual(EIGHTH, EIGHTH))
        self.layer3_outconv = _conv1x1(EIGHTH, EIGHTH)
        self.layer2_outconv = _conv1x1(QUARTER, EIGHTH)
        self.layer2_outconv2 = _smoothing(EIGHTH, QUARTER)
        self.layer1_outconv = _conv1x1(HALF, QUARTER)
        self.layer1_outconv2 = _smoothing(QUARTER, HALF)

    def forward(
        self, image: Float[Tensor, "b 1 height width"]
    ) -> tuple[Float[Tensor, "b 256 h w"], Float[Tensor, "b 128 h4 w4"]]:
        """Coarse and fine features; the image's sides are multiples of 8."""
        half = self.layer1(F.relu(self.bn1(self.conv1(image))))
        quarter = self.layer2(half)
        eighth = self.layer3(quarter)
        coarse = self.layer3_outconv(eighth)
        medium = self.layer2_outconv2(self.layer2_outconv(quarter) + _doubled(coarse))
        fine = self.layer1_outconv2(self.layer1_outconv(half) + _doubled(medium))
        return coarse, fine


class Residual(nn.Module):
    """Two 3x3 convolutions, added to what they were given."""

    def __init__(self, channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = _conv3x3(channels, out_channels, stride)
        self.conv2 = _conv3x3(out_channels, out_channels)
        self.bn1 = nn.BatchNorm2d(out_channels)
        self.bn2 = nn.BatchNorm2d(out_channels)
        self.downsample = (
            nn.Identity()
            if stride == 1
            else nn.Sequential(_conv1x1(channels, out_channels, stride), nn.BatchNorm2d(out_channels))
        )

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        """Features of a resolution lower by the stride."""
        change = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(self.downsample(x) + change)


def _smoothing(channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(
        _conv3x3(channels, channels),
        nn.BatchNorm2d(channels),
        nn.LeakyReLU(),
        _conv3x3(channels, out_channels),
    )


def _conv1x1(channels: int, out_channels: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(channels, out_channels, kernel_size=1, stride=stride, bias=False)


def _conv3x3(channels: int, out_channels: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(channels, out_channels, kernel_size=3, stride=stride, padding=1, bias=False)


def _doubled(features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h2 w2"]:
    return F.interpolate(features, scale_factor=2.0, mode="bilinear", align_corners=True)
