"""Directions of gravity on disk, as phones record them beside their photos."""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from slimsfm.errors import InputError
from slimsfm.pose import Gravity


def read_gravity(path: Path) -> dict[str, Gravity]:
    """Read `{"world": [x, y, z], "images": {NAME: [x, y, z], ...}}`: where down is.

    The first is in the frame of the map, the others in the frames of the upright images' cameras (x right, y
    down, z forward). Lengths do not matter.

    Raises:
        InputError: The file is missing or does not hold this.
    """
    try:
        data = json.loads(path.read_text())
        world = _vector(data["world"])
        return {str(name): Gravity(in_world=world, in_cam=_vector(v)) for name, v in data["images"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f'{path}: should hold {{"world": [x, y, z], "images": {{NAME: [x, y, z], ...}}}} ({error})'
        ) from error


def _vector(values: object) -> Float64[np.ndarray, "3"]:
    return np.array(values, np.float64).reshape(3)
