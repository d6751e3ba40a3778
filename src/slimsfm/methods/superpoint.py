"""SuperPoint [1] keypoints and descriptors, with the layers of transformers and the authors' weights.

Positions in the network are pixels (x, y) with the center of the top-left pixel at (0, 0); a cell is 8 x 8
pixels.

References:
    [1] DeTone, Malisiewicz and Rabinovich, SuperPoint: Self-Supervised Interest Point Detection and
        Description, CVPR Workshops 2018.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float, Int64
from torch import Tensor, nn
from transformers import SuperPointConfig, SuperPointForKeypointDetection
from transformers.models.superpoint.modeling_superpoint import simple_nms

from slimsfm.arrays import GrayImage, Image
from slimsfm.features.base import Features
from slimsfm.methods.keypoints import check_sizes
from slimsfm.methods.tensors import features_of, network_input
from slimsfm.networks.loading import choose_device, inference, load_network
from slimsfm.networks.onnx import Exportable, onnx_run

_CELL = 8  # pixels
_BORDER = 4  # pixels along the border without keypoints, as the authors do it; transformers forgets two sides


class SuperPointMaps(nn.Module):
    """The convolutional part: scores of pixels and descriptors of cells."""

    def __init__(self, network: SuperPointForKeypointDetection) -> None:
        """Share the layers of a network, in the memory layout in which convolutions are fastest on a CPU."""
        super().__init__()
        self.network = network
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def forward(self, gray: Float[Tensor, "1 1 height width"]) -> tuple[Tensor, Tensor]:
        """Run the convolutions on a gray image from 0 to 1; beyond the last whole cell nothing is seen.

        Returns:
            Scores (1, 1, 8 h, 8 w) of pixels, from 0 to 1, and descriptors (1, d, h, w) of cells.
        """
        layers = self.network
        encoded = layers.encoder(gray, return_dict=False)[0]
        scored, described = layers.keypoint_decoder, layers.descriptor_decoder
        cells = scored.conv_score_b(F.relu(scored.conv_score_a(encoded))).softmax(dim=1)[:, :-1]
        descriptors = described.conv_descriptor_b(F.relu(described.conv_descriptor_a(encoded)))
        return F.pixel_shuffle(cells, _CELL), F.normalize(descriptors, dim=1)


def strongest_pixels(
    scores: Float[Tensor, "1 1 height width"], radius: int, threshold: float
) -> tuple[Int64[Tensor, "n 2"], Float[Tensor, " n"]]:
    """Local maxima of the score above a threshold, row by row, and their scores."""
    best = simple_nms(scores[0], radius)[0]
    rows, columns = torch.nonzero(best > threshold).T
    height, width = best.shape
    inside = (rows >= _BORDER) & (rows < height - _BORDER)
    inside &= (columns >= _BORDER) & (columns < width - _BORDER)
    rows, columns = rows[inside], columns[inside]
    return torch.stack([columns, rows], dim=1), best[rows, columns]


def describe_pixels(
    descriptors: Float[Tensor, "1 d h w"], pixels: Int64[Tensor, "n 2"]
) -> Float[Tensor, "n d"]:
    """Interpolate the descriptors of cells at pixels, scaled to unit length.

    As in training, the center of the top-left cell is where it should be, while the far end is short by one
    pixel more than half a cell.
    """
    height, width = (_CELL * side for side in descriptors.shape[2:])
    far = torch.tensor([width, height], device=pixels.device) - (_CELL / 2 + 0.5)
    grid = 2 * (pixels - (_CELL / 2 - 0.5)) / far - 1
    sampled = F.grid_sample(descriptors.float(), grid[None, None], align_corners=True)
    return F.normalize(sampled[0, :, 0].T, dim=1)


_GRAY = (0.299, 0.587, 0.114)  # weights of red, green and blue

# The authors' names of the layers, and those of transformers.
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
    """Largest number of keypoints; those with the highest scores are kept."""

    max_image_size: int = 1024
    """Shrink larger images so that their longer side has this many pixels."""

    nms_radius: int = 4
    """Pixels around a keypoint in which there is no other."""

    threshold: float = 0.005
    """Least score of a keypoint."""

    def __post_init__(self) -> None:
        check_sizes(self.max_features, self.max_image_size)
        if self.nms_radius < 0:
            raise ValueError(f"nms_radius must not be negative, got {self.nms_radius}")
        if not 0 < self.threshold < 1:
            raise ValueError(f"threshold must be between 0 and 1, got {self.threshold}")

    @property
    def name(self) -> str:
        """Name of the extractor in a map's `map.json`."""
        return "superpoint"

    @property
    def options(self) -> dict:
        """Options with which `load_extractor` creates an equal extractor."""
        return asdict(self)

    @cached_property
    def maps(self) -> SuperPointMaps:
        """The convolutional part of the network, with its trained weights."""
        made = SuperPointForKeypointDetection(SuperPointConfig())
        return SuperPointMaps(load_network(made, "superpoint", superpoint_state))

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:
        """Extract features; the mask has the size of the image, and no feature lies where it is 0."""
        taken = network_input(image, self.max_image_size, choose_device())
        gray = torch.einsum("bchw,c->bhw", taken.pixels, taken.pixels.new_tensor(_GRAY))[:, None]
        with torch.inference_mode(), inference(gray.device):
            scores, descriptors = (onnx_run("superpoint") or self.maps)(gray)
            pixels, strengths = strongest_pixels(scores, self.nms_radius, self.threshold)
            described = describe_pixels(descriptors, pixels)
        return features_of(taken, pixels.to(torch.float32), described, strengths, mask, self.max_features)


def exportable(_method: str) -> Exportable:
    """The convolutions: from a gray image to scores of pixels and descriptors of cells."""
    return Exportable(
        network=SuperPoint().maps.cpu(),
        inputs={"gray": torch.zeros(1, 1, 96, 128)},
        dynamic={"gray": (2, 3)},
        outputs=("scores", "descriptors"),
    )


def superpoint_state(checkpoint: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Convert the authors' state dict to that of transformers; the latter is returned unchanged."""
    if not any(key.startswith("conv1a.") for key in checkpoint):
        return dict(checkpoint)
    parts = {key: key.rpartition(".") for key in checkpoint}
    return {f"{_LAYERS[parts[key][0]]}.{parts[key][2]}": value for key, value in checkpoint.items()}
