"""Dark images give the features of bright ones; all other images are left as they are."""

import numpy as np

from slimsfm.features.brightness import brighten
from slimsfm.features.sift import Sift


def test_images_that_are_not_dark_are_not_touched(textured):
    assert brighten(textured) is textured
    lamp = np.full((40, 40), 10, np.uint8)
    lamp[:8, :8] = 255  # 4 % of the image
    assert brighten(lamp) is lamp


def test_black_images_stay_black():
    black = np.zeros((32, 32, 3), np.uint8)
    assert brighten(black) is black


def test_a_dark_image_uses_all_gray_levels_in_their_order(textured):
    dark = (textured // 12).astype(np.uint8)
    bright = brighten(dark)
    assert bright.shape == dark.shape
    assert bright.dtype == np.uint8
    assert bright.max() == 255
    levels = np.unique(dark)
    means = [bright[dark == level].mean() for level in levels]
    assert np.all(np.diff(means) >= 0)


def test_features_are_found_in_the_dark(textured):
    by_day, at_night = (len(Sift().extract(image)) for image in (textured, textured // 12))
    assert at_night > 0.5 * by_day
