from dataclasses import dataclass, replace

import numpy as np
import pycolmap
import pytest

from rendered import MAPPING_FRAMES, NAME, Rendered, rendered
from slimsfm.localization import Localizer
from slimsfm.synthetic.scene import look_at, mapping_take


@pytest.fixture(scope="session")
def boulder(tmp_path_factory) -> Rendered:
    return rendered(tmp_path_factory.getbasetemp() / "rendered")


@pytest.fixture(scope="session")
def localizer(boulder) -> Localizer:
    return Localizer(boulder.map)


@dataclass(frozen=True)
class Sequence:
    images: list[np.ndarray]
    cam_from_world: list[pycolmap.Rigid3d]


@pytest.fixture(scope="session")
def walk() -> Sequence:
    """Around the object by 2 degrees per frame; the second half begins on the other side."""
    take = mapping_take(NAME, MAPPING_FRAMES, 320, 240, seed=0)
    radius = np.linalg.norm(take.cam_from_object[0].inverse().translation)
    steps = np.arange(12)
    degrees = np.concatenate([20 + 2 * steps, 190 + 2 * steps])
    poses = [look_at(_eye(degree, 35 + 0.3 * degree % 20, radius), np.zeros(3)) for degree in degrees]
    take = replace(take, cam_from_object=tuple(poses))
    return Sequence([take.frame(i) for i in range(len(poses))], poses)


def _eye(azimuth_deg, elevation_deg, radius):
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    level = np.cos(elevation)
    return radius * np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
