"""The network of OnePose++: which points of a map an image shows, and where."""

from slimsfm.networks.onepose_plus.network import CoarseToFine, OnePosePlusMatcher, state_of

__all__ = ["CoarseToFine", "OnePosePlusMatcher", "state_of"]
