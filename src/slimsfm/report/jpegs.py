"""Photos as text: small JPEGs that are part of the page."""

import base64
import io
from pathlib import Path

from PIL import Image as PillowImage

from slimsfm.arrays import Image
from slimsfm.errors import ImageError
from slimsfm.photos import read_image, shrink


def jpeg_uri(image: Image, *, thin_lines: bool) -> str:
    """An image as the address of itself.

    Args:
        image: The image.
        thin_lines: Keep the colours of thin lines, which takes half as many bytes again.
    """
    buffer = io.BytesIO()
    quality, subsampling = (80, "4:4:4") if thin_lines else (75, "4:2:0")
    PillowImage.fromarray(image).save(buffer, "JPEG", quality=quality, subsampling=subsampling, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()


def photo_uri(path: Path, max_size: int) -> str | None:
    """A photo, its longer side so many pixels at most; None where it is not there any more."""
    try:
        return jpeg_uri(shrink(read_image(path), max_size), thin_lines=False)
    except ImageError:
        return None
