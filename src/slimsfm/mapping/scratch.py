"""The scratch database of a build: images numbered from 1, features, and verified matches."""

from collections.abc import Container, Iterable, Mapping
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float32

from slimsfm.arrays import IndexPairs
from slimsfm.features import Features

_JITTER_PX, _ON_GRID = 0.05, 1e-3  # pixels

Geometries = Mapping[tuple[str, str], pycolmap.TwoViewGeometry]
"""Two-view geometries and their inliers by pair of image names."""


def write_database(
    path: Path, features: Mapping[str, Features], cameras: Mapping[str, pycolmap.Camera]
) -> None:
    """Write images, cameras and features to a COLMAP database; an existing file is replaced.

    Cameras with equal `camera_id` are one camera. Image ids count from 1 in order of names. The database also
    uses them as names, because COLMAP's lists of pairs cannot hold a name with a space.
    """
    path.unlink(missing_ok=True)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        _write_cameras(database, cameras.values())
        for image_id, name in enumerate(sorted(features), start=1):
            _write_image(database, image_id, str(image_id), cameras[name].camera_id)
            _write_features(database, image_id, features[name])


def _write_features(database: pycolmap.Database, image_id: int, features: Features) -> None:
    database.write_keypoints(image_id, off_grid(features.keypoints))
    if features.descriptors.dtype == np.uint8:
        descriptors = pycolmap.FeatureDescriptors(
            type=pycolmap.FeatureExtractorType.SIFT, data=features.descriptors
        )
        database.write_descriptors(image_id, descriptors)


def copy_verified(
    source: Path,
    target: Path,
    *,
    pairs: Container[tuple[int, int]] | None = None,
    cameras: Mapping[int, pycolmap.Camera] | None = None,
) -> None:
    """Copy what mapping needs of a database: cameras, images, keypoints and verified matches.

    Args:
        source: The database.
        target: The copy; an existing file is replaced.
        pairs: Pairs of image ids whose matches are copied. Default: all.
        cameras: Cameras by image id, instead of those of the database.
    """
    target.unlink(missing_ok=True)
    with (
        pycolmap.Database.open(source) as old,
        pycolmap.Database.open(target) as new,
        pycolmap.DatabaseTransaction(new),
    ):
        images = {image.image_id: image for image in old.read_all_images()}
        used = cameras or {i: old.read_camera(image.camera_id) for i, image in images.items()}
        _write_cameras(new, used.values())
        for image_id, image in images.items():
            _write_image(new, image_id, image.name, used[image_id].camera_id)
            new.write_keypoints(image_id, old.read_keypoints(image_id))
        for pair_id, geometry in zip(*old.read_two_view_geometries(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            if pairs is None or (a, b) in pairs:
                new.write_two_view_geometry(a, b, geometry)


def _write_cameras(database: pycolmap.Database, cameras: Iterable[pycolmap.Camera]) -> None:
    for camera_id, camera in sorted({camera.camera_id: camera for camera in cameras}.items()):
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=camera_id)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)


def _write_image(database: pycolmap.Database, image_id: int, name: str, camera_id: int) -> None:
    image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
    database.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
    frame.add_data_id(image.data_id)
    database.write_frame(frame, use_frame_id=True)


def off_grid(keypoints: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 2"]:
    """Keypoints, moved by up to 0.05 pixels if all of them lie on a grid of half pixels.

    On an exact grid, COLMAP's solver for unknown focal lengths may crash the process.
    """
    if np.any(np.abs(2 * keypoints - np.round(2 * keypoints)) > _ON_GRID):
        return keypoints
    jitter = np.random.default_rng(len(keypoints)).uniform(-_JITTER_PX, _JITTER_PX, keypoints.shape)
    return keypoints + jitter.astype(np.float32)


def put_keypoints(model: pycolmap.Reconstruction, features: Mapping[str, Features]) -> None:
    """Set the keypoints of a model's images to those of their features, without the shift of `off_grid`."""
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        for point, xy in zip(image.points2D, features[image.name].keypoints, strict=True):
            point.xy = xy.astype(np.float64)


def write_geometries(database: Path, names: list[str], geometries: Geometries) -> None:
    """Write verified matches to a database whose images are numbered from 1 in order of names."""
    ids = {name: image_id for image_id, name in enumerate(names, start=1)}
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        for (a, b), geometry in sorted(geometries.items(), key=lambda item: item[0]):
            opened.write_two_view_geometry(ids[a], ids[b], geometry)


def verified_matches(database: Path, names: Mapping[int, str]) -> dict[tuple[str, str], IndexPairs]:
    """The verified matches of a database, by pair of the names given for image ids."""
    with pycolmap.Database.open(database) as opened:
        pair_ids, geometries = opened.read_two_view_geometries()
        found = {}
        for pair_id, geometry in zip(pair_ids, geometries, strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            pairs = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
            if len(pairs) and a in names and b in names:
                ordered = names[a] < names[b]
                key = (names[a], names[b]) if ordered else (names[b], names[a])
                found[key] = pairs if ordered else pairs[:, ::-1]
        return {key: found[key][np.argsort(found[key][:, 0], kind="stable")] for key in sorted(found)}
