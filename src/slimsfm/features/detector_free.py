"""What stands for an extractor where images are matched as wholes."""

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from slimsfm.arrays import GrayImage, Image
from slimsfm.features.base import Features


@dataclass(frozen=True, kw_only=True)
class DetectorFree:
    """Finds no keypoint: whoever matches looks at the image itself."""

    max_image_size: int = 640
    """Longer side in pixels to which images are shrunk before they are matched."""

    weights: Literal["loftr", "loftr-onepose++"] = "loftr"
    """What matches them: LoFTR's own, or those by which OnePose++ builds its maps and which it needs."""

    @property
    def name(self) -> str:
        """The name under which a map remembers its extractor."""
        return "loftr"

    @property
    def options(self) -> dict:
        """What `load_extractor` needs to make an equal extractor."""
        return asdict(self)

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:  # noqa: ARG002
        """No features, of an image of this size."""
        return Features(
            keypoints=np.zeros((0, 2), np.float32),
            descriptors=np.zeros((0, 0), np.float32),
            scores=np.zeros(0, np.float32),
            image_size=(image.shape[1], image.shape[0]),
        )
