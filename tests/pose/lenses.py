"""Every COLMAP camera model with mild distortion, and matches seen through it."""

import numpy as np
import pycolmap

from scenes import BOX
from slimsfm.geometry import project

MODELS = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"})
# Mild distortion per kind of parameter; k, p and s are radial, tangential and prism coefficients.
EXTRA = {"k": 0.02, "p": 0.001, "s": 0.001, "omega": 0.3, "alpha": 0.6, "beta": 1.1}


def distorted(model):
    lens = pycolmap.Camera.create_from_model_name(1, model, 500.0, 640, 480)
    names = [name.strip() for name in lens.params_info.split(",")]
    params = lens.params.copy()
    for index in lens.extra_params_idxs():
        kind = names[index] if names[index] in EXTRA else names[index][0]
        params[index] = EXTRA[kind] / (1 + int(names[index][-1]) if names[index][-1].isdigit() else 1)
    lens.params = params
    assert lens.verify_params()
    return lens


def matches(lens, cam_from_world, count=100, outliers=0.0, sigma_px=0.0, seed=0, flat=False):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) @ BOX.half_edges
    if flat:
        points[:, 2] = 0
    pixels = project(points, cam_from_world, lens) + sigma_px * rng.normal(size=(count, 2))
    wrong = rng.permutation(count) < outliers * count
    pixels[wrong] = rng.uniform((0, 0), (640, 480), (int(wrong.sum()), 2))
    return pixels, points, wrong
