"""Whether the points of a model project to its keypoints.

COLMAP drops observations that are more than 4 px off. Larger errors that vary smoothly over the image mean
that cameras and keypoints are of different images: keypoints of distorted photos with undistorted cameras, or
those of images of another size.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.arrays import Points2D
from slimsfm.errors import ModelError
from slimsfm.geometry import project
from slimsfm.mapping.agreement import counted
from slimsfm.mapping.lens import fit_pixel_map
from slimsfm.mapping.model import camera_of

_FEW_PX = 1.0  # a systematic error worth a note
_WRONG_PX, _WRONG = 1.5, 0.0015  # a systematic error that is too large, also over the longer side
_CLEAR = 3.0  # times the remaining error
_NOISE_PX, _NONSENSE = 4.0, 0.02  # median error worth a note; over the longer side, for an error
_MOST = 90  # percent
_SAMPLE = 20_000  # observations of a camera


@dataclass(frozen=True, kw_only=True, eq=False)
class _Observed:
    """The observations of an image."""

    image: pycolmap.Image
    projected: Points2D
    pixels: Points2D

    @property
    def size_px(self) -> int:
        camera = camera_of(self.image)
        return max(camera.width, camera.height)

    @property
    def median_px(self) -> float:
        errors = np.linalg.norm(self.projected - self.pixels, axis=1)
        return float(np.median(np.where(np.isfinite(errors), errors, np.inf)))


def check_reprojection(
    model: pycolmap.Reconstruction, images: list[pycolmap.Image], source: Path
) -> list[str]:
    """Check the reprojection errors of a model.

    Returns:
        Notes on errors that are large but may be right.

    Raises:
        ModelError: The keypoints of a camera are systematically beside its points, or the median error of an
            image exceeds 2 % of its longer side.
    """
    observed = [one for image in images if len((one := _observed(model, image)).pixels)]
    notes = [
        note
        for camera_id in sorted({one.image.camera_id for one in observed})
        if (note := _check_camera([one for one in observed if one.image.camera_id == camera_id], source))
    ]
    nonsense = [one.image.name for one in observed if one.median_px > _NONSENSE * one.size_px]
    if nonsense:
        raise ModelError(
            f"{source}: the points that {counted(nonsense, len(observed))} see do not project to their "
            "keypoints; give a model with the poses and cameras of its images"
        )
    noisy = {one.image.name: one.median_px for one in observed if one.median_px > _NOISE_PX}
    if noisy:
        notes.append(
            f"the median reprojection error of {counted(noisy, len(observed))} is up to "
            f"{max(noisy.values()):.1f} px; poses will be as inaccurate"
        )
    return notes


def _observed(model: pycolmap.Reconstruction, image: pycolmap.Image) -> _Observed:
    seen = image.get_observation_points2D()
    points = np.array([model.point3D(one.point3D_id).xyz for one in seen], np.float64).reshape(-1, 3)
    return _Observed(
        image=image,
        projected=project(points, image.cam_from_world(), camera_of(image)),
        pixels=np.array([one.xy for one in seen], np.float64).reshape(-1, 2),
    )


def _check_camera(observed: list[_Observed], source: Path) -> str | None:
    """Compare a camera's errors before and after a smooth map; a note if they are systematic."""
    projected, pixels = (
        np.concatenate([getattr(one, part) for one in observed]) for part in ("projected", "pixels")
    )
    rows = np.flatnonzero(np.isfinite(projected).all(axis=1))
    rows = rows[:: 1 + len(rows) // _SAMPLE]
    projected, pixels = projected[rows], pixels[rows]
    pixel_map = fit_pixel_map(projected, pixels)
    if pixel_map is None:
        return None
    smooth = pixel_map(projected)
    systematic, rest = (
        float(np.percentile(np.linalg.norm(smooth - other, axis=1), _MOST)) for other in (projected, pixels)
    )
    camera, names = camera_of(observed[0].image), [one.image.name for one in observed]
    found = f"the keypoints of camera {camera.camera_id} ({camera.model_name}) are"
    if systematic > max(_WRONG_PX, _WRONG * observed[0].size_px) and systematic > _CLEAR * rest:
        scale = f" and {pixel_map.scale:.3g} times as large" if abs(pixel_map.scale - 1) > _NONSENSE else ""
        raise ModelError(
            f"{source}: {found} up to {systematic:.1f} px beside its points{scale}: they are of distorted or "
            f"resized photos, the camera is not, in {counted(names)}; give a model with the cameras of its "
            "keypoints, such as that from before undistortion"
        )
    if systematic > _FEW_PX and systematic > rest:
        return f"{found} up to {systematic:.1f} px beside its points, as if its lens were another"
    return None
