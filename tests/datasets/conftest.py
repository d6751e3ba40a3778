"""Small data sets in the published layouts, and what is to be read from them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh
from PIL import Image

from slimsfm.datasets.base import LoadOptions, ObjectSequences, PosedSequence, map_object
from slimsfm.datasets.onepose import write_box
from slimsfm.datasets.synthetic import Synthetic
from slimsfm.geometry import Box, corner_error, project
from slimsfm.mapping.map import Map
from slimsfm.synthetic.scene import mapping_path, mapping_take

BOX = Box(np.array([0.01, -0.02, 0.03]), np.diag([0.04, 0.03, 0.05]))
POINTS = np.concatenate([BOX.corners, np.random.default_rng(0).uniform(-0.03, 0.03, (20, 3))])


@dataclass(frozen=True)
class Known:
    """An object that every layout is to hold."""

    box: Box
    """In meters, off the origin."""

    vertices: np.ndarray
    """Of its model, in meters; the corners of the box are among them."""

    poses: tuple[pycolmap.Rigid3d, ...]
    """Where the camera stood, in meters."""

    def matrix(self, number: int) -> np.ndarray:
        """One of the poses, 4x4."""
        return np.vstack([self.poses[number].matrix(), (0, 0, 0, 1)])

    def pixels(self, number: int, intrinsics: np.ndarray) -> np.ndarray:
        """Where the convention of the files puts the vertices in an image."""
        x, y, z = intrinsics @ (self.poses[number].matrix() @ np.c_[self.vertices, np.ones(28)].T)
        return np.stack([x / z, y / z], axis=1)

    def check(self, sequence: PosedSequence, numbers: Sequence[int], intrinsics: Sequence[np.ndarray]):
        """Assert that a sequence has these of the poses, and puts vertices where the files do."""
        assert len(sequence.names) == len(sequence.cameras) == len(sequence.cam_from_world) == len(numbers)
        views = zip(numbers, intrinsics, sequence.cameras, sequence.cam_from_world, strict=True)
        for number, matrix, camera, pose in views:
            assert corner_error(pose, self.poses[number], self.box) < 1e-12
            expected = self.pixels(number, matrix) + 0.5  # COLMAP's pixels begin half a pixel earlier
            assert np.allclose(project(self.vertices, pose, camera), expected, atol=1e-8)


@pytest.fixture(scope="session")
def known() -> Known:
    return Known(BOX, POINTS, tuple(mapping_path(20, 0.5)))


@pytest.fixture
def making(tmp_path) -> LoadOptions:
    return LoadOptions(folder=tmp_path / "made")


@pytest.fixture(scope="session")
def write_image() -> Callable[..., None]:
    @cache
    def encoded(width: int, height: int, suffix: str) -> bytes:
        ok, data = cv2.imencode(suffix, np.zeros((height, width, 3), np.uint8))
        assert ok
        return data.tobytes()

    def write(path: Path, width: int, height: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encoded(width, height, path.suffix))

    return write


@pytest.fixture(scope="session")
def write_ply() -> Callable[..., None]:
    def write(path: Path, vertices: np.ndarray, encoding: str = "ascii") -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [1, 2, 3]], process=False)
        path.write_bytes(mesh.export(file_type="ply", encoding=encoding))

    return write


@pytest.fixture(scope="session")
def damage() -> Callable[[Path, str | bytes | None], None]:
    """Replaces what a file holds, or takes it away."""

    def write(path: Path, content: str | bytes | None) -> None:
        assert path.is_file()
        if content is None:
            path.unlink()
        elif isinstance(content, str):
            path.write_text(content)
        else:
            path.write_bytes(content)

    return write


@pytest.fixture(scope="session")
def write_onepose(write_image) -> Callable[..., Path]:
    """Writes an object as OnePose's are published, with full frames or without."""

    def write(
        folder: Path,
        known: Known,
        frames: int,
        crops: Sequence[np.ndarray],
        full: np.ndarray | None = None,
        sequences: Sequence[str] = ("colorbox-1", "colorbox-2"),
    ) -> Path:
        write_box(folder, known.box)
        for sequence in (folder / name for name in sequences):
            for name in ("color", "intrin_ba", "poses_ba", "reproj_box"):
                (sequence / name).mkdir(parents=True)
            (sequence / "Frames.m4v").write_bytes(b"a video")
            K = np.eye(3) if full is None else full
            values = zip(("fx", "fy", "cx", "cy"), (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), strict=True)
            (sequence / "intrinsics.txt").write_text("\n".join(f"{key}: {value}" for key, value in values))
            for number in range(frames):
                write_image(sequence / "color" / f"{number}.png", 512, 512)
                np.savetxt(sequence / "intrin_ba" / f"{number}.txt", crops[number])
                np.savetxt(sequence / "poses_ba" / f"{number}.txt", known.matrix(number))
                if full is not None:
                    write_image(sequence / "color_full" / f"{number}.png", 96, 72)
        return folder

    return write


@pytest.fixture(scope="session")
def rendered(tmp_path_factory) -> tuple[Synthetic, ObjectSequences]:
    """A box rendered by the synthetic data set, and what that reads of it."""
    folder = tmp_path_factory.mktemp("rendered")
    dataset = Synthetic(
        path=folder, objects=("printed_box",), mapping_frames=16, query_frames=2, width=320, height=240
    )
    return dataset, dataset.load("printed_box", LoadOptions(folder=folder))


@pytest.fixture(scope="session")
def rendered_map(rendered, tmp_path_factory) -> Map:
    return map_object(rendered[1], tmp_path_factory.mktemp("map"))


@pytest.fixture(scope="session")
def photos(tmp_path_factory) -> Path:
    """Eight frames of a video, of which nothing is known."""
    folder = tmp_path_factory.mktemp("photos") / "box"
    folder.mkdir()
    take = mapping_take("printed_box", 80, 320, 240, 0)
    for i in range(8):
        Image.fromarray(take.frame(i)).save(folder / f"{i}.png", compress_level=1)
    return folder


@pytest.fixture(scope="session")
def crop() -> Callable[..., np.ndarray]:
    """Cuts what the authors' tools cut out of a frame: a box of it, blown up to 512 pixels a side."""

    def cut(source: Path, target: Path, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        scale = 512 / (high - low)
        crop_from_full = np.array([[scale[0], 0, -scale[0] * low[0]], [0, scale[1], -scale[1] * low[1]]])
        target.parent.mkdir(parents=True, exist_ok=True)
        warped = cv2.warpAffine(cv2.imread(str(source)), crop_from_full, (512, 512), flags=cv2.INTER_LINEAR)
        cv2.imwrite(str(target), warped)
        return np.vstack([crop_from_full, (0, 0, 1)])

    return cut
