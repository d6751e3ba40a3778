"""Data sets on disk: one layout a file."""

from slimsfm.datasets.base import Dataset
from slimsfm.datasets.bop import Bop
from slimsfm.datasets.colmap import Colmap
from slimsfm.datasets.images import Images
from slimsfm.datasets.linemod import Linemod
from slimsfm.datasets.onepose import OnePose
from slimsfm.datasets.onepose_lowtexture import OnePoseLowTexture
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
"""The data sets by the names that the command line has for them."""
