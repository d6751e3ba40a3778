"""Reconstruct photos to the model that their matches support best.

Incremental mapping [1] of all pairs is right for good photos. Where its model is contradicted (see
`mapping.support`), the same matches are mapped again in other ways, each of which avoids a kind of wrong
pair:

    neighbors     look-alike parts are photographed at different times: only neighbors in order of name
    strongest     a spanning tree of the pairs with the most matches, and two pairs of each image
    wide          look-alike prints match without their surroundings: only pairs that cover their images
    another seed  the first pair of images was wrong
    global        there is no good first pair [2]

Pairs that were left out are then added as far as the model bears them out. Before, photos that share a camera
but have several focal lengths get several cameras.

References:
    [1] Schoenberger and Frahm, Structure-from-Motion Revisited, CVPR 2016.
    [2] Pan, Barath, Pollefeys and Schoenberger, Global Structure-from-Motion Revisited, ECCV 2024.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.arrays import Points2D
from slimsfm.errors import InputError, ReconstructionError
from slimsfm.mapping import pair_subsets
from slimsfm.mapping.camera_groups import has_several_focal_lengths, own_camera, split_cameras
from slimsfm.mapping.quality import ModelQuality
from slimsfm.mapping.sfm import copy_verified, map_globally, map_incrementally, verified_matches
from slimsfm.mapping.support import MIN_AGREEING, Pair, agreement, largest_piece, measure
from slimsfm.progress import ProgressBar, silent, single_step

_MOST = 0.9  # share of the photos with which a right model is taken at once
_LEAST = 0.1  # share of the photos that a model should contain
_ENOUGH = 0.75  # share of the photos of contradicted models with which the search ends
_OVERLAPS = 10, 1  # neighbors in order of name
_SMALLEST, _SMALLEST_OTHER = 3, 5  # images of the first model, and of others
_MORE = 1.01  # times the observations with which several cameras explain the photos better than one


@dataclass(frozen=True, kw_only=True, eq=False)
class CheckedModel:
    """A model and what supports it."""

    model: pycolmap.Reconstruction
    """The model; images have their names."""

    quality: ModelQuality
    """Its support."""

    way: str = ""
    """How it was mapped, if not incrementally from all pairs."""

    split: tuple[str, ...] = ()
    """Photos that got another camera than the others, because their focal length differs."""

    @property
    def is_right(self) -> bool:
        """Whether nothing contradicts the model."""
        return not self.quality.faults and not self.quality.contradictions

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the images of the model, sorted."""
        return tuple(sorted(self.model.image(i).name for i in self.model.reg_image_ids()))


Attempt = list[CheckedModel]
"""The models of one way to map, best first."""


def reconstruct(
    database: Path, names: list[str], workspace: Path, *, seed: int, progress: ProgressBar = silent
) -> list[CheckedModel]:
    """Reconstruct the images of a database.

    Returns:
        The right models, which hardly have images in common, largest first. If all are contradicted, the
        least contradicted one alone.

    Raises:
        ReconstructionError: No model is in one piece, with parallax and possible focal lengths.
    """
    workspace.mkdir(parents=True, exist_ok=True)
    return _Search(database, names, workspace, seed, progress).run()


def pick_model(models: list[CheckedModel], number: int) -> tuple[pycolmap.Reconstruction, tuple[str, ...]]:
    """The model with a number, from 1, and notes on how it was mapped and on the other models.

    Raises:
        InputError: There are not that many models.
    """
    if number > len(models):
        sizes = ", ".join(str(one.quality.registered) for one in models)
        raise InputError(
            f"model must be at most {len(models)}, got {number}: these photos give models of {sizes} images"
        )
    picked = models[number - 1]
    notes = [f"the photos were mapped {picked.way}"] if picked.way else []
    if picked.split:
        notes.append(
            f"{len(picked.split)} photos have another focal length than others of their camera, and got "
            f"another camera: {', '.join(picked.split)}"
        )
    for other, checked in enumerate(models, start=1):
        if other != number:
            notes.append(
                f"{checked.quality.registered} photos form another model, which `model={other}` keeps: "
                f"{', '.join(checked.images)}"
            )
    return picked.model, tuple(notes)


