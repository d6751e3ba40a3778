"""Structure from Motion by pycolmap, from our features to a model and its verified matches."""

import logging
import re
import tempfile
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float32
from threadpoolctl import threadpool_limits

from slimsfm.arrays import IndexPairs
from slimsfm.errors import ReconstructionError
from slimsfm.features import Features
from slimsfm.mapping.pairs import Pairs
from slimsfm.progress import ProgressBar, counted, silent, single_step

_JITTER_PX, _ON_GRID = 0.05, 1e-3  # pixels
_BLOCK = 200  # pairs that COLMAP matches per call

# COLMAP cannot read the photos, because its database names them by numbers; we color points ourselves. After
# a good model it tries others, of the few remaining images. Focal lengths are often unknown.
_EXPECTED_WARNINGS = re.compile(
    r"Could not read image|Requested to use GPU|Discarding reconstruction|Less than 50% of cameras have prior"
)
_LOGGER = logging.getLogger(__name__)


@contextmanager
def colmap_warnings() -> Iterator[None]:
    """Keep COLMAP's log off standard error, and pass each different warning on to Python's log once.

    The log of COLMAP belongs to the process: what other threads make COLMAP say meanwhile counts too.
    """
    log = pycolmap.logging
    before = log.minloglevel, log.alsologtostderr, log.stderrthreshold
    with tempfile.TemporaryDirectory(prefix="slimsfm-log-") as folder:
        log.set_log_destination(log.WARNING, Path(folder) / "colmap")
        log.minloglevel, log.alsologtostderr, log.stderrthreshold = int(log.WARNING), False, int(log.FATAL)
        try:
            yield
        finally:
            log.set_log_destination(log.WARNING, "")
            log.minloglevel, log.alsologtostderr, log.stderrthreshold = before
            lines = [line for file in Path(folder).iterdir() for line in file.read_text().splitlines()]
    _pass_on(lines)


def _pass_on(log: list[str]) -> None:
    messages = Counter(found[1] for line in log if (found := re.match(r"[WE]\d{8} .*?\] (.*)", line)))
    for message, count in messages.items():
        if not _EXPECTED_WARNINGS.match(message):
            _LOGGER.warning("COLMAP: %s%s", message, f" ({count} times)" if count > 1 else "")


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
    database.write_keypoints(image_id, _off_grid(features.keypoints))
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


def _off_grid(keypoints: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 2"]:
    """Keypoints, moved by up to 0.05 pixels if all of them lie on a grid of half pixels.

    On an exact grid, COLMAP's solver for unknown focal lengths may crash the process.
    """
    if np.any(np.abs(2 * keypoints - np.round(2 * keypoints)) > _ON_GRID):
        return keypoints
    jitter = np.random.default_rng(len(keypoints)).uniform(-_JITTER_PX, _JITTER_PX, keypoints.shape)
    return keypoints + jitter.astype(np.float32)


def put_keypoints(model: pycolmap.Reconstruction, features: Mapping[str, Features]) -> None:
    """Set the keypoints of a model's images to those of their features, without the shift of `_off_grid`."""
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        for point, xy in zip(image.points2D, features[image.name].keypoints, strict=True):
            point.xy = xy.astype(np.float64)


def match_pairs(
    database: Path, names: list[str], pairs: Pairs, *, seed: int, progress: ProgressBar = silent
) -> None:
    """Match pairs of images by their SIFT descriptors and verify the matches by two-view geometry."""
    ids = {name: image_id for image_id, name in enumerate(names, start=1)}
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = database.with_suffix(".pairs.txt")
    with counted(progress, len(pairs), "match pairs") as advance_to:
        for start in range(0, len(pairs), _BLOCK):
            block = pairs[start : start + _BLOCK]
            Path(pairing.match_list_path).write_text("".join(f"{ids[a]} {ids[b]}\n" for a, b in block))
            pycolmap.match_image_pairs(
                database,
                matching_options=_matching_options(),
                pairing_options=pairing,
                verification_options=verification,
            )
            advance_to(start + len(block))


def _matching_options() -> pycolmap.FeatureMatchingOptions:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = 1  # with more, equal images sometimes give unequal matches
    options.use_gpu = False
    return options


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


# Mapping runs on one thread, also in the libraries below: with more, equal input gives unequal models, and
# mapping is hardly faster.


def map_incrementally(
    database: Path,
    names: list[str],
    *,
    seed: int,
    progress: ProgressBar = silent,
    start: pycolmap.Reconstruction | None = None,
) -> list[pycolmap.Reconstruction]:
    """Reconstruct the images of a database by incremental mapping [1].

    Args:
        database: Images, features and verified matches.
        names: Names of the images, which the database numbers from 1.
        seed: Seed of every random choice.
        progress: Progress callback.
        start: A model to extend, of the same images and cameras. By default, mapping starts anew.

    Returns:
        The models, which may share images; with a start, the extended model alone.

    References:
        [1] Schoenberger and Frahm, Structure-from-Motion Revisited, CVPR 2016.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.extract_colors = False
    options.min_model_size = 3
    pycolmap.set_random_seed(seed)
    registered = 0  # in the model under way; the progress is that of the largest model

    def start_model() -> None:
        nonlocal registered
        registered = 2
        advance_to(registered)

    def add_image() -> None:
        nonlocal registered
        registered += 1
        advance_to(registered)

    with (
        threadpool_limits(1),
        counted(progress, len(names), "register images") as advance_to,
        _scratch() as folder,
    ):
        if start is not None:
            _numbered(start).write(folder)
            options.multiple_models = False
        models = pycolmap.incremental_mapping(
            database,
            folder,
            folder,
            input_path=folder if start is not None else "",
            options=options,
            initial_image_pair_callback=start_model,
            next_image_callback=add_image,
        )
    return _named(models, names)


def map_globally(database: Path, names: list[str], *, seed: int) -> list[pycolmap.Reconstruction]:
    """Reconstruct the images of a database by global mapping [1].

    References:
        [1] Pan, Barath, Pollefeys and Schoenberger, Global Structure-from-Motion Revisited, ECCV 2024.
    """
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1
    options.random_seed = seed
    pycolmap.set_random_seed(seed)
    with threadpool_limits(1), _scratch() as folder:
        return _named(pycolmap.global_mapping(database, folder, folder, options=options), names)


@contextmanager
def _scratch() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="slimsfm-sfm-") as folder:
        yield Path(folder)


def _named(models: Mapping[int, pycolmap.Reconstruction], names: list[str]) -> list[pycolmap.Reconstruction]:
    for model in models.values():
        _name_images(model, names)
    return [model for _, model in sorted(models.items())]


def _numbered(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with the names that images have in the database."""
    copy = pycolmap.Reconstruction(model)
    for image_id, image in copy.images.items():
        image.name = str(image_id)
    return copy


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
    progress: ProgressBar = silent,
) -> pycolmap.Reconstruction:
    """Triangulate the matches of a database from known poses and cameras, which stay as they are.

    Raises:
        ReconstructionError: No point could be triangulated.
    """
    model = _posed_model(database, names, cam_from_world)
    workspace.mkdir(parents=True, exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = options.triangulation.random_seed = seed
    pycolmap.set_random_seed(seed)
    options.extract_colors = False
    with single_step(progress, "triangulate points"):
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
