"""LoFTR [1]: matches two images without keypoints, with the network of kornia.

References:
    [1] Sun, Shen, Wang, Bao and Zhou, LoFTR: Detector-Free Local Feature Matching with Transformers,
        CVPR 2021.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from threading import local
from typing import Literal

import cv2
import kornia.feature
import numpy as np
import torch
from jaxtyping import Float, Float16, Float64, UInt8
from torch import Tensor

from slimsfm.arrays import GrayImage, Points2D
from slimsfm.methods.loftr.cells import AnyImage, ImageMatches
from slimsfm.methods.loftr.network import (
    CELL,
    FeatureMaps,
    Tokens,
    align,
    cell_positions,
    coarse_map,
    coarse_tokens,
    feature_maps,
    interior,
    make_network,
    match_cells,
    sample,
)
from slimsfm.networks.loading import choose_device, inference, load_network, matcher_state


@dataclass(frozen=True, kw_only=True, eq=False)
class LoftrImage:
    """An encoded image."""

    coarse: Float[Tensor, "1 c h w"]
    """One feature per cell."""

    fine: Float[Tensor, "1 f h4 w4"] | None
    """One feature per fine cell; None if only cells are matched."""

    image_size: tuple[int, int]
    """Width and height of the image in pixels."""

    @property
    def maps(self) -> FeatureMaps:
        """All features.

        Raises:
            ValueError: The image was encoded with `cells_only`.
        """
        if self.fine is None:
            raise ValueError("the image must be encoded whole, not with cells_only")
        return FeatureMaps(coarse=self.coarse, fine=self.fine)

    @property
    def factors(self) -> Float64[np.ndarray, "2"]:
        """Factors (x, y) from pixels of the network's input to pixels of the image."""
        height, width = self.coarse.shape[2:]
        return np.array(self.image_size) / (CELL * width, CELL * height)

    @property
    def cell_px(self) -> float:
        """Side of a cell in pixels of the image; the longer one if they differ."""
        return CELL * float(self.factors.max())

    def pixels(self, positions: Float[Tensor, "k 2"]) -> Points2D:
        """Convert positions in the network, which count from pixel centers, to pixels of the image."""
        return (positions.double().cpu().numpy() + 0.5) * self.factors

    def positions(self, points2D: Points2D) -> Float[Tensor, "k 2"]:
        """Inverse of `pixels`."""
        return torch.from_numpy(points2D / self.factors - 0.5).float().to(self.coarse.device)


