import cv2
import numpy as np
import pytest


@pytest.fixture(scope="session")
def textured() -> np.ndarray:
    """Noise of several scales: blobs and corners of every size."""
    rng = np.random.default_rng(0)
    layers = [
        cv2.GaussianBlur(rng.normal(size=(240, 320, 3)).astype(np.float32), None, sigma) * sigma
        for sigma in (1.0, 2.0, 4.0, 8.0)
    ]
    return np.clip(128 + 90 * np.sum(layers, axis=0), 0, 255).astype(np.uint8)
