"""A COLMAP model: its poses and cameras; its points are not used."""

from pathlib import Path

import pycolmap

from slimsfm.mapping.known_poses.given import COLMAP, GivenPoses
from slimsfm.mapping.model import camera_of, read_model

_PLACES = ("", "sparse/0", "sparse", "0")


def recognizes(path: Path) -> bool:
    """Whether this is the folder of a model, or of a project with one in `sparse`."""
    return _model(path) is not None


def read(path: Path) -> GivenPoses:
    """Read a model.

    Raises:
        ModelError: It is damaged.
    """
    model = read_model(_model(path) or path)
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda one: one.name)
    return GivenPoses(
        source=path,
        key="name",
        cam_from_world={image.name: image.cam_from_world() for image in images},
        cameras={image.name: pycolmap.Camera(camera_of(image).todict()) for image in images},  # outlive it
        folder=path,
        convention=COLMAP,
        unit="unknown",
    )


def _model(path: Path) -> Path | None:
    for folder in (path / place for place in _PLACES):
        if any((folder / f"images.{ending}").is_file() for ending in ("bin", "txt")):
            return folder
    return None