class _Search:
    """Maps the images of a database in one way after the other until a model is right."""

    def __init__(
        self, database: Path, names: list[str], workspace: Path, seed: int, progress: ProgressBar
    ) -> None:
        self._database, self._names, self._workspace = database, names, workspace
        self._seed, self._progress, self._split = seed, progress, ()
        self._ids = {name: image_id for image_id, name in enumerate(names, start=1)}
        self._matches = verified_matches(database, {i: name for name, i in self._ids.items()})

    def run(self) -> list[CheckedModel]:
        """Search, and return the right models or the least contradicted one."""
        first = self._with_right_cameras(self._check(self._map(self._database)))
        attempts = [first]
        partly_right = bool(first) and first[0].is_right
        wanted = _MOST * len(self._names) if partly_right else _ENOUGH * _reached(first)
        if not _registered(first) >= max(_MOST * len(self._names), 1) and self._matches:
            for attempt in self._globally() if partly_right else self._ways():
                attempts.append(attempt)
                if _registered(attempt) >= max(wanted, 1):
                    break
        return [replace(checked, split=self._split) for checked in _best(attempts)]

    def _map(
        self, database: Path, *, seed: int | None = None, start: pycolmap.Reconstruction | None = None
    ) -> list[pycolmap.Reconstruction]:
        seed = self._seed if seed is None else seed
        return map_incrementally(database, self._names, seed=seed, progress=self._progress, start=start)

    def _check(self, models: list[pycolmap.Reconstruction], way: str = "") -> Attempt:
        """The models of an attempt, without the smallest, best first."""
        least = min(_SMALLEST, len(self._names))
        pieces = [largest_piece(model) for model in models if model.num_reg_images() >= least]
        checked = [
            CheckedModel(model=model, quality=measure(model, self._matches, self._names), way=way)
            for model in pieces
            if model.num_reg_images() >= least and model.num_points3D()
        ]
        return sorted(checked, key=_rank, reverse=True)

    def _with_right_cameras(self, first: Attempt) -> Attempt:
        """Another attempt with more cameras, if photos that share one have several focal lengths."""
        if not first or not has_several_focal_lengths(first[0].model):
            return first
        shared = self._cameras
        own = {image_id: own_camera(camera, image_id) for image_id, camera in shared.items()}
        apart = self._check(self._map(self._copy("own-cameras", cameras=own)))
        if not apart:
            return first
        split = split_cameras(apart[0].model, shared)
        database = self._copy("split-cameras", cameras=split)
        grouped = self._check(self._map(database))
        if not grouped or not grouped[0].is_right or not _explains_more(grouped[0], first[0]):
            return first
        self._database, self._split = database, _smaller_groups(split, shared, self._names)
        return grouped

    @cached_property
    def _cameras(self) -> dict[int, pycolmap.Camera]:
        with pycolmap.Database.open(self._database) as database:
            return {
                image.image_id: database.read_camera(image.camera_id) for image in database.read_all_images()
            }

    def _copy(
        self,
        name: str,
        *,
        pairs: set[Pair] | None = None,
        cameras: dict[int, pycolmap.Camera] | None = None,
    ) -> Path:
        target = self._workspace / f"{name}.db"
        kept = None if pairs is None else {(self._ids[a], self._ids[b]) for a, b in pairs}
        copy_verified(self._database, target, pairs=kept, cameras=cameras)
        return target

    def _ways(self) -> Iterator[Attempt]:
        for overlap in _OVERLAPS:
            pairs = pair_subsets.neighbors(self._matches, self._names, overlap=overlap)
            yield self._from_pairs(pairs, f"from neighbors in order of name, up to {overlap} apart")
        yield self._from_pairs(pair_subsets.strongest(self._matches, self._names), "from the strongest pairs")
        wide = pair_subsets.wide(self._matches, self._keypoints)
        yield self._from_pairs(wide, "from pairs whose matches cover their images")
        for seed in (self._seed + 1, self._seed + 2):
            yield self._check(self._map(self._database, seed=seed), f"with seed {seed}")
        yield from self._globally()

    @cached_property
    def _keypoints(self) -> dict[str, Points2D]:
        with pycolmap.Database.open(self._database) as database:
            return {
                name: np.asarray(database.read_keypoints(i), np.float64)[:, :2]
                for name, i in self._ids.items()
            }

    def _globally(self) -> Iterator[Attempt]:
        with single_step(self._progress, "reconstruct globally"):
            models = map_globally(self._database, self._names, seed=self._seed)
        yield self._check(models, "globally")

    def _from_pairs(self, pairs: set[Pair], way: str) -> Attempt:
        """Map some pairs, and extend the models by all pairs that they bear out."""
        models = self._check(self._map(self._copy("pairs", pairs=pairs)), way)
        return sorted((self._extended(model) for model in models), key=_rank, reverse=True)

    def _extended(self, start: CheckedModel) -> CheckedModel:
        """The model, with the matches that agree with it and the images that can be added to it."""
        if not start.is_right:
            return start
        images = {name: start.model.image(self._ids[name]) for name in start.images}
        agreeing = agreement(images, self._matches)
        pairs = {pair for pair in self._matches if agreeing.get(pair, 1.0) >= MIN_AGREEING}
        models = self._map(self._copy("extended", pairs=pairs), start=start.model)
        for extended in self._check(models, start.way):
            if extended.is_right and extended.quality.registered >= start.quality.registered:
                return extended
        return start


