"""The LINEMOD data set [1] as CDPN [2] publishes it and OnePose++ reads it.

    ROOT/real_train/OBJECT/7-color.png    mapping image 7, 640 x 480; about 15 % of all images
    ROOT/real_train/OBJECT/7-pose.txt     3x4: camera from object in that image, in meters
    ROOT/real_test/OBJECT/...             the same for the queries
    ROOT/models/OBJECT/OBJECT.ply         model of the object, in meters
    ROOT/models/models_info.txt           one line per object, in millimeters:
                                          `1 diameter 102.1 min_x -37.9 ... size_x 75.9 ... size_z 91.8`

The names of the objects are ape, benchvise, camera, ...; models_info.txt refers to them by number. Image
numbers may have leading zeros. Other files, such as masks and 2D boxes, are not read. All images share one
camera, which is not in the files but equal in both tools: fx 572.4114, fy 573.57043, cx 325.2611, cy
242.04899, in OpenCV's convention. Eggbox and glue count as symmetric, and so do bowl and cup.

References:
    [1] Hinterstoisser et al., Model Based Training, Detection and Pose Estimation of Texture-Less 3D Objects
        in Heavily Cluttered Scenes, ACCV 2012.
    [2] Li, Wang and Ji, CDPN: Coordinates-Based Disentangled Pose Network for Real-Time RGB-Based 6-DoF
        Object Pose Estimation, ICCV 2019. https://github.com/LZGMatrix/CDPN_ICCV2019_ZhigangLi
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slimsfm.datasets.base import ListedModel, LoadOptions, ObjectSequences, PosedSequence, read_object_model
from slimsfm.datasets.reading import check_object_name, check_paired, equal_size, folders
from slimsfm.errors import ImageError, InputError
from slimsfm.mapping.known_poses.values import numbered, pinhole_camera, read_pose, read_text

_NUMBERS = {
    "ape": 1,
    "benchvise": 2,
    "bowl": 3,
    "camera": 4,
    "can": 5,
    "cat": 6,
    "cup": 7,
    "driller": 8,
    "duck": 9,
    "eggbox": 10,
    "glue": 11,
    "holepuncher": 12,
    "iron": 13,
    "lamp": 14,
    "phone": 15,
}

_SYMMETRIC = frozenset({"bowl", "cup", "eggbox", "glue"})

_INTRINSICS = np.array([[572.4114, 0, 325.2611], [0, 573.57043, 242.04899], [0, 0, 1]])
_SIZE = (640, 480)


@dataclass(frozen=True, kw_only=True)
class Linemod:
    """LINEMOD with real images for mapping and queries, as published with CDPN."""

    path: Path
    """Folder with real_train, real_test and models."""

    def names(self) -> tuple[str, ...]:
        """Sorted names of the objects."""
        names = tuple(sorted(path.name for path in folders(self.path / "real_train")))
        if not names:
            raise InputError(f"{self.path / 'real_train'} holds no folder: one per object is required")
        if unknown := sorted(set(names) - _NUMBERS.keys()):
            raise InputError(
                f"{self.path / 'real_train' / unknown[0]} does not have the name of a LINEMOD object; "
                f"the names are {', '.join(_NUMBERS)}"
            )
        return names

    def load(self, name: str, options: LoadOptions) -> ObjectSequences:  # noqa: ARG002
        """Read one object: mapping images from real_train, queries from real_test."""
        check_object_name(name, self.names(), self.path)
        models = self.path / "models"
        listed = _read_listed(models / "models_info.txt", _NUMBERS[name])
        return ObjectSequences(
            name=name,
            mapping=_read_images(self.path / "real_train" / name),
            query=_read_images(self.path / "real_test" / name),
            box=listed.box,
            model=read_object_model(
                models / name / f"{name}.ply",
                listed.box,
                diameter=listed.diameter,
                symmetric=name in _SYMMETRIC,
            ),
        )


def _read_images(directory: Path) -> PosedSequence:
    images, poses = numbered(directory, "-color.png"), numbered(directory, "-pose.txt")
    check_paired(images, poses, "pose")
    paths = tuple(images.values())
    if (size := equal_size(paths)) != _SIZE:
        raise ImageError(f"{paths[0]} has {size[0]}x{size[1]} pixels, but LINEMOD's images have 640x480")
    return PosedSequence(
        folder=directory,
        names=tuple(path.name for path in paths),
        cameras=(pinhole_camera(_INTRINSICS, size, directory),) * len(paths),
        cam_from_world=tuple(read_pose(path, (3, 4)) for path in poses.values()),
    )


def _read_listed(path: Path, number: int) -> ListedModel:
    lines = [line.split() for line in read_text(path).splitlines()]
    found = [words for words in lines if words[:1] == [str(number)]]
    if len(found) != 1:
        raise InputError(f"{path} must have one line for object {number}, got {len(found)}")
    words = found[0][1:]
    listed = dict(zip(words[::2], words[1::2], strict=False))
    return ListedModel.from_millimeters(listed, f"{path}, object {number},")
