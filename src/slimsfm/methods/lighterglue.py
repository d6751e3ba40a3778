"""LighterGlue [1]: LightGlue with 6 layers, one head and 96 values per keypoint, for XFeat.

References:
    [1] Potje, Cadar, Araujo, Martins and Nascimento, XFeat: Accelerated Features for Lightweight Image
        Matching, CVPR 2024; https://github.com/verlab/accelerated_features.
"""

from slimsfm.methods.lightglue import LightGlue, exportable_network
from slimsfm.networks.onnx import Exportable


class LighterGlue(LightGlue):
    """Matches the XFeat features of two images by attention between them."""

    def __init__(self, features: str) -> None:
        """Create a matcher for the features of XFeat."""
        if features != "xfeat":
            raise ValueError(f"features must be xfeat, got {features!r}")
        self._features, self._weights = features, "lighterglue"


def exportable(_method: str) -> Exportable:
    """The whole network: from the keypoints of two images to the match of each of the first, or -1."""
    return exportable_network(LighterGlue("xfeat").network.cpu())
