"""Structure from Motion by pycolmap, from our features to a model and its verified matches."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float32
from threadpoolctl import threadpool_limits

from slimsfm.arrays import IndexPairs
from slimsfm.errors import ReconstructionError
from slimsfm.features import Features
from slimsfm.mapping.pairs import Pairs
from slimsfm.progress import ProgressBar, silent

_JITTER_PX, _ON_GRID = 0.05, 1e-3  # pixels
_BLOCK = 200  # pairs matched between two steps of the progress bar


def write_database(
    path: Path, features: Mapping[str, Features], cameras: Mapping[str, pycolmap.Camera]
) -> None:
    """Write images, cameras and features as a COLMAP database, in place of one that may be there.

    Cameras with equal `camera_id` are one camera. Image ids count from 1 in order of names; in the database
    they also stand for the names, for COLMAP's lists of pairs cannot hold a name with a space.
    """
    path.unlink(missing_ok=True)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for camera_id, camera in sorted({c.camera_id: c for c in cameras.values()}.items()):
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for image_id, name in enumerate(sorted(features), start=1):
            camera_id = cameras[name].camera_id
            image = pycolmap.Image(name=str(image_id), camera_id=camera_id, image_id=image_id)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            _write_features(database, image_id, features[name])


def _write_features(database: pycolmap.Database, image_id: int, features: Features) -> None:
    database.write_keypoints(image_id, _off_grid(features.keypoints))
    if features.descriptors.dtype == np.uint8:
        descriptors = pycolmap.FeatureDescriptors(
            type=pycolmap.FeatureExtractorType.SIFT, data=features.descriptors
        )
        database.write_descriptors(image_id, descriptors)


def _off_grid(keypoints: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 2"]:
    """Keypoints moved by up to a twentieth of a pixel if all lie on a grid of half pixels.

    On an exact grid COLMAP's solver for cameras of unknown focal length may crash the process.
    """
    if np.any(np.abs(2 * keypoints - np.round(2 * keypoints)) > _ON_GRID):
        return keypoints
    jitter = np.random.default_rng(len(keypoints)).uniform(-_JITTER_PX, _JITTER_PX, keypoints.shape)
    return keypoints + jitter.astype(np.float32)


def put_keypoints(model: pycolmap.Reconstruction, features: Mapping[str, Features]) -> None:
    """Give the images of a model the very keypoints of their features."""
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        for point, xy in zip(image.points2D, features[image.name].keypoints, strict=True):
            point.xy = xy.astype(np.float64)


def match_pairs(
    database: Path, names: list[str], pairs: Pairs, *, seed: int, progress: ProgressBar = silent
) -> None:
    """Match pairs of images by their SIFT descriptors and verify the matches by two-view geometry."""
    ids = {name: image_id for image_id, name in enumerate(names, start=1)}
    blocks = [pairs[start : start + _BLOCK] for start in range(0, len(pairs), _BLOCK)]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = database.with_suffix(".pairs.txt")
    for block in progress(blocks, f"match {len(pairs)} pairs, {_BLOCK} at a time"):
        Path(pairing.match_list_path).write_text("".join(f"{ids[a]} {ids[b]}\n" for a, b in block))
        pycolmap.match_image_pairs(
            database,
            matching_options=_matching_options(),
            pairing_options=pairing,
            verification_options=verification,
        )


def _matching_options() -> pycolmap.FeatureMatchingOptions:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = 1  # with more, equal images have now and then not given equal matches
    options.use_gpu = False
    return options


def verified_matches(database: Path, names: Mapping[int, str]) -> dict[tuple[str, str], IndexPairs]:
    """The matches of a database that fit one two-view geometry, by pair of the names given for image ids."""
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


def reconstruct(database: Path, names: list[str], workspace: Path, *, seed: int) -> pycolmap.Reconstruction:
    """Reconstruct the largest model there is of the images of a database.

    Incremental mapping [1]; where it leaves out more than a tenth of the images (a walk along a street gives
    it no good pair to start from), global mapping [2] is tried as well and the larger model taken.

    Raises:
        ReconstructionError: No two images could be joined to a model.

    References:
        [1] Schoenberger and Frahm, Structure-from-Motion Revisited, CVPR 2016.
        [2] Pan, Barath, Pollefeys and Schoenberger, Global Structure-from-Motion Revisited, ECCV 2024.
    """
    workspace.mkdir(parents=True, exist_ok=True)
    models = _map_incrementally(database, workspace, seed)
    if max((model.num_reg_images() for model in models), default=0) < 0.9 * len(names):
        models += _map_globally(database, workspace, seed)
    if not models:
        raise ReconstructionError(
            f"no model could be reconstructed from these {len(names)} images; take more, with more overlap, "
            "or of an object with more texture"
        )
    model = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    _name_images(model, names)
    return model


# One thread, of the libraries below as well: with more, pycolmap's mappers do not give equal models for equal
# input, and are hardly faster.


def _map_incrementally(database: Path, workspace: Path, seed: int) -> list[pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.extract_colors = False
    options.min_model_size = 3
    pycolmap.set_random_seed(seed)
    with threadpool_limits(1):
        return list(pycolmap.incremental_mapping(database, workspace, workspace, options=options).values())


def _map_globally(database: Path, workspace: Path, seed: int) -> list[pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1
    options.random_seed = seed
    pycolmap.set_random_seed(seed)
    with threadpool_limits(1):
        return list(pycolmap.global_mapping(database, workspace, workspace, options=options).values())


def _name_images(model: pycolmap.Reconstruction, names: list[str]) -> None:
    for image_id, image in model.images.items():
        image.name = names[image_id - 1]


def triangulate(
    database: Path,
    names: list[str],
    workspace: Path,
    cam_from_world: Mapping[str, pycolmap.Rigid3d],
    *,
    seed: int,
) -> pycolmap.Reconstruction:
    """Triangulate the matches of a database from known poses and cameras, which stay as they are.

    Raises:
        ReconstructionError: Not one point could be triangulated.
    """
    model = _posed_model(database, names, cam_from_world)
    workspace.mkdir(parents=True, exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = options.triangulation.random_seed = seed
    pycolmap.set_random_seed(seed)
    options.extract_colors = False
    model = pycolmap.triangulate_points(model, database, workspace, workspace, options=options)
    if not model.num_points3D():
        raise ReconstructionError("no point could be triangulated; are these the poses of these images?")
    _name_images(model, names)
    return model


def _posed_model(
    database: Path, names: list[str], cam_from_world: Mapping[str, pycolmap.Rigid3d]
) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in opened.read_all_images():
            keypoints = np.asarray(opened.read_keypoints(image.image_id), np.float64)[:, :2]
            posed = pycolmap.Image(
                name=image.name, keypoints=keypoints, camera_id=image.camera_id, image_id=image.image_id
            )
            model.add_image_with_trivial_frame(posed, cam_from_world[names[image.image_id - 1]])
    return model
