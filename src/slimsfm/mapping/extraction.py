"""The features of a folder of images, and the colours at their keypoints."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import UInt8

from slimsfm.arrays import GrayImage
from slimsfm.errors import ImageError, InputError
from slimsfm.features import Extractor, image_colors
from slimsfm.features.store import FeatureFile, FeatureWriter
from slimsfm.photos import read_image, read_mask
from slimsfm.progress import ProgressBar

Colors = Mapping[str, UInt8[np.ndarray, "n 3"]]
"""RGB at each keypoint, by image name."""


def extract_features(
    images: Path,
    names: list[str],
    extractor: Extractor,
    masks: Path | None,
    output: Path,
    progress: ProgressBar,
) -> tuple[FeatureFile, Colors]:
    """Extract the features of images into a file.

    Raises:
        InputError: An image cannot be read, or its mask is missing or of another size.
    """
    colors = {}
    with FeatureWriter(output) as writer:
        for name in progress(names, "extract features"):
            image = read_image(images / name)
            features = extractor.extract(image, mask_of(masks, name, image.shape[:2]))
            colors[name] = image_colors(image, features.keypoints)
            writer.write(name, features)
    return FeatureFile(output), colors


def mask_of(masks: Path | None, name: str, shape: tuple[int, ...]) -> GrayImage | None:
    """The mask of an image as COLMAP names it; an image without one is used whole, as COLMAP does.

    Raises:
        InputError: There is no such folder, or the mask cannot be read or is of another size.
    """
    if masks is not None and not masks.is_dir():
        raise InputError(f"{masks}: no such folder of masks")
    path = masks / f"{name}.png" if masks else None
    if path is None or not path.exists():
        return None
    mask = read_mask(path)
    if mask.shape != shape:
        raise ImageError(f"{path}: the mask is {mask.shape[::-1]} pixels, its upright image {shape[::-1]}")
    return mask


def color_points(model: pycolmap.Reconstruction, colors: Colors) -> None:
    """Give each point the mean colour of its observations."""
    names = {image_id: image.name for image_id, image in model.images.items()}
    for point in model.points3D.values():
        seen = [colors[names[element.image_id]][element.point2D_idx] for element in point.track.elements]
        point.color = np.mean(seen, axis=0).round().astype(np.uint8)
