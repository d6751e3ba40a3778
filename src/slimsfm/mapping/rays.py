"""The rays on which points are to stay, and what else is seen of the points."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from slimsfm.arrays import Ids, Mask, Points2D, Points3D
from slimsfm.mapping.depth_refinement import Sightings
from slimsfm.mapping.tracks import Tracks


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """Rays of the reference observations of points: point p is at `origins + depth[p] * directions`."""

    origins_in_world: Points3D
    """Where each ray starts."""

    directions_in_world: Points3D
    """Where it goes; 1 long along the optical axis of the camera that it starts from."""

    depths: Float64[np.ndarray, " n"]
    """Where the points are now, or next to that on their rays."""

    others: Int64[np.ndarray, " k"]
    """The observations that are no references, rows of the tracks."""

    sightings: Sightings
    """These observations."""

    def points3D_in_world(self, depths: Float64[np.ndarray, " n"]) -> Points3D:
        """Where points of these depths are."""
        return self.origins_in_world + depths[:, None] * self.directions_in_world


def rays_of(model: pycolmap.Reconstruction, tracks: Tracks, is_reference: Mask) -> Rays:
    """The rays of all points through the pixels of their reference observations."""
    images = {image.name: image for image in model.images.values()}
    posed = [images[name] for name in tracks.names]
    cam_from_world = np.array([image.cam_from_world().matrix() for image in posed]).reshape(-1, 3, 4)
    rotations, translations = cam_from_world[:, :, :3], cam_from_world[:, :, 3]
    camera_ids = np.array([image.camera_id for image in posed], np.int64)
    used, camera_rows = np.unique(camera_ids, return_inverse=True)
    cameras = tuple(model.camera(camera_id) for camera_id in used.tolist())

    references = np.flatnonzero(is_reference)  # one a point, in order of points
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
        sightings=Sightings(
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
    """Points at depth 1 that project to these pixels; NaN where there are none."""
    in_cam = np.ones((len(points2D), 3))
    for row, camera in enumerate(cameras):
        mine = camera_rows == row
        in_cam[mine, :2] = camera.cam_from_img(points2D[mine])
    return in_cam
