"""Tracks of a model, and their points on known rays: depths by least squares.

A point on the ray of one of its observations has one unknown, its depth. So the normal equations of all
points are diagonal, and Levenberg-Marquardt runs for all points at once, each with its own damping.
"""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from slimsfm.arrays import Ids, Mask, Points2D, Points3D

_Rows = Int64[np.ndarray, " k"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracks:
    """All observations of a model's points, at most one per image and point; sorted by point, then image."""

    names: tuple[str, ...]
    """Names of the registered images, sorted."""

    point3D_ids: Ids
    """Ids of the points, ascending."""

    points3D_in_world: Points3D
    """Positions of the points."""

    points: _Rows
    """Point of each observation, a row of `point3D_ids`."""

    images: _Rows
    """Image of each observation, a row of `names`."""

    keypoints: _Rows
    """Keypoint of each observation, a row of the image's keypoints."""

    points2D: Float64[np.ndarray, "k 2"]
    """Pixels of each observation."""


def read_tracks(model: pycolmap.Reconstruction) -> Tracks:
    """Read the tracks of a model; if an image observes a point twice, the first keypoint counts."""
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    point3D_ids = np.array(sorted(model.point3D_ids()), np.int64)
    parts = [_observations(image, row, point3D_ids) for row, image in enumerate(images)]
    columns = np.concatenate([np.zeros((0, 3), np.int64), *(rows for rows, _ in parts)])
    points2D = np.concatenate([np.zeros((0, 2)), *(pixels for _, pixels in parts)])
    order = np.lexsort(columns.T[::-1])
    _, first = np.unique(columns[order, :2], axis=0, return_index=True)
    points, seen_by, keypoints = columns[order[first]].T
    return Tracks(
        names=tuple(image.name for image in images),
        point3D_ids=point3D_ids,
        points3D_in_world=np.array([model.point3D(i).xyz for i in point3D_ids]).reshape(-1, 3),
        points=points,
        images=seen_by,
        keypoints=keypoints,
        points2D=points2D[order[first]],
    )


def _observations(
    image: pycolmap.Image, row: int, point3D_ids: Ids
) -> tuple[Int64[np.ndarray, "k 3"], Float64[np.ndarray, "k 2"]]:
    """Rows (point, image, keypoint) and pixels of the observations of an image."""
    keypoints, points2D = np.array(image.get_observation_point2D_idxs(), np.int64), image.points2D
    seen = [points2D[keypoint] for keypoint in keypoints.tolist()]
    points = np.searchsorted(point3D_ids, np.array([point.point3D_id for point in seen], np.int64))
    pixels = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
    return np.stack([points, np.full(len(points), row), keypoints], axis=1), pixels


def choose_references(tracks: Tracks) -> Mask:
    """Choose the reference observation of each point, greedily from as few images as possible.

    The image that observes most points without a reference becomes the reference of all of them, as in
    OnePose++ [1]; this repeats until every point has one. Ties go to the first name.
    O(images * observations).

    References:
        [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation
            without CAD Models, NeurIPS 2022.
    """
    is_reference = np.zeros(len(tracks.points), dtype=bool)
    is_open = np.ones(len(tracks.points), dtype=bool)
    while is_open.any():
        counts = np.bincount(tracks.images[is_open], minlength=len(tracks.names))
        chosen = is_open & (tracks.images == counts.argmax())
        is_reference |= chosen
        settled = np.zeros(len(tracks.point3D_ids), dtype=bool)
        settled[tracks.points[chosen]] = True
        is_open &= ~settled[tracks.points]
    return is_reference


_STEPS = 50  # of Levenberg and Marquardt; 4 to 6 are usual
_CONVERGED = 1e-12  # relative to depth: smaller steps change nothing
_DERIVATIVE = 1e-6  # step of the numerical derivative, relative to depth
_MOST_DAMPING = 1e12

Depths = Float64[np.ndarray, " m"]
"""Depth of each point along the optical axis of its reference camera, in map units."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RayObservations:
    """Observations of points on rays: point p is at `origins + depths[p] * directions`."""

    points: Ids
    """Point of each observation, a row of the depths."""

    origins_in_cam: Points3D
    """Origin of the point's ray, in the frame of the observing camera."""

    directions_in_cam: Points3D
    """Direction of the ray in the same frame; 1 long along the optical axis of the reference camera."""

    points2D: Points2D
    """Pixels of each observation."""

    cameras: tuple[pycolmap.Camera, ...]
    """Intrinsics."""

    camera_rows: Ids
    """Camera of each observation, an index into `cameras`."""

    def __getitem__(self, rows: Ids) -> "RayObservations":
        """Select observations by row."""
        return replace(
            self,
            points=self.points[rows],
            origins_in_cam=self.origins_in_cam[rows],
            directions_in_cam=self.directions_in_cam[rows],
            points2D=self.points2D[rows],
            camera_rows=self.camera_rows[rows],
        )

    def residuals(self, depths: Depths) -> Float64[np.ndarray, "n 2"]:
        """Reprojection residuals in pixels; infinite for a point that does not project into the image."""
        points3D_in_cam = self.origins_in_cam + depths[self.points, None] * self.directions_in_cam
        pixels = np.full(self.points2D.shape, np.inf)
        for row, camera in enumerate(self.cameras):
            mine = self.camera_rows == row
            pixels[mine] = camera.img_from_cam(points3D_in_cam[mine])
        pixels[np.isnan(pixels)] = np.inf
        return pixels - self.points2D

    def errors(self, depths: Depths) -> Float64[np.ndarray, " n"]:
        """Reprojection errors in pixels."""
        return np.linalg.norm(self.residuals(depths), axis=1)


def refine_depths(observations: RayObservations, depths: Depths) -> Depths:
    """Move each point along its ray to the least sum of squared reprojection errors.

    Lens distortion is exact, the derivative numerical. O(observations) per step; points are independent.

    Args:
        observations: Observations of the points, except the references that define the rays.
        depths: Initial depths.
    """
    damping = np.full(len(depths), 1e-3)
    costs = _sums(observations, _squares(observations.residuals(depths)), len(depths))
    active = np.isfinite(costs)
    for _ in range(_STEPS):
        if not active.any():
            break
        steps = np.where(active, _steps(observations, depths, damping), 0.0)
        moved = depths + steps
        moved_costs = _sums(observations, _squares(observations.residuals(moved)), len(depths))
        better = active & (moved > 0) & (moved_costs <= costs)
        depths, costs = np.where(better, moved, depths), np.where(better, moved_costs, costs)
        damping = np.where(better, np.maximum(damping / 10, 1e-12), damping * 10)
        active &= (np.abs(steps) > _CONVERGED * depths) & (damping < _MOST_DAMPING)
    return depths


def _steps(observations: RayObservations, depths: Depths, damping: Depths) -> Depths:
    widths = _DERIVATIVE * depths
    ahead, behind = (observations.residuals(depths + sign * widths) for sign in (1, -1))
    with np.errstate(invalid="ignore"):
        jacobian = (ahead - behind) / (2 * widths[observations.points, None])
        products = np.sum(jacobian * observations.residuals(depths), axis=1)
    gradients = _sums(observations, products, len(depths))
    curvatures = _sums(observations, _squares(jacobian), len(depths)) * (1 + damping)
    known = np.isfinite(gradients) & (curvatures > 0)
    return np.where(known, -gradients / np.where(known, curvatures, 1), 0.0)


def _squares(residuals: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, " n"]:
    return np.sum(residuals**2, axis=1)


def _sums(observations: RayObservations, values: Float64[np.ndarray, " n"], count: int) -> Depths:
    return np.bincount(observations.points, weights=values, minlength=count).astype(np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """Rays through the reference observations: point p is at `origins + depths[p] * directions`."""

    origins_in_world: Points3D
    """Origin of each ray."""

    directions_in_world: Points3D
    """Direction of each ray; its length is 1 along the optical axis of the reference camera."""

    depths: Float64[np.ndarray, " n"]
    """Initial depth of each point."""

    others: Int64[np.ndarray, " k"]
    """Observations other than the references, rows of the tracks."""

    observations: RayObservations
    """The same observations, relative to the rays."""

    def points3D_in_world(self, depths: Float64[np.ndarray, " n"]) -> Points3D:
        """Positions of the points at these depths."""
        return self.origins_in_world + depths[:, None] * self.directions_in_world


def rays_of(model: pycolmap.Reconstruction, tracks: Tracks, is_reference: Mask) -> Rays:
    """Compute the ray of each point through the pixels of its reference observation."""
    images = {image.name: image for image in model.images.values()}
    posed = [images[name] for name in tracks.names]
    cam_from_world = np.array([image.cam_from_world().matrix() for image in posed]).reshape(-1, 3, 4)
    rotations, translations = cam_from_world[:, :, :3], cam_from_world[:, :, 3]
    camera_ids = np.array([image.camera_id for image in posed], np.int64)
    used, camera_rows = np.unique(camera_ids, return_inverse=True)
    cameras = tuple(model.camera(camera_id) for camera_id in used.tolist())

    references = np.flatnonzero(is_reference)  # one per point, in order of points
    seen_by = tracks.images[references]
    in_cam = _unit_depth(tracks.points2D[references], cameras, camera_rows[seen_by])
    directions = np.einsum("nji,nj->ni", rotations[seen_by], in_cam)
    origins = -np.einsum("nji,nj->ni", rotations[seen_by], translations[seen_by])
    depths = np.einsum("ni,ni->n", rotations[seen_by, 2], tracks.points3D_in_world - origins)

    others = np.flatnonzero(~is_reference)
    points, seen_by = tracks.points[others], tracks.images[others]
    return Rays(
        origins_in_world=origins,
        directions_in_world=directions,
        depths=depths,
        others=others,
        observations=RayObservations(
            points=points,
            origins_in_cam=np.einsum("nij,nj->ni", rotations[seen_by], origins[points])
            + translations[seen_by],
            directions_in_cam=np.einsum("nij,nj->ni", rotations[seen_by], directions[points]),
            points2D=tracks.points2D[others],
            cameras=cameras,
            camera_rows=camera_rows[seen_by],
        ),
    )


def _unit_depth(points2D: Points2D, cameras: tuple[pycolmap.Camera, ...], camera_rows: Ids) -> Points3D:
    """Points at depth 1 that project to these pixels; NaN if none does."""
    in_cam = np.ones((len(points2D), 3))
    for row, camera in enumerate(cameras):
        mine = camera_rows == row
        in_cam[mine, :2] = camera.cam_from_img(points2D[mine])
    return in_cam
