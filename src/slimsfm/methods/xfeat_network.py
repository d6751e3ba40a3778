"""The network of XFeat in PyTorch, with the layers of kornia."""

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from kornia.feature import XFeatModel
from kornia.feature.xfeat import BasicLayer
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from slimsfm.networks.loading import choose_device, inference, load_network
from slimsfm.networks.onnx import Exportable
from slimsfm.networks.onnx_files import ArrayRun

_CELL = 8  # pixels


class XFeatMaps(nn.Module):
    """Computes scores of pixels, and reliability and descriptors of cells of 8 x 8 pixels."""

    def __init__(self, network: XFeatModel) -> None:
        """Take the layers of a network, and change them to faster ones that differ only by rounding."""
        super().__init__()
        for block in network.modules():
            if isinstance(block, BasicLayer):
                convolution, norm, relu = block.layer
                fused = fuse_conv_bn_eval(convolution, norm)  # pyright: ignore[reportArgumentType]
                block.layer = nn.Sequential(fused, relu)
        self.network = network
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def forward(
        self, gray: Float[Tensor, "1 1 height width"]
    ) -> tuple[Float[Tensor, "1 height width"], Float[Tensor, "1 h w"], Float[Tensor, "1 h w d"]]:
        """Run the network on a gray image whose sides are multiples of 32.

        Returns:
            Scores of pixels, and reliability and descriptors of unit length of cells.
        """
        features, logits, reliability = self.network(gray)
        cells = logits.softmax(dim=1)[:, :-1]  # the last one says that no pixel is a keypoint
        descriptors = F.normalize(features.permute(0, 2, 3, 1), dim=-1)
        return F.pixel_shuffle(cells, _CELL)[:, 0], reliability[:, 0], descriptors


def load_maps() -> ArrayRun:
    """The network with its trained weights, from an array to arrays."""
    maps, device = _trained(), choose_device()

    def run(gray: np.ndarray) -> tuple[np.ndarray, ...]:
        with torch.inference_mode(), inference(device):
            found = maps(torch.from_numpy(gray).to(device))
        return tuple(one.to("cpu", torch.float32).contiguous().numpy() for one in found)

    return run


def _trained() -> XFeatMaps:
    return XFeatMaps(load_network(XFeatModel(), "xfeat"))


def exportable(_method: str) -> Exportable:
    """The network: from a gray image with sides that are multiples of 32 to maps of pixels and cells."""
    return Exportable(
        network=_trained().cpu(),
        inputs={"image": torch.zeros(1, 1, 96, 128)},
        dynamic={"image": (2, 3)},
        outputs=("scores", "reliability", "descriptors"),
    )