def _smaller_groups(
    split: Mapping[int, pycolmap.Camera], shared: Mapping[int, pycolmap.Camera], names: list[str]
) -> tuple[str, ...]:
    """Names of the photos whose camera is not the most frequent one of those that a camera was split into."""
    counts = Counter((shared[i].camera_id, camera.camera_id) for i, camera in split.items())
    largest: dict[int, int] = {}
    for (before, after), _ in sorted(counts.items(), key=lambda item: (-item[1], item[0])):
        largest.setdefault(before, after)
    return tuple(names[i - 1] for i in sorted(split) if split[i].camera_id != largest[shared[i].camera_id])


def _rank(checked: CheckedModel) -> tuple:
    quality = checked.quality
    return (
        not quality.faults,
        _is_large(checked),
        -len(quality.contradictions),
        quality.registered,
        quality.median_observations,
    )


def _explains_more(candidate: CheckedModel, first: CheckedModel) -> bool:
    fewer = len(candidate.quality.contradictions) < len(first.quality.contradictions)
    observations = [one.model.compute_num_observations() for one in (candidate, first)]
    return candidate.quality.registered >= first.quality.registered and (
        fewer or observations[0] > _MORE * observations[1]
    )


def _registered(attempt: Attempt) -> int:
    """Number of images in the right models of an attempt, without the smallest."""
    large = [checked for checked in attempt if checked.is_right and _is_large(checked)]
    return len({name for checked in large for name in checked.images})


def _is_large(checked: CheckedModel) -> bool:
    return checked.quality.registered >= _LEAST * checked.quality.given


def _reached(attempt: Attempt) -> int:
    """Number of images in any model of an attempt."""
    return len({name for checked in attempt for name in checked.images})


def _best(attempts: list[Attempt]) -> list[CheckedModel]:
    attempt = max(attempts, key=_registered)
    if _registered(attempt):
        return _apart([checked for checked in attempt if checked.is_right])
    usable = [checked for attempt in attempts for checked in attempt if not checked.quality.faults]
    if not usable:
        raise ReconstructionError(_faults(attempts))
    usable = [checked for checked in usable if _is_large(checked)] or usable
    return [
        min(usable, key=lambda checked: (checked.quality.contradicted_share, -checked.quality.registered))
    ]


def _apart(models: list[CheckedModel]) -> list[CheckedModel]:
    """Models most of whose images are not in a larger one."""
    kept: list[CheckedModel] = []
    used: set[str] = set()
    for checked in sorted(models, key=lambda checked: -checked.quality.registered):
        new = len(set(checked.images) - used)
        if not kept or (new >= _SMALLEST_OTHER and 2 * new > len(checked.images)):
            kept.append(checked)
            used.update(checked.images)
    return kept


def _faults(attempts: list[Attempt]) -> str:
    """What is wrong with the largest model, or the reason that there is none."""
    models = [checked for attempt in attempts for checked in attempt]
    if not models:
        return "no three photos could be joined"
    return "; ".join(max(models, key=lambda one: one.quality.registered).quality.faults)
