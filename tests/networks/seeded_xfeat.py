"""Networks of XFeat and LighterGlue with reproducible weights that find and match something."""

from dataclasses import replace
from pathlib import Path

import torch
from kornia.feature import LightGlue, XFeatModel

from networks.seeded import fill
from slimsfm.methods.lightglue import network_for
from slimsfm.weight_files import WEIGHTS


def seeded_xfeat() -> XFeatModel:
    """Without the factor, no pixel is likely to be a keypoint."""
    network = XFeatModel().eval()
    fill(network, 0)
    with torch.no_grad():
        network.get_parameter("keypoint_head.3.weight").mul_(3)
    return network


def seeded_lighterglue() -> LightGlue:
    """Without the factors, descriptors that resemble each other no longer do so after the last layer."""
    network = network_for("xfeat").eval()
    fill(network, 0)
    with torch.no_grad():
        network.get_parameter("input_proj.weight").mul_(4)
        network.get_parameter("log_assignment.5.final_proj.weight").mul_(2)
        for layer in range(6):
            network.get_parameter(f"log_assignment.{layer}.matchability.bias").fill_(5)
            for block in ("self_attn", "cross_attn"):
                network.get_parameter(f"transformers.{layer}.{block}.ffn.3.weight").mul_(0.1)
    return network


def write_seeded_xfeat(folder: Path) -> Path:
    """Write both networks in the layouts of the published files."""
    extractor, matcher = seeded_xfeat().state_dict(), seeded_lighterglue().state_dict()
    torch.save(extractor, folder / "xfeat.pt")
    both = {f"matcher.{key}": value for key, value in matcher.items() if key != "confidence_thresholds"}
    both |= {f"extractor.model.net.{key}": value for key, value in extractor.items()}
    torch.save(both, folder / "xfeat-lighterglue.pt")
    return folder


def accept_seeded_xfeat(monkeypatch) -> None:
    """Let files pass that are not the published ones."""
    for name in ("xfeat", "lighterglue"):
        monkeypatch.setitem(WEIGHTS, name, replace(WEIGHTS[name], sha256=None))
