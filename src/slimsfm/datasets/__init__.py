"""Data sets on disk, in their published layouts."""

from slimsfm.datasets.base import Dataset
from slimsfm.datasets.bop import Bop
from slimsfm.datasets.linemod import Linemod
from slimsfm.datasets.onepose import OnePose, OnePoseLowTexture
from slimsfm.datasets.reconstructed import Colmap, Images
from slimsfm.datasets.synthetic import Synthetic

DATASETS: dict[str, type[Dataset]] = {
    "onepose": OnePose,
    "onepose-lowtexture": OnePoseLowTexture,
    "linemod": Linemod,
    "bop": Bop,
    "colmap": Colmap,
    "images": Images,
    "synthetic": Synthetic,
}
"""Data sets by their names on the command line."""
