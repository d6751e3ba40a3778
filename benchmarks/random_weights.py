"""Write weight files with the published names and layouts, filled with seeded random numbers.

They show that methods run, how long they take and what reducing a map saves. Their results are meaningless,
so they say nothing about accuracy. ALIKED and XFeat are left out, because they are checked by checksum.

    python benchmarks/random_weights.py -o WEIGHTS
"""

import argparse
from pathlib import Path

import torch
from kornia.feature import DISK
from torch import nn
from transformers import (
    SuperGlueConfig,
    SuperGlueForKeypointMatching,
    SuperPointConfig,
    SuperPointForKeypointDetection,
)

from slimsfm.methods.lightglue import KNOWN, network_for
from slimsfm.methods.loftr.network import make_network
from slimsfm.methods.onepose.network import GraphAttentionMatcher
from slimsfm.methods.onepose_plus.network import OnePosePlusMatcher


def write_random_weights(folder: Path, seed: int = 0) -> Path:
    """Write a file for every method except ALIKED and XFeat."""
    torch.manual_seed(seed)
    superglue = SuperGlueForKeypointMatching(SuperGlueConfig())
    states = {
        "depth-save.pth": {"extractor": _state(DISK())},
        "superpoint_v1.pth": _state(SuperPointForKeypointDetection(SuperPointConfig())),
        "superglue_outdoor.pth": _state(superglue),
        **{f"{name}_lightglue.pth": _state(network_for(name)) for name in KNOWN},
        "loftr_outdoor.ckpt": {"state_dict": _state(make_network(window=5, coarse_context=True), "matcher.")},
        "LoFTR_wsize9.ckpt": {"state_dict": _state(make_network(window=9, coarse_context=False), "matcher.")},
        "GATsSPG.ckpt": {"state_dict": _state(GraphAttentionMatcher(), "matcher.")},
        "OnePosePlus_model.ckpt": {"state_dict": _state(OnePosePlusMatcher(), "matcher.")},
    }
    folder.mkdir(parents=True, exist_ok=True)
    for file, state in states.items():
        torch.save(state, folder / file)
    return folder


def _state(network: nn.Module, prefix: str = "") -> dict:
    return {prefix + key: value for key, value in network.state_dict().items()}


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    print(write_random_weights(parser.parse_args().output))


if __name__ == "__main__":
    main()
