"""Data sets in the format of the BOP benchmark [1], such as LM, LM-O, YCB-V, TUD-L or T-LESS.

    ROOT/MODELS/models_info.json         per object, in millimeters: diameter, min_x, ..., size_z; optional:
                                         symmetries_discrete, symmetries_continuous
    ROOT/MODELS/obj_000001.ply           model of the object, in millimeters
    ROOT/SPLIT/000001/scene_gt.json      per image of scene 1, the objects in it: obj_id, cam_R_m2c (row by
                                         row) and cam_t_m2c, in millimeters: camera from object
    ROOT/SPLIT/000001/scene_camera.json  per image: cam_K, its intrinsic matrix, row by row
    ROOT/SPLIT/000001/scene_gt_info.json per object in an image: visib_fract, its visible share; may be
    missing ROOT/SPLIT/000001/rgb/000000.png     image 0; .jpg in some sets, and `gray` instead of `rgb`

All scenes of a split are read. An image is used if it shows the object exactly once, because two instances
are ambiguous, and if at least a tenth of it is visible, as for BOP's own targets. Cameras follow OpenCV.
Millimeters are converted to meters. An object has the name of its model. LM itself has no real images for
mapping: its `train` split is rendered, and what others call its real training images are part of its `test`
split.

References:
    [1] Hodan et al., BOP: Benchmark for 6D Object Pose Estimation, ECCV 2018.
        https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.datasets.base import (
    MILLIMETER,
    ListedModel,
    LoadOptions,
    ObjectSequences,
    PosedSequence,
    read_object_model,
)
from slimsfm.datasets.reading import check_frame_step, check_object_name, folders, image_size, read_json
from slimsfm.errors import InputError
from slimsfm.mapping.known_poses.values import pinhole_camera, rigid

_SUFFIXES = (".png", ".jpg", ".tif")
_LEAST_VISIBLE = 0.1


@dataclass(frozen=True, kw_only=True)
class Bop:
    """A data set in the format of the BOP benchmark."""

    path: Path
    """Folder with the splits and the models."""

    mapping_split: str = "train_real"
    """Split with the mapping images: a folder of scenes."""

    query_split: str = "test"
    """Split with the queries; not the mapping split."""

    models: str = "models"
    """Folder of the models; models_eval, if present, has fewer vertices."""

    frame_step: int = 1
    """Use every n-th image of an object, in both splits."""

    def __post_init__(self) -> None:
        check_frame_step(self.frame_step)
        if self.mapping_split == self.query_split:
            raise ValueError(f"query_split must differ from mapping_split, got {self.query_split!r}")

    def names(self) -> tuple[str, ...]:
        """Sorted names of the objects that are in both splits."""
        shown = set(self._listed())
        for split in (self.mapping_split, self.query_split):
            shown &= {number for scene in self._scenes(split) for number in _numbers_in(scene)}
        if not shown:
            raise InputError(
                f"{self.path}: no object of {self.models}/models_info.json is in both {self.mapping_split} "
                f"and {self.query_split}"
            )
        return tuple(_name(number) for number in sorted(shown))

    def load(self, name: str, options: LoadOptions) -> ObjectSequences:  # noqa: ARG002
        """Read one object: mapping images from one split, queries from the other."""
        listed = self._listed()
        numbers = {_name(number): number for number in listed}
        check_object_name(name, list(numbers), self.path)
        number, entry = numbers[name], listed[numbers[name]]
        known = ListedModel.from_millimeters(entry, f"{self._info_path}, object {number},")
        symmetric = bool(entry.get("symmetries_discrete") or entry.get("symmetries_continuous"))
        return ObjectSequences(
            name=name,
            mapping=self._sequence(self.mapping_split, number),
            query=self._sequence(self.query_split, number),
            box=known.box,
            model=read_object_model(
                self._info_path.with_name(f"{name}.ply"),
                known.box,
                unit="millimeter",
                diameter=known.diameter,
                symmetric=symmetric,
            ),
        )

    @property
    def _info_path(self) -> Path:
        return self.path / self.models / "models_info.json"

    def _listed(self) -> dict[int, dict[str, Any]]:
        entries = _entries(self._info_path)
        for number, entry in entries.items():
            _check_type(entry, dict, f"{self._info_path}, object {number},")
        return entries

    def _scenes(self, split: str) -> list[Path]:
        if not (self.path / split).is_dir():
            there = ", ".join(path.name for path in folders(self.path))
            raise InputError(f"{self.path / split} is not a folder: choose a split from {there}")
        scenes = [path for path in folders(self.path / split) if path.name.isdecimal()]
        if not scenes:
            raise InputError(f"{self.path / split} holds no scene: folders 000000, 000001, ... are required")
        return scenes

    def _sequence(self, split: str, number: int) -> PosedSequence:
        views = [view for scene in self._scenes(split) for view in _views(scene, number)][:: self.frame_step]
        if not views:
            raise InputError(
                f"{self.path / split}: no image shows {_name(number)} exactly once and well: "
                "choose another split"
            )
        return PosedSequence(
            folder=self.path / split,
            names=tuple(view.name for view in views),
            cameras=tuple(view.camera for view in views),
            cam_from_world=tuple(view.cam_from_world for view in views),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """An image that shows the object."""

    name: str
    camera: pycolmap.Camera
    cam_from_world: pycolmap.Rigid3d


def _name(number: int) -> str:
    return f"obj_{number:06d}"


def _views(scene: Path, number: int) -> Iterator[_View]:
    """Images of a scene that show an object exactly once, sorted by number."""
    cameras = _entries(scene / "scene_camera.json")
    seen = _entries(path) if (path := scene / "scene_gt_info.json").exists() else None
    for image, instances in _instances(scene).items():
        rows = [row for row, instance in enumerate(instances) if instance["obj_id"] == number]
        if len(rows) != 1 or (seen is not None and _visible(seen, image, rows[0], path) < _LEAST_VISIBLE):
            continue
        source = f"{scene / 'scene_gt.json'}, image {image},"
        rotation = _values(instances[rows[0]], "cam_R_m2c", (3, 3), source)
        translation = MILLIMETER * _values(instances[rows[0]], "cam_t_m2c", (3, 1), source)
        path_of_image = _image_path(scene, image)
        of_camera = f"{scene / 'scene_camera.json'}, image {image},"
        yield _View(
            name=path_of_image.relative_to(scene.parent).as_posix(),
            camera=pinhole_camera(
                _values(cameras.get(image), "cam_K", (3, 3), of_camera), image_size(path_of_image), of_camera
            ),
            cam_from_world=rigid(np.hstack([rotation, translation]), source),
        )


def _instances(scene: Path) -> dict[int, list[dict[str, Any]]]:
    """The objects in each image of a scene, from scene_gt.json."""
    path = scene / "scene_gt.json"
    entries = _entries(path)
    for image, instances in entries.items():
        _check_type(instances, list, f"{path}, image {image},")
        for instance in instances:
            if not isinstance(instance, dict) or not isinstance(instance.get("obj_id"), int):
                raise InputError(f"{path}, image {image}, must have an obj_id for each object")
    return entries


def _numbers_in(scene: Path) -> set[int]:
    return {instance["obj_id"] for instances in _instances(scene).values() for instance in instances}


def _visible(seen: dict[int, Any], image: int, row: int, path: Path) -> float:
    try:
        return float(seen[image][row]["visib_fract"])
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}, image {image}, must have a visib_fract for each object in scene_gt.json"
        ) from error


def _image_path(scene: Path, number: int) -> Path:
    """Path of an image; if the file is missing, the first candidate."""
    folder = scene / ("gray" if (scene / "gray").is_dir() and not (scene / "rgb").is_dir() else "rgb")
    paths = [folder / f"{number:06d}{suffix}" for suffix in _SUFFIXES]
    return next((path for path in paths if path.is_file()), paths[0])


def _entries(path: Path) -> dict[int, Any]:
    """Entries of a JSON object with numeric keys, sorted by number."""
    data = read_json(path)
    if odd := [key for key in data if not key.isdecimal()]:
        raise InputError(f"{path} must have numeric keys, got {odd[0]!r}")
    return {int(key): data[key] for key in sorted(data, key=int)}


def _check_type(value: Any, kind: type, source: str) -> None:
    if not isinstance(value, kind):
        raise InputError(f"{source} must be a {kind.__name__}, got a {type(value).__name__}")


def _values(entry: Any, key: str, shape: tuple[int, int], source: str) -> Float64[np.ndarray, "rows columns"]:
    try:
        values = np.array(entry[key], np.float64).reshape(shape)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{source} must have {key}: {math.prod(shape)} numbers") from error
    if not np.all(np.isfinite(values)):
        raise InputError(f"{source} must have {key}: {math.prod(shape)} finite numbers")
    return values
