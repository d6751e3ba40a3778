"""The stages of LoFTR [1]: coarse matches on a grid, refinement in windows, features of positions.

The convolutions and transformers are kornia's. Positions are pixels (x, y) of the network's input, with the
center of the top-left pixel at (0, 0): cell (c, r) is at (8 c, 8 r), fine cell (c, r) at (2 c, 2 r). Cells
are numbered row by row.

References:
    [1] Sun, Shen, Wang, Bao and Zhou, LoFTR: Detector-Free Local Feature Matching with Transformers,
        CVPR 2021.
"""

from copy import deepcopy
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Int64
from kornia.feature import LoFTR
from kornia.feature.loftr.loftr import default_cfg
from torch import Tensor

CELL, FINE_CELL = 8, 2  # pixels
_TEMPERATURE = 0.1  # of the dual softmax
_BORDER = 2  # unmatched cells along the border
_BLOCK = 512  # windows aligned per batch


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureMaps:
    """Output of the convolutions for one image."""

    coarse: Float[Tensor, "1 c h w"]
    """One feature per cell, without positional encoding."""

    fine: Float[Tensor, "1 f h4 w4"]
    """One feature per fine cell."""


class Tokens(NamedTuple):
    """Coarse features of two images after attention within and between them, one row per cell."""

    one: Float[Tensor, "1 n c"]
    other: Float[Tensor, "1 m c"]


@dataclass(frozen=True, kw_only=True, eq=False)
class CellMatches:
    """Matching cells of two images, by decreasing confidence."""

    cells1: Int64[Tensor, " k"]
    """Cells of the first image."""

    cells2: Int64[Tensor, " k"]
    """Matching cells of the second image."""

    scores: Float[Tensor, " k"]
    """Confidence of each match."""


def make_network(*, window: int, coarse_context: bool) -> LoFTR:
    """Create the untrained network.

    Args:
        window: Fine cells along a side of a window.
        coarse_context: Whether the coarse feature of its cell is added to each window.
    """
    config = deepcopy(default_cfg)
    config.update(fine_window_size=window, fine_concat_coarse_feat=coarse_context)
    return LoFTR(pretrained=None, config=config)


def feature_maps(network: LoFTR, gray: Float[Tensor, "1 1 height width"]) -> FeatureMaps:
    """Run the convolutions on a gray image, from 0 to 1, whose sides are multiples of 8."""
    coarse, fine = network.backbone(gray)
    return FeatureMaps(coarse=coarse, fine=fine)


def coarse_map(network: LoFTR, gray: Float[Tensor, "1 1 height width"]) -> Float[Tensor, "1 c h w"]:
    """Compute the coarse features only, at half the cost."""
    layers = network.backbone
    features = layers.relu(layers.bn1(layers.conv1(gray)))
    return layers.layer3_outconv(layers.layer3(layers.layer2(layers.layer1(features))))


def coarse_tokens(
    network: LoFTR, coarse1: Float[Tensor, "1 c h1 w1"], coarse2: Float[Tensor, "1 c h2 w2"]
) -> Tokens:
    """Add positional encodings, and let cells attend to their own image and to the other."""
    tokens = (network.pos_encoding(coarse).flatten(2).transpose(1, 2) for coarse in (coarse1, coarse2))
    return Tokens(*network.loftr_coarse(*tokens))


def confidences(tokens: Tokens) -> Float[Tensor, "n m"]:
    """Confidence that cell i of one image matches cell j of the other, by dual softmax."""
    one, other = (features[0].float() / features.shape[2] ** 0.5 for features in tokens)
    with torch.autocast(one.device.type, enabled=False):  # in half precision, many would be equal
        similarities = one @ other.T / _TEMPERATURE
    return similarities.softmax(dim=0) * similarities.softmax(dim=1)


def match_cells(
    tokens: Tokens, inside1: Bool[Tensor, " n"], inside2: Bool[Tensor, " m"], threshold: float
) -> CellMatches:
    """Mutual nearest neighbors inside both images whose confidence exceeds a threshold."""
    sure = confidences(tokens)
    best, cells2 = sure.max(dim=1)
    is_mutual = sure.argmax(dim=0)[cells2] == torch.arange(len(best), device=best.device)
    cells1 = torch.nonzero(is_mutual & inside1 & inside2[cells2] & (best > threshold)).squeeze(1)
    cells1 = cells1[torch.argsort(best[cells1], descending=True, stable=True)]
    return CellMatches(cells1=cells1, cells2=cells2[cells1], scores=best[cells1])


def interior(coarse: Float[Tensor, "1 c h w"]) -> Bool[Tensor, " n"]:
    """Mask of the cells away from the border, where the context would be too small."""
    height, width = coarse.shape[2:]
    inside = torch.zeros(height, width, dtype=torch.bool, device=coarse.device)
    inside[_BORDER : height - _BORDER, _BORDER : width - _BORDER] = True
    return inside.flatten()


