"""A sphere and a matcher that knows it: cells match if they show the same, and alignment is exact."""

from dataclasses import dataclass

import numpy as np
import pycolmap

from slimsfm.geometry import project
from slimsfm.methods.loftr.cells import ImageMatches
from slimsfm.synthetic.scene import look_at

RADIUS = 1.0
_FACING = 0.35  # cosine between a surface and the view below which it is not matched


def ring_of_cameras(count: int) -> list[pycolmap.Rigid3d]:
    """Cameras 30 degrees apart on a ring around the sphere, alternately low and high."""
    angles = np.radians(30) * np.arange(count)
    return [
        look_at(np.array([5 * np.cos(a), 5 * np.sin(a), 1.5 * (i % 2)]), np.zeros(3))
        for i, a in enumerate(angles)
    ]


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """An encoded image: the pose from which the sphere was seen."""

    cam_from_world: pycolmap.Rigid3d
    camera: pycolmap.Camera
    cell_px: float
    image_size: tuple[int, int]

    def surface(self, points2D: np.ndarray) -> np.ndarray:
        """Points of the sphere at given pixels; NaN beyond the sphere."""
        on_plane = np.asarray(self.camera.cam_from_img(points2D)).reshape(-1, 2)
        ray = np.column_stack([on_plane, np.ones(len(points2D))])
        world_from_cam = self.cam_from_world.inverse()
        eye, ray = world_from_cam.translation, ray @ world_from_cam.rotation.matrix().T
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        middle = ray @ eye
        with np.errstate(invalid="ignore"):
            distance = -middle - np.sqrt(middle**2 - eye @ eye + RADIUS**2)
        return eye + distance[:, None] * ray

    def facing(self, points: np.ndarray) -> np.ndarray:
        """Cosine between a surface and the view."""
        towards = self.cam_from_world.inverse().translation - points
        return np.sum(points * towards, axis=1) / (RADIUS * np.linalg.norm(towards, axis=1))

    def cell_of(self, points2D: np.ndarray) -> np.ndarray:
        """Center of the cell of each pixel."""
        return (np.floor(points2D / self.cell_px) + 0.5) * self.cell_px

    @property
    def cells(self) -> np.ndarray:
        """Centers of all cells."""
        columns, rows = (np.arange(0.5, side // self.cell_px) for side in self.image_size)
        return self.cell_px * np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


class SphereMatcher:
    """Implements `ImageMatcher`. The gray level of a photo encodes the number of its pose.

    Pixels are aligned only within `reach_px` of the right position.
    """

    name = "loftr"

    def __init__(
        self,
        poses: list[pycolmap.Rigid3d],
        camera: pycolmap.Camera,
        cell_px: float = 8.0,
        reach_px: float = np.inf,
    ) -> None:
        self._poses, self._camera, self._cell_px, self._reach_px = poses, camera, cell_px, reach_px

    @property
    def options(self) -> dict:
        return {}

    def photo(self, number: int) -> np.ndarray:
        """The image that a camera takes."""
        return np.full((self._camera.height, self._camera.width, 3), 10 * number, np.uint8)

    def encode(self, image, *, cells_only=False) -> Seen:  # noqa: ARG002
        height, width = image.shape[:2]
        camera = pycolmap.Camera(self._camera.todict())
        camera.rescale(width, height)
        size = self._cell_px * width / self._camera.width
        pose = self._poses[round(int(image.flat[0]) / 10)]
        return Seen(cam_from_world=pose, camera=camera, cell_px=size, image_size=(width, height))

    def match_cells(self, one: Seen, other: Seen) -> ImageMatches:
        surface = one.surface(one.cells)
        seen = np.flatnonzero(np.isfinite(surface).all(axis=1))
        sure = np.minimum(one.facing(surface[seen]), other.facing(surface[seen]))
        seen, sure = seen[sure > _FACING], sure[sure > _FACING]
        order = np.argsort(-sure, kind="stable")
        seen, sure = seen[order], sure[order]
        cells2 = other.cell_of(project(surface[seen], other.cam_from_world, other.camera))
        _, first = np.unique(cells2, axis=0, return_index=True)
        kept = np.sort(first)
        return ImageMatches(
            points2D_1=one.cells[seen[kept]], points2D_2=cells2[kept], scores=sure[kept].astype(np.float32)
        )

    def match(self, one: Seen, other: Seen) -> ImageMatches:
        rough = self.match_cells(one, other)
        exact = self.align(one, other, rough.points2D_1, rough.points2D_2)
        return ImageMatches(points2D_1=rough.points2D_1, points2D_2=exact, scores=rough.scores)

    def align(self, one: Seen, other: Seen, points2D_1, points2D_2):
        exact = project(one.surface(points2D_1), other.cam_from_world, other.camera)
        near = np.linalg.norm(exact - points2D_2, axis=1) <= self._reach_px
        return np.where(near[:, None], exact, points2D_2)

    def describe(self, one: Seen, points2D):
        """Position of a pixel on the sphere."""
        return np.nan_to_num(one.surface(points2D)).astype(np.float16)
