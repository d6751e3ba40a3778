"""The stages of SuperPoint [1]: what sees the image, which pixels are keypoints, what describes them.

The convolutions are those of transformers. Positions are pixels (x, y) of what the network sees, the centre
of the top-left pixel at (0, 0); a cell is 8 x 8 pixels.

References:
    [1] DeTone, Malisiewicz and Rabinovich, SuperPoint: Self-Supervised Interest Point Detection and
        Description, CVPR Workshops 2018.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float, Int64
from torch import Tensor, nn
from transformers import SuperPointForKeypointDetection
from transformers.models.superpoint.modeling_superpoint import simple_nms

_CELL = 8  # pixels
_BORDER = 4  # pixels of the rim without keypoints, as the authors have it; the library forgets two sides


class SuperPointMaps(nn.Module):
    """What sees the image: scores of pixels, descriptors of cells."""

    def __init__(self, network: SuperPointForKeypointDetection) -> None:
        """Of a network; its layers are shared, and laid out as convolutions on the CPU are fastest."""
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
    """Pixels that score best within a radius and more than a threshold, row by row, and their scores."""
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
    """Descriptors of pixels, of unit length, interpolated between those of cells.

    As the network was trained: the middle of the top-left cell is where it should be, while one pixel more
    than half a cell is taken off at the far end.
    """
    height, width = (_CELL * side for side in descriptors.shape[2:])
    far = torch.tensor([width, height], device=pixels.device) - (_CELL / 2 + 0.5)
    grid = 2 * (pixels - (_CELL / 2 - 0.5)) / far - 1
    sampled = F.grid_sample(descriptors.float(), grid[None, None], align_corners=True)
    return F.normalize(sampled[0, :, 0].T, dim=1)
