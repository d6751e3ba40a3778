"""What charts draw, and outcomes for them."""

import numpy as np
import pycolmap

from slimsfm.evaluation.results import Outcomes


def drawn(axes, label):
    """What the lines of a label go through."""
    return [line.get_xydata().tolist() for line in axes.get_lines() if line.get_label() == label]


def texts(axes):
    return [text.get_text() for text in axes.texts]


def outcomes(errors, confidence):
    poses = [pycolmap.Rigid3d() if np.isfinite(error) else None for error in errors]
    n = len(errors)
    return Outcomes(
        error=np.array(errors, np.float64),
        rotation_deg=np.array(errors, np.float64),
        translation=np.array(errors, np.float64),
        confidence=np.array(confidence, np.float64),
        references=np.ones(n, np.int64),
        seconds=np.ones((n, 3)),
        cam_from_world=tuple(poses),
    )