@dataclass(frozen=True, kw_only=True)
class Loftr:
    """Matches images by LoFTR."""

    weights: Literal["loftr", "loftr-onepose++"] = "loftr"
    """LoFTR's own weights for outdoor scenes, or those with which OnePose++ builds its maps."""

    max_image_size: int = 640
    """Shrink larger images to a longer side of this many pixels; both sides become multiples of 8."""

    threshold: float = 0.2
    """Least confidence of a match."""

    def __post_init__(self) -> None:
        if self.weights not in ("loftr", "loftr-onepose++"):
            raise ValueError(f"weights must be loftr or loftr-onepose++, got {self.weights!r}")
        if self.max_image_size < 64:
            raise ValueError(f"max_image_size must be at least 64, got {self.max_image_size}")
        if not 0 <= self.threshold < 1:
            raise ValueError(f"threshold must be at least 0 and below 1, got {self.threshold}")

    @property
    def name(self) -> str:
        """Name of the extractor in a map's `map.json`."""
        return "loftr"

    @property
    def options(self) -> dict:
        """Keyword arguments that create an equal matcher."""
        return asdict(self)

    @cached_property
    def network(self) -> kornia.feature.LoFTR:
        """The network with its trained weights."""
        is_plain = self.weights == "loftr"
        made = make_network(window=5 if is_plain else 9, coarse_context=is_plain)
        loaded = load_network(made, self.weights, matcher_state)
        # A quarter faster on a CPU.
        loaded.backbone.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        return loaded

    @cached_property
    def _last(self) -> local:
        return local()

    def encode(self, image: AnyImage, *, cells_only: bool = False) -> LoftrImage:
        """Run the convolutions on one image.

        Args:
            image: The image.
            cells_only: Encode for `match_cells` only, in half the time and a ninth of the memory.
        """
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
        small = torch.from_numpy(_shrink(np.asarray(gray, np.uint8), self.max_image_size))
        pixels = small.to(choose_device(), torch.float32)[None, None] / 255
        size = image.shape[1], image.shape[0]
        with torch.inference_mode(), inference(pixels.device):
            if cells_only:
                return LoftrImage(coarse=coarse_map(self.network, pixels), fine=None, image_size=size)
            maps = feature_maps(self.network, pixels)
        return LoftrImage(coarse=maps.coarse, fine=maps.fine, image_size=size)

    def match_images(self, image1: AnyImage, image2: AnyImage) -> ImageMatches:
        """Match cells of the first image with refined pixels of the second."""
        return self.match(self.encode(image1), self.encode(image2))

    def match(self, one: LoftrImage, other: LoftrImage) -> ImageMatches:
        """Match cells of the first image with refined pixels of the second."""
        rough = self.match_cells(one, other)
        exact = self.align(one, other, rough.points2D_1, rough.points2D_2)
        return ImageMatches(points2D_1=rough.points2D_1, points2D_2=exact, scores=rough.scores)

    def match_cells(self, one: LoftrImage, other: LoftrImage) -> ImageMatches:
        """Match cells of two images; a cell always has the same pixels and occurs at most once."""
        with torch.inference_mode(), inference(one.coarse.device):
            tokens = self._tokens(one, other)
            found = match_cells(tokens, interior(one.coarse), interior(other.coarse), self.threshold)
        return ImageMatches(
            points2D_1=one.pixels(cell_positions(found.cells1, one.coarse)),
            points2D_2=other.pixels(cell_positions(found.cells2, other.coarse)),
            scores=found.scores.float().cpu().numpy(),
        )

    def align(
        self, one: LoftrImage, other: LoftrImage, points2D_1: Points2D, points2D_2: Points2D
    ) -> Points2D:
        """Refine pixels of the second image so that they match pixels of the first.

        Args:
            one: The first image.
            other: The second image.
            points2D_1: Pixels of the first image.
            points2D_2: Approximate matches in the second image, within half a cell.
        """
        positions = one.positions(points2D_1), other.positions(points2D_2)
        with torch.inference_mode(), inference(one.coarse.device):
            tokens = self._tokens(one, other) if self.weights == "loftr" else None
            return other.pixels(align(self.network, one.maps, other.maps, *positions, tokens))

    def _tokens(self, one: LoftrImage, other: LoftrImage) -> Tokens:
        """Coarse features of a pair. The last ones are kept, because `align` follows `match_cells`."""
        last = getattr(self._last, "pair", None)
        if last is None or last[0] is not one or last[1] is not other:
            tokens = coarse_tokens(self.network, one.coarse, other.coarse)
            last = self._last.pair = (one, other, tokens)
        return last[2]

    def describe(self, one: LoftrImage, points2D: Points2D) -> Float16[np.ndarray, "n 384"]:
        """Coarse (256) and fine (128) features of pixels, as in the maps of OnePose++."""
        with torch.inference_mode():
            return sample(one.maps, one.positions(points2D)).half().cpu().numpy()


def _shrink(gray: GrayImage, max_image_size: int) -> UInt8[np.ndarray, "h w"]:
    """Resize an image to sides that are multiples of 8, the longer at most `max_image_size`."""
    height, width = gray.shape
    scale = min(1.0, max_image_size / max(height, width))
    size = [max(CELL, round(side * scale) // CELL * CELL) for side in (width, height)]
    if size == [width, height]:
        return gray
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)
