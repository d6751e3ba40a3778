"""What the matrices of given poses mean, and whether verified matches bear it out.

Programs write poses as camera to world or as world to camera, with axes as in OpenCV (x right, y down, z
forward) or as in OpenGL (x right, y up, z backward). A wrong reading gives poses that are rigid and smooth,
but that no match agrees with.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from slimsfm.arrays import Points2D
from slimsfm.errors import InputError

_PAIRS = 400  # of images that are looked at, evenly from all
_FEWEST = 20  # matches of such a pair
_TOLERANCE_DEG = 1.0  # between a ray and the epipolar plane: devices are off by less
_CLEARLY = 0.25  # share of the matches by which another reading must agree with more
_TIMES = 1.5  # and how many times as many


@dataclass(frozen=True, kw_only=True)
class PoseConvention:
    """What the matrix of a pose maps, and the axes of its camera."""

    camera_to_world: bool
    """Whether it maps the camera's frame to the world's, or the other way around."""

    opengl: bool
    """Whether the camera's axes are x right, y up, z backward; otherwise x right, y down, z forward."""

    def cam_from_world(self, matrix: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
        """The pose that a matrix of this convention states."""
        pose = matrix.inverse() if self.camera_to_world else matrix
        return _turned() * pose if self.opengl else pose

    def matrix(self, cam_from_world: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
        """The matrix that states a pose."""
        pose = _turned() * cam_from_world if self.opengl else cam_from_world
        return pose.inverse() if self.camera_to_world else pose

    def __str__(self) -> str:
        axes = "OpenGL axes (y up, z backward)" if self.opengl else "OpenCV axes (y down, z forward)"
        return f"{'camera to world' if self.camera_to_world else 'world to camera'}, {axes}"


def _turned() -> pycolmap.Rigid3d:
    """Half a turn about the camera's x axis, which is its own inverse."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.diag([1.0, -1.0, -1.0])), np.zeros(3))


CONVENTIONS = tuple(
    PoseConvention(camera_to_world=to_world, opengl=opengl)
    for to_world, opengl in product((True, False), repeat=2)
)
"""The usual ones."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MatchedRays:
    """Verified matches of two images as rays."""

    a: str
    """Name of an image."""

    b: str
    """Name of the other image."""

    rays_a: Float64[np.ndarray, "n 3"]
    """Unit rays in the camera's frame of a; row i matches row i of `rays_b`."""

    rays_b: Float64[np.ndarray, "n 3"]
    """Unit rays in the camera's frame of b."""

    focal_px: float
    """Focal length of b."""


def check_convention(
    database: Path,
    names: list[str],
    cam_from_world: Mapping[str, pycolmap.Rigid3d],
    convention: PoseConvention,
    source: str,
) -> None:
    """Check that verified matches agree with poses as they were read.

    A match agrees if both rays are within a degree of its epipolar plane and meet in front of both cameras.

    Args:
        database: COLMAP's database with cameras, keypoints and verified matches.
        names: Names of the images, which the database numbers from 1.
        cam_from_world: Poses by name.
        convention: How their matrices were read.
        source: What gave the matrices, for the message.

    Raises:
        InputError: The matches agree with clearly more of the poses if the matrices are read in another way.
    """
    pairs = read_rays(database, names)
    given = agreement(pairs, cam_from_world)
    matrices = {name: convention.matrix(pose) for name, pose in cam_from_world.items()}
    shares = {
        other: agreement(pairs, {name: other.cam_from_world(one) for name, one in matrices.items()})
        for other in CONVENTIONS
        if other != convention
    }
    best = max(shares, key=lambda one: shares[one])
    if shares[best] >= max(given + _CLEARLY, _TIMES * given):
        raise InputError(
            f"{source}: its matrices were read as {convention}, but only {given:.0%} of the matches agree "
            f"with that and lie in front of the cameras; {shares[best]:.0%} do if they are {best}; convert "
            "the poses"
        )


def agreement(pairs: list[MatchedRays], cam_from_world: Mapping[str, pycolmap.Rigid3d]) -> float:
    """Share of the matches that agree with poses, the mean over pairs of images; 1 if there is no pair."""
    shares = []
    for one in pairs:
        b_from_a = cam_from_world[one.b] * cam_from_world[one.a].inverse()
        shares.append(float(np.mean(_agrees(one, b_from_a))))
    return float(np.mean(shares)) if shares else 1.0


def inexactness_px(pairs: list[MatchedRays], cam_from_world: Mapping[str, pycolmap.Rigid3d]) -> float:
    """How far matches are from their epipolar planes, in pixels in the middle of the image; 0 without pairs.

    The median over pairs of the median over matches.
    """
    medians = []
    for one in pairs:
        b_from_a = cam_from_world[one.b] * cam_from_world[one.a].inverse()
        sines = _sines(one, b_from_a)
        medians.append(one.focal_px * float(np.median(sines)))
    medians = [median for median in medians if np.isfinite(median)]  # not of cameras in one place
    return float(np.median(medians)) if medians else 0.0


def _sines(pair: MatchedRays, b_from_a: pycolmap.Rigid3d) -> Float64[np.ndarray, " n"]:
    """Sines of the angles between rays of b and the epipolar planes of their matches."""
    turned = pair.rays_a @ b_from_a.rotation.matrix().T
    normals = np.cross(b_from_a.translation, turned)
    with np.errstate(all="ignore"):
        return np.abs(np.sum(normals * pair.rays_b, axis=1)) / np.linalg.norm(normals, axis=1)


def _agrees(pair: MatchedRays, b_from_a: pycolmap.Rigid3d) -> Bool[np.ndarray, " n"]:
    turned, rays_b, t = pair.rays_a @ b_from_a.rotation.matrix().T, pair.rays_b, b_from_a.translation
    # the depths of the points of both rays that are nearest to each other, times something positive
    cosine = np.sum(turned * rays_b, axis=1)
    along_a, along_b = turned @ t, rays_b @ t
    in_front = (cosine * along_b - along_a > 0) & (along_b - cosine * along_a > 0)
    return (_sines(pair, b_from_a) < np.sin(np.radians(_TOLERANCE_DEG))) & in_front


def read_rays(database: Path, names: list[str]) -> list[MatchedRays]:
    """Read verified matches of pairs of images, at most 400: every n-th that has at least 20."""
    with pycolmap.Database.open(database) as opened:
        pair_ids, geometries = opened.read_two_view_geometries()
        found = [
            (pair_id, np.asarray(geometry.inlier_matches, np.int64))
            for pair_id, geometry in zip(pair_ids, geometries, strict=True)
            if len(geometry.inlier_matches) >= _FEWEST
        ]
        found.sort(key=lambda one: one[0])
        chosen = (
            [found[i] for i in np.unique(np.linspace(0, len(found) - 1, _PAIRS).astype(int))] if found else []
        )
        ids = sorted({i for pair_id, _ in chosen for i in pycolmap.pair_id_to_image_pair(pair_id)})
        rays = {i: _read_rays(opened, i) for i in ids}
        focal_px = {i: _camera(opened, i).mean_focal_length() for i in ids}
    made = []
    for pair_id, rows in chosen:
        a, b = pycolmap.pair_id_to_image_pair(pair_id)
        known = np.isfinite(rays[a][rows[:, 0]]).all(axis=1) & np.isfinite(rays[b][rows[:, 1]]).all(axis=1)
        if known.any():
            rays_a, rays_b = rays[a][rows[known, 0]], rays[b][rows[known, 1]]
            both = {"a": names[a - 1], "b": names[b - 1], "rays_a": rays_a, "rays_b": rays_b}
            made.append(MatchedRays(**both, focal_px=focal_px[b]))
    return made


def _read_rays(database: pycolmap.Database, image_id: int) -> Float64[np.ndarray, "n 3"]:
    camera = _camera(database, image_id)
    pixels: Points2D = np.asarray(database.read_keypoints(image_id), np.float64)[:, :2]
    rays = np.asarray(camera.cam_from_img(pixels), np.float64).reshape(-1, 2)
    rays = np.column_stack([rays, np.ones(len(rays))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _camera(database: pycolmap.Database, image_id: int) -> pycolmap.Camera:
    return database.read_camera(database.read_image(image_id).camera_id)
