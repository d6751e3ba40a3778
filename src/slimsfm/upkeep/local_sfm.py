"""Triangulate the matches of new images of a model and adjust their poses, while all else stays where it is.

COLMAP's triangulator continues tracks of points with keypoints that agree with them, and makes points of
keypoints that see none. Poses of the new images and positions of the new points are adjusted together. Old
images, old points and all cameras are constant. All is done in the pixels in which features were found, which
COLMAP's limits are for.
"""

from collections.abc import Iterable, Mapping

import pycolmap
from threadpoolctl import threadpool_limits

from slimsfm.mapping.pairs import Matches

_MAX_ERROR_PX, _MIN_ANGLE_DEG = 4.0, 1.5  # of an observation and of a point, as in COLMAP
_ROUNDS = 2  # after the first adjustment, more keypoints agree


def triangulate_and_adjust(
    model: pycolmap.Reconstruction, new: Iterable[str], matches: Matches, *, seed: int
) -> None:
    """Give new images of a model observations, and adjust their poses, in place.

    Args:
        model: The model, in pixels of the shrunk images. The new images have poses and keypoints.
        new: Names of the new images.
        matches: Verified matches by pair of names, of the new images and of others around them.
        seed: Seed of the triangulation.
    """
    ids = {model.image(i).name: i for i in sorted(model.reg_image_ids())}
    new_ids = sorted(ids[name] for name in new)
    old_points = set(model.point3D_ids())
    graph = _correspondences(model, ids, matches)
    observations = pycolmap.ObservationManager(model, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, model, observations)
    options = pycolmap.IncrementalTriangulatorOptions()
    options.random_seed = seed
    pycolmap.set_random_seed(seed)
    with threadpool_limits(1):  # results must not depend on the number of threads
        for _ in range(_ROUNDS):
            for image_id in new_ids:
                triangulator.triangulate_image(options, image_id)
            triangulator.complete_tracks(options, set(model.point3D_ids()) - old_points)
            _adjust(model, new_ids, old_points)
            _filter(model, observations, new_ids, old_points)


def _correspondences(
    model: pycolmap.Reconstruction, ids: Mapping[str, int], matches: Matches
) -> pycolmap.CorrespondenceGraph:
    graph = pycolmap.CorrespondenceGraph()
    for image_id in sorted(ids.values()):
        graph.add_image(image_id, model.image(image_id).num_points2D())
    for a, b in sorted(matches):
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.inlier_matches = matches[a, b].astype("uint32")
        graph.add_two_view_geometry(ids[a], ids[b], geometry)
    graph.finalize()
    return graph


def _adjust(model: pycolmap.Reconstruction, new_ids: list[int], old_points: set[int]) -> None:
    """Adjust the new images and points; what is not in the problem is constant."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in new_ids:
        if model.image(image_id).num_points3D:
            config.add_image(image_id)
    for point_id in sorted(set(model.point3D_ids()) - old_points):
        config.add_variable_point(point_id)
    for point_id in sorted(_seen(model, new_ids) & old_points):
        config.add_constant_point(point_id)
    if config.images:
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _seen(model: pycolmap.Reconstruction, image_ids: Iterable[int]) -> set[int]:
    return {point.point3D_id for i in image_ids for point in model.image(i).points2D if point.has_point3D()}


def _filter(
    model: pycolmap.Reconstruction,
    observations: pycolmap.ObservationManager,
    new_ids: list[int],
    old_points: set[int],
) -> None:
    """Remove observations by new images and new points that do not fit; what was there before stays."""
    for image_id in new_ids:
        image = model.image(image_id)
        for row, point in enumerate(image.points2D):
            if not point.has_point3D() or point.point3D_id not in old_points:
                continue
            pixel = image.project_point(model.point3D(point.point3D_id).xyz)
            if pixel is None or ((pixel - point.xy) ** 2).sum() > _MAX_ERROR_PX**2:
                observations.delete_observation(image_id, row)
    new_points = set(model.point3D_ids()) - old_points
    observations.filter_points3D(_MAX_ERROR_PX, _MIN_ANGLE_DEG, new_points)
