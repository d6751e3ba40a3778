"""Gray images to track in, with a texture like cloth."""

import cv2
import numpy as np


def cloth(height=240, width=320, seed=0):
    noise = np.random.default_rng(seed).random((height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)


def moved(gray, right, down):
    move = np.array([[1, 0, right], [0, 1, down]], np.float32)
    return cv2.warpAffine(gray, move, gray.shape[::-1], flags=cv2.INTER_CUBIC)


def grid(height=240, width=320, margin=60, step=12):
    x, y = np.meshgrid(np.arange(margin, width - margin, step), np.arange(margin, height - margin, step))
    return np.stack([x.ravel(), y.ravel()], axis=1) + 0.5
