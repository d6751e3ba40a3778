"""Whether a camera only turned: then matches have no parallax, and every depth of a model is made up."""

from collections.abc import Mapping

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Points2D
from slimsfm.mapping.pairs import Matches

_PAIRS = 60  # that are looked at
_LEAST_MATCHES = 30
_MAX_ERROR = 0.005  # of the longer side
_EXPLAINED = 0.9  # share of the matches of a pair
_FOCAL_LENGTHS = np.geomspace(0.3, 6.0, 60)  # over the longer side


def share_without_parallax(pixels: Mapping[str, Points2D], matches: Matches) -> float:
    """Share of the pairs of images whose matches a rotation explains, at the focal length that explains most.

    All cameras are taken to have the same focal length, relative to the longer side of their images.

    Args:
        pixels: Keypoints by image name, by `centered`.
        matches: Verified matches.
    """
    pairs = [p for p in matches if set(p) <= pixels.keys() and len(matches[p]) >= _LEAST_MATCHES]
    explained = []
    for a, b in pairs[:: max(1, len(pairs) // _PAIRS)]:
        matched = pixels[a][matches[a, b][:, 0]], pixels[b][matches[a, b][:, 1]]
        explained.append([_explained(*matched, focal) for focal in _FOCAL_LENGTHS])
    return float(np.mean(explained, axis=0).max()) if explained else 0.0


def centered(pixels: Points2D, camera: pycolmap.Camera) -> Points2D:
    """Pixels relative to the center of the image, over its longer side."""
    return (pixels - (camera.width / 2, camera.height / 2)) / max(camera.width, camera.height)


def _explained(a: Points2D, b: Points2D, focal_length: float) -> bool:
    """Whether the rotation that fits the rays of matches best explains nearly all of them."""
    rays_a, rays_b = _rays(a, focal_length), _rays(b, focal_length)
    u, _, v = np.linalg.svd(rays_b.T @ rays_a)
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    moved = rays_a @ rotation.T
    off = focal_length * moved[:, :2] / np.maximum(moved[:, 2:], 1e-9) - b
    return bool((np.linalg.norm(off, axis=1) < _MAX_ERROR).mean() >= _EXPLAINED)


def _rays(pixels: Points2D, focal_length: float) -> Float64[np.ndarray, "n 3"]:
    rays = np.column_stack([pixels, np.full(len(pixels), focal_length)])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
