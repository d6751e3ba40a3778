"""Why photos give no model: what they lack, measured."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from slimsfm.features import Features
from slimsfm.mapping.pairs import Matches
from slimsfm.photos import read_image, shrink

_SIDE = 640  # pixels of the longer side at which photos are judged
_DARK, _BRIGHT = 25, 230  # mean gray level
_SHARP = 25.0  # least variance of the Laplacian of a sharp photo
_FEW = 100  # features
_STILL_PX, _STILL = 1.5, 0.7  # share of matches that stay in place
_COMMON = 0.3  # share of the photos from which a fault is worth naming
_LISTED = 5  # names in a sentence


def diagnose(images: Path, names: list[str], features: Mapping[str, Features], matches: Matches) -> str:
    """Say what photos lack for a model: light, sharpness, texture, motion or overlap.

    Args:
        images: Folder of the photos.
        names: Their names.
        features: Their features.
        matches: Their verified matches.

    Returns:
        Sentences with numbers and names, joined by semicolons; empty if the photos lack nothing of this.
    """
    grays = {name: _gray(images / name) for name in names}
    few = f"almost without texture (fewer than {_FEW} features)"
    alone = sorted(set(names) - {name for pair in matches for name in pair})
    causes = [
        _listed("almost black", [n for n, g in grays.items() if g.mean() < _DARK], names, "use more light"),
        _listed("overexposed", [n for n, g in grays.items() if g.mean() > _BRIGHT], names, "use less light"),
        _listed("blurred", [n for n in names if _is_blurred(grays[n])], names, "hold the camera still"),
        _listed("equal to another photo", _repeated(grays), names, "move between photos"),
    ]
    effects = [
        _listed(few, [n for n in names if len(features[n]) < _FEW], names, "go closer, or add some texture"),
        _still(features, matches),
        _listed(
            "without verified matches to any other photo", alone, names, "take more photos between these"
        ),
    ]
    found = [fault for fault in causes if fault]
    return "; ".join(found or [fault for fault in effects if fault])


def _gray(path: Path) -> np.ndarray:
    return cv2.cvtColor(shrink(read_image(path), _SIDE), cv2.COLOR_RGB2GRAY)


def _is_blurred(gray: np.ndarray) -> bool:
    sharpness = float(cv2.Laplacian(gray, cv2.CV_64F).var())
    return bool(gray.mean() >= _DARK) and sharpness < _SHARP


def _repeated(grays: Mapping[str, np.ndarray]) -> list[str]:
    first: dict[bytes, str] = {}
    return [name for name, gray in grays.items() if first.setdefault(gray.tobytes(), name) != name]


def _listed(what: str, affected: list[str], names: list[str], advice: str) -> str:
    if len(affected) < max(1, _COMMON * len(names)):
        return ""
    more = f" and {len(affected) - _LISTED} more" if len(affected) > _LISTED else ""
    listed = ", ".join(affected[:_LISTED])
    return f"{len(affected)} of {len(names)} photos are {what} ({listed}{more}): {advice}"


def _still(features: Mapping[str, Features], matches: Matches) -> str:
    """Whether most matches lie at the same pixels in both photos, as those of a background do."""
    still = 0
    for a, b in matches:
        rows = matches[a, b]
        moved = features[a].keypoints[rows[:, 0]] - features[b].keypoints[rows[:, 1]]
        still += bool((np.linalg.norm(moved, axis=1) < _STILL_PX).mean() > _STILL)
    if not len(matches) or still < _COMMON * len(matches):
        return ""
    return (
        f"in {still} of {len(matches)} pairs of photos most matches stay at the same pixels: the background "
        "does not move with the object; mask it, or move the camera instead of the object"
    )