def cell_positions(cells: Int64[Tensor, " k"], coarse: Float[Tensor, "1 c h w"]) -> Float[Tensor, "k 2"]:
    """Positions of cells."""
    width = coarse.shape[3]
    return CELL * torch.stack([cells % width, cells // width], dim=1).float()


def align(
    network: LoFTR,
    one: FeatureMaps,
    other: FeatureMaps,
    positions1: Float[Tensor, "k 2"],
    positions2: Float[Tensor, "k 2"],
    tokens: Tokens | None,
) -> Float[Tensor, "k 2"]:
    """Refine positions in the other image so that they match positions in the one image.

    The result is the expected position under a softmax over the similarities between the center of the one
    window and each fine cell of the other, at most half a window away. On the grid of fine cells this is
    LoFTR's fine stage; an offset from the grid in the one image is added in the other.

    Args:
        network: The network.
        one: The first image.
        other: The second image.
        positions1: Positions in the first image.
        positions2: Approximate positions in the second image.
        tokens: Coarse features of both images, for a network with coarse context.
    """
    blocks = zip(positions1.split(_BLOCK), positions2.split(_BLOCK), strict=True)
    found = [_align_block(network, one, other, tokens, *block) for block in blocks]
    return torch.cat(found) if found else positions2


def _align_block(
    network: LoFTR,
    one: FeatureMaps,
    other: FeatureMaps,
    tokens: Tokens | None,
    positions1: Float[Tensor, "k 2"],
    positions2: Float[Tensor, "k 2"],
) -> Float[Tensor, "k 2"]:
    if not len(positions1):
        return positions2
    size = network.config["fine_window_size"]
    fine1, fine2 = _nearest(one.fine, positions1, FINE_CELL), _nearest(other.fine, positions2, FINE_CELL)
    windows = torch.cat([_windows(one.fine, fine1, size), _windows(other.fine, fine2, size)])
    if tokens is not None:
        cells1, cells2 = _nearest(one.coarse, positions1, CELL), _nearest(other.coarse, positions2, CELL)
        context = [_at(tokens.one, cells1, one.coarse), _at(tokens.other, cells2, other.coarse)]
        windows = _with_context(network, windows, torch.cat(context))
    window1, window2 = network.loftr_fine(*windows.chunk(2))
    similarities = torch.einsum("kf,kwf->kw", window1[:, size * size // 2], window2).float()
    heat = (similarities / window1.shape[2] ** 0.5).softmax(dim=1).unflatten(1, (size, size))
    across_and_down = torch.stack([heat.sum(dim=1), heat.sum(dim=2)], dim=1)
    offsets = torch.arange(size, device=heat.device, dtype=heat.dtype) - size // 2
    shift = (across_and_down * offsets).sum(dim=2)
    return FINE_CELL * (fine2 + shift) + (positions1 - FINE_CELL * fine1)


def _nearest(
    features: Float[Tensor, "1 f h w"], positions: Float[Tensor, "k 2"], stride: int
) -> Int64[Tensor, "k 2"]:
    """Column and row of the feature nearest to each position."""
    limits = torch.tensor(features.shape[:1:-1], device=positions.device) - 1
    return torch.minimum((positions / stride).round().long().clamp(min=0), limits)


def _windows(
    features: Float[Tensor, "1 f h w"], centers: Int64[Tensor, "k 2"], size: int
) -> Float[Tensor, "k ww f"]:
    """Features around given cells, row by row; zeros beyond the border."""
    padded = F.pad(features[0], [size // 2] * 4).permute(1, 2, 0)
    steps = torch.arange(size, device=centers.device)
    rows, columns = centers[:, 1, None] + steps, centers[:, 0, None] + steps
    return padded[rows[:, :, None], columns[:, None, :]].flatten(1, 2)


def _at(
    tokens: Float[Tensor, "1 n c"], cells: Int64[Tensor, "k 2"], coarse: Float[Tensor, "1 c h w"]
) -> Float[Tensor, "k c"]:
    return tokens[0, cells[:, 1] * coarse.shape[3] + cells[:, 0]]


def _with_context(
    network: LoFTR, windows: Float[Tensor, "k ww f"], context: Float[Tensor, "k c"]
) -> Float[Tensor, "k ww f"]:
    """Add the coarse feature of its cell to each window."""
    layers = network.fine_preprocess
    coarse = layers.down_proj(context)[:, None].expand_as(windows)
    return layers.merge_feat(torch.cat([windows, coarse], dim=2))


def sample(maps: FeatureMaps, positions: Float[Tensor, "k 2"]) -> Float[Tensor, "k d"]:
    """Features of positions: the nearest coarse feature and the interpolated fine feature.

    As in OnePose++ [1], they come from the convolutions, before any transformer. Positions are also sampled
    as in the training of its network: the corners of the image are aligned with those of the feature map, the
    center of the top-left pixel is at (0.5, 0.5), and positions at the far border are almost a cell short.

    References:
        [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation
            without CAD Models, NeurIPS 2022.
    """
    height, width = (CELL * side for side in maps.coarse.shape[2:])
    far = torch.tensor([width - 1, height - 1], device=positions.device)
    grid = (2 * (positions + 0.5) / far - 1).clamp(-1, 1)[None, :, None]
    parts = [
        F.grid_sample(features.float(), grid, mode=mode, align_corners=True)[0, :, :, 0].T
        for features, mode in ((maps.coarse, "nearest"), (maps.fine, "bilinear"))
    ]
    return torch.cat(parts, dim=1)
