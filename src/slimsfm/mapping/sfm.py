"""Structure from Motion by pycolmap, from our features to a model and its verified matches."""

import logging
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap
from threadpoolctl import threadpool_limits

from slimsfm.errors import ReconstructionError
from slimsfm.files import working_folder
from slimsfm.lenses import camera_fault
from slimsfm.progress import ProgressBar, counted, silent, single_step

# COLMAP cannot read the photos, because its database names them by numbers; we color points ourselves. After
# a good model it tries others, of the few remaining images. Focal lengths are often unknown.
_EXPECTED_WARNINGS = re.compile(
    r"Could not read image|Requested to use GPU|Discarding reconstruction|Less than 50% of cameras have prior"
)
_LOGGER = logging.getLogger(__name__)
_FEWEST = 3  # images of a model
# When incremental mapping adjusts the whole model, and how often in a row: COLMAP's 1.1 and 5 give the same
# models in a third more time.
_GROWTH, _REFINEMENTS = 1.3, 2
# Of triangulation: degrees and pixels by which an observation may be off.
_LIMITS = (
    *("create_max_angle_error", "continue_max_angle_error", "re_max_angle_error"),
    *("merge_max_reproj_error", "complete_max_reproj_error"),
)


@contextmanager
def colmap_warnings() -> Iterator[None]:
    """Keep COLMAP's log off standard error, and pass each different warning on to Python's log once.

    The log of COLMAP belongs to the process: what other threads make COLMAP say meanwhile counts too.
    """
    log = pycolmap.logging
    before = log.minloglevel, log.alsologtostderr, log.stderrthreshold
    with working_folder() as folder:
        log.set_log_destination(log.WARNING, folder / "colmap")
        log.minloglevel, log.alsologtostderr, log.stderrthreshold = int(log.WARNING), False, int(log.FATAL)
        try:
            yield
        finally:
            log.set_log_destination(log.WARNING, "")
            log.minloglevel, log.alsologtostderr, log.stderrthreshold = before
            lines = [line for file in folder.iterdir() for line in file.read_text().splitlines()]
    _pass_on(lines)


def _pass_on(log: list[str]) -> None:
    messages = Counter(found[1] for line in log if (found := re.match(r"[WE]\d{8} .*?\] (.*)", line)))
    for message, count in messages.items():
        if not _EXPECTED_WARNINGS.match(message):
            _LOGGER.warning("COLMAP: %s%s", message, f" ({count} times)" if count > 1 else "")


def map_incrementally(
    database: Path,
    names: list[str],
    *,
    seed: int,
    progress: ProgressBar = silent,
    label: str = "register images",
    start: pycolmap.Reconstruction | None = None,
) -> list[pycolmap.Reconstruction]:
    """Reconstruct the images of a database by incremental mapping [1].

    Args:
        database: Images, features and verified matches.
        names: Names of the images, which the database numbers from 1.
        seed: Seed of every random choice.
        progress: Progress callback.
        label: What the progress is of.
        start: A model to extend, of the same images and cameras. By default, a new model is started.

    Returns:
        The models, which may share images; with a start, the extended model alone.

    References:
        [1] Schoenberger and Frahm, Structure-from-Motion Revisited, CVPR 2016.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.extract_colors = False
    options.min_model_size = _FEWEST
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.ba_global_max_refinements = _REFINEMENTS
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
        counted(progress, len(names), label) as advance_to,
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
    with working_folder() as folder:
        yield folder


def _named(models: Mapping[int, pycolmap.Reconstruction], names: list[str]) -> list[pycolmap.Reconstruction]:
    for model in models.values():
        _name_images(model, names)
        drop_impossible(model)
    return [model for _, model in sorted(models.items()) if model.num_reg_images() >= _FEWEST]


def drop_impossible(model: pycolmap.Reconstruction) -> None:
    """Leave out images whose camera came out as no lens is: one camera must not cost the whole model."""
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        if camera_fault(model.camera(image.camera_id)):
            model.deregister_frame(image.frame_id)


def _numbered(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with the names that images have in the database."""
    copy = pycolmap.Reconstruction(model)
    for image_id, image in copy.images.items():
        image.name = str(image_id)
    return copy


def _name_images(model: pycolmap.Reconstruction, names: list[str]) -> None:
    for image_id, image in model.images.items():
        image.name = names[image_id - 1]


def adjust(
    model: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    *,
    constant_cameras: Iterable[int] = (),
) -> pycolmap.CeresBundleAdjuster:
    """Adjust all poses, points and cameras of a model, but those given, on one thread, without a word.

    Returns:
        The solved problem.
    """
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    for camera_id in constant_cameras:
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    with threadpool_limits(1):  # results must not depend on the number of threads
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
        adjuster.solve()
    return adjuster


def triangulate(
    database: Path,
    names: list[str],
    workspace: Path,
    cam_from_world: Mapping[str, pycolmap.Rigid3d],
    *,
    seed: int,
    progress: ProgressBar = silent,
    tolerance: float = 1.0,
) -> pycolmap.Reconstruction:
    """Triangulate the matches of a database from known poses and cameras, which stay as they are.

    COLMAP's limits on errors are multiplied by `tolerance`.

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
    for name in _LIMITS:
        setattr(options.triangulation, name, tolerance * getattr(options.triangulation, name))
    options.mapper.filter_max_reproj_error *= tolerance
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
