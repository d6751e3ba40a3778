"""What photos that give no model lack is measured, and said with names."""

import re

import numpy as np
import pytest
from PIL import Image

from slimsfm.features.sift import Sift
from slimsfm.mapping.diagnosis import diagnose
from slimsfm.photos import read_image

NAMES = ["0.png", "1.png", "2.png"]


def noise(seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return np.kron(generator.integers(0, 256, (60, 80)), np.ones((4, 4))).astype(np.uint8)


def smooth(seed: int) -> np.ndarray:
    return (100 + seed + np.linspace(0, 60, 320)[None] + np.zeros((240, 1))).astype(np.uint8)


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (lambda seed: noise(seed) // 16, r"3 of 3 photos are almost black \(0.png, 1.png, 2.png\): use more"),
        (lambda seed: 245 + noise(seed) // 26, "3 of 3 photos are overexposed"),
        (smooth, "3 of 3 photos are blurred"),
        (lambda _: noise(0), r"2 of 3 photos are equal to another photo \(1.png, 2.png\)"),
        (noise, "3 of 3 photos are without verified matches to any other photo"),
    ],
)
def test_what_all_photos_lack_is_named(tmp_path, picture, said):
    for seed, name in enumerate(NAMES):
        Image.fromarray(picture(seed)).save(tmp_path / name)
    features = {name: Sift().extract(read_image(tmp_path / name)) for name in NAMES}
    assert re.search(said, diagnose(tmp_path, NAMES, features, {}))


def test_a_background_that_stands_still_is_named(tmp_path):
    for seed, name in enumerate(NAMES):
        picture = noise(0)
        picture[80:160, 120:200] = noise(seed + 1)[80:160, 120:200]
        Image.fromarray(picture).save(tmp_path / name)
    features = {name: Sift().extract(read_image(tmp_path / name)) for name in NAMES}
    still = {}
    for pair in (("0.png", "1.png"), ("1.png", "2.png")):
        a, b = (features[name].keypoints for name in pair)
        same = np.argwhere(np.linalg.norm(a[:, None] - b[None], axis=2) < 0.5)
        still[pair] = same.astype(np.int64)
    assert "the background does not move with the object; mask it" in diagnose(
        tmp_path, NAMES, features, still
    )
