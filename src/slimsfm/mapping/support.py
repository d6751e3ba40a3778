"""How well verified matches support a model.

Structure from Motion lays look-alike parts of an object or a room over each other (the model is folded), and
may join several places by chance. Such models are large and have small reprojection errors, but they
contradict matches that are hard to doubt. Three measures tell them apart:

    contradictions  of the trusted pairs of images, those of which fewer than half of the matches lie within
                    4 px of their epipolar lines
    pieces          images joined by at least 15 common points, directly or through others
    parallax        whether rotations of the camera explain the matches as well (`mapping.parallax`)

The trusted pairs of an image are those with its neighbors in order of name, if they have at least half as
many matches as its strongest pair; otherwise its strongest pair. What was photographed one after the other
stands together, even where something else looks more alike. A fold breaks at least one such pair, because its
images go once around what looks the same twice.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from itertools import pairwise

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from slimsfm.arrays import Points2D, evenly_spaced
from slimsfm.mapping.model import camera_of, positions
from slimsfm.mapping.pairs import Matches, in_order
from slimsfm.mapping.parallax import centered, share_without_parallax
from slimsfm.mapping.quality import MIN_COMMON_POINTS, ModelQuality

Pair = tuple[str, str]

MIN_AGREEING = 0.5
"""Share of the matches of a pair below which a model contradicts it."""

_MAX_ERROR_PX, _FULL_SIZE = 4.0, 1600  # from an epipolar line; in larger images in proportion
_NEIGHBOR_SHARE = 0.5  # of the matches of the strongest pair that a neighbor needs to be trusted
_CLOSE = 0.3  # camera spread up to which cameras may only have turned
_LISTED_CAMERAS = 12  # whose focal lengths are kept, from the shortest to the longest
_SAMPLED = 2000  # points whose triangulation angle is measured


def measure(model: pycolmap.Reconstruction, matches: Matches, names: Iterable[str]) -> ModelQuality:
    """Measure the support of a model.

    Args:
        model: A model with named images.
        matches: Verified matches by pair of image names; keypoints are those of the model.
        names: All photos that the model was to be made of.
    """
    names = list(names)
    images = {model.image(i).name: model.image(i) for i in sorted(model.reg_image_ids())}
    agreeing = agreement(images, matches)
    trusted = trusted_pairs(matches, names)
    common = common_points(model, list(images))
    broken = {pair: agreeing[pair] for pair in trusted if agreeing.get(pair, 1.0) < MIN_AGREEING}
    contradictions = {
        name: min(broken[p] for p in broken if name in p) for name in sorted({*sum(broken, ())})
    }
    observations = [image.num_points3D for image in images.values()]
    lengths = [point.track.length() for point in model.points3D.values()]
    spread = _camera_spread(model)
    return ModelQuality(
        given=len(names),
        registered=len(images),
        verified_pairs=len(agreeing),
        contradicted_pairs=sum(share < MIN_AGREEING for share in agreeing.values()),
        trusted_pairs=sum(pair in agreeing for pair in trusted),
        contradictions=contradictions,
        doubtful=_with_neighbors(contradictions, list(images), common),
        median_observations=float(np.median(observations or [0])),
        median_track_length=float(np.median(lengths or [0])),
        triangulation_angle_deg=_triangulation_angle(model),
        camera_spread=spread,
        without_parallax=_without_parallax(images, matches) if spread < _CLOSE else 0.0,
        focal_lengths=_focal_lengths(images),
        pieces=_pieces(common),
    )


def agreement(images: Mapping[str, pycolmap.Image], matches: Matches) -> dict[Pair, float]:
    """Share of the matches of each pair of images that lie within 4 px of their epipolar lines.

    Images of more than 1600 px may err by proportionally more.
    """
    rays = {name: _rays(image) for name, image in images.items()}
    found = {}
    for a, b in matches:
        rows = matches[a, b]
        if a in images and b in images and len(rows):
            matched = rays[a][rows[:, 0]], rays[b][rows[:, 1]]
            found[a, b] = float(near_epipolar_lines(images[a], images[b], *matched).mean())
    return found


def _without_parallax(images: Mapping[str, pycolmap.Image], matches: Matches) -> float:
    pixels = {name: centered(positions(image), camera_of(image)) for name, image in images.items()}
    return share_without_parallax(pixels, matches)


def _rays(image: pycolmap.Image) -> Points2D:
    return np.asarray(camera_of(image).cam_from_img(positions(image)), np.float64).reshape(-1, 2)


def near_epipolar_lines(
    a: pycolmap.Image, b: pycolmap.Image, rays_a: Points2D, rays_b: Points2D
) -> Bool[np.ndarray, " n"]:
    """Which matches, given by their rays, lie within 4 px of the epipolar lines of two posed images."""
    b_from_a = b.cam_from_world() * a.cam_from_world().inverse()
    if b_from_a.translation.any():
        essential = pycolmap.essential_matrix_from_pose(b_from_a)
        squared = pycolmap.compute_squared_sampson_error(rays_a, rays_b, essential)
    else:  # the same photo twice: rays coincide
        moved = np.column_stack([rays_a, np.ones(len(rays_a))]) @ b_from_a.rotation.matrix().T
        squared = ((moved[:, :2] / moved[:, 2:] - rays_b) ** 2).sum(axis=1)
    cameras = camera_of(a), camera_of(b)
    allowed = max(_MAX_ERROR_PX * _scale(camera) / camera.mean_focal_length() for camera in cameras)
    return np.asarray(squared) < allowed**2


def _scale(camera: pycolmap.Camera) -> float:
    return max(1.0, max(camera.width, camera.height) / _FULL_SIZE)


def trusted_pairs(matches: Matches, names: Iterable[str]) -> set[Pair]:
    """The pairs of images whose matches are hard to doubt.

    Those of an image with its neighbors in order of name, if they have at least half as many matches as its
    strongest pair; otherwise its strongest pair.
    """
    count = {pair: len(matches[pair]) for pair in matches}
    neighbors = {(min(pair), max(pair)) for pair in pairwise(in_order(names))}
    of_image: dict[str, list[Pair]] = defaultdict(list)
    for pair in sorted(count):
        for name in pair:
            of_image[name].append(pair)
    trusted: set[Pair] = set()
    for pairs in of_image.values():
        strongest = max(pairs, key=count.__getitem__)
        near = [
            p
            for p in pairs
            if tuple(sorted(p)) in neighbors and count[p] >= _NEIGHBOR_SHARE * count[strongest]
        ]
        trusted.update(near or [strongest])
    return trusted


def common_points(model: pycolmap.Reconstruction, names: list[str]) -> csr_array:
    """Number of points that two of some posed images see, of shape [images, images]."""
    rows = {model_id: names.index(model.image(model_id).name) for model_id in model.reg_image_ids()}
    seen = {
        (rows[element.image_id], column)
        for column, point in enumerate(model.points3D.values())
        for element in point.track.elements
    }
    image_rows, columns = np.array(sorted(seen), np.int64).reshape(-1, 2).T
    ones = np.ones(len(image_rows), np.int32)
    observed = csr_array((ones, (image_rows, columns)), shape=(len(names), model.num_points3D()))
    return observed @ observed.T


def _pieces(common: csr_array) -> tuple[int, ...]:
    _, labels = connected_components(common >= MIN_COMMON_POINTS)
    return tuple(sorted(Counter(labels.tolist()).values(), reverse=True))


def pieces_of(model: pycolmap.Reconstruction, *, min_images: int) -> list[pycolmap.Reconstruction]:
    """The pieces of a model that hardly have a point in common, largest first, without small ones."""
    image_ids = sorted(model.reg_image_ids())
    if len(image_ids) < min_images or not model.num_points3D():
        return []
    names = [model.image(i).name for i in image_ids]
    _, labels = connected_components(common_points(model, names) >= MIN_COMMON_POINTS)
    counts = Counter(labels.tolist())
    if len(counts) == 1:
        return [model]
    large = [label for label, count in counts.most_common() if count >= min_images]
    return [
        _piece(model, {i for i, own in zip(image_ids, labels, strict=True) if own == one}) for one in large
    ]


def _piece(model: pycolmap.Reconstruction, image_ids: set[int]) -> pycolmap.Reconstruction:
    kept = pycolmap.Reconstruction(model)
    for image_id in sorted(set(model.reg_image_ids()) - image_ids):
        kept.deregister_frame(kept.image(image_id).frame_id)
    return kept


def _with_neighbors(names: Iterable[str], all_names: list[str], common: csr_array) -> tuple[str, ...]:
    rows = [all_names.index(name) for name in names]
    joined = np.flatnonzero((common[rows] >= MIN_COMMON_POINTS).sum(axis=0)) if rows else []
    return tuple(all_names[row] for row in sorted({*rows, *np.asarray(joined, np.int64).tolist()}))


def _triangulation_angle(model: pycolmap.Reconstruction) -> float:
    centers = {i: model.image(i).projection_center() for i in model.reg_image_ids()}
    points = [model.point3D(i) for i in sorted(model.point3D_ids())]
    angles = []
    for point in points[:: max(1, len(points) // _SAMPLED)]:
        seen_from = sorted({element.image_id for element in point.track.elements})
        rays = np.array([centers[i] for i in seen_from]) - point.xyz
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return float(np.median(angles)) if angles else 0.0


def _camera_spread(model: pycolmap.Reconstruction) -> float:
    centers = np.array([model.image(i).projection_center() for i in sorted(model.reg_image_ids())])
    if not model.num_points3D() or not len(centers):
        return 0.0
    points: Float64[np.ndarray, "n 3"] = np.array([point.xyz for point in model.points3D.values()])
    middle = np.median(centers, axis=0)
    depth = float(np.median(np.linalg.norm(points - middle, axis=1)))
    return float(np.linalg.norm(centers - middle, axis=1).max()) / max(depth, 1e-12)


def _focal_lengths(images: Mapping[str, pycolmap.Image]) -> dict[str, float]:
    first: dict[int, str] = {}
    for name in sorted(images):
        first.setdefault(images[name].camera_id, name)
    cameras = {name: camera_of(images[name]) for name in first.values()}
    found = {name: c.mean_focal_length() / max(c.width, c.height) for name, c in cameras.items()}
    by_length = sorted(found, key=lambda name: (found[name], name))
    listed = {by_length[place] for place in evenly_spaced(len(found), _LISTED_CAMERAS)}
    return {name: found[name] for name in sorted(listed)}
