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
from dataclasses import replace
from functools import cached_property
from itertools import chain
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.arrays import Points2D
from slimsfm.errors import ReconstructionError
from slimsfm.mapping import pair_subsets
from slimsfm.mapping.camera_groups import has_several_focal_lengths, own_camera, split_cameras
from slimsfm.mapping.choice import (
    Attempt,
    CheckedModel,
    best,
    explains_more,
    is_contradicted,
    rank,
    reached,
    registered,
)
from slimsfm.mapping.parallax import centered, share_without_parallax
from slimsfm.mapping.quality import WITHOUT_PARALLAX, turned
from slimsfm.mapping.scratch import copy_verified, verified_matches
from slimsfm.mapping.sfm import map_globally, map_incrementally
from slimsfm.mapping.support import MIN_AGREEING, Pair, agreement, measure, pieces_of, trusted_pairs
from slimsfm.progress import ProgressBar, silent, single_step

_MOST = 0.9  # share of the photos with which a right model is taken at once
_ENOUGH = 0.75  # share of the photos of contradicted models with which the search ends
_HALF = 0.5  # share of all photos with which it ends otherwise, after global mapping
_OVERLAPS = 10, 1  # neighbors in order of name
_SMALLEST = 3  # images of a model


def reconstruct(
    database: Path,
    names: list[str],
    workspace: Path,
    *,
    seed: int,
    split: bool = True,
    progress: ProgressBar = silent,
) -> list[CheckedModel]:
    """Reconstruct the images of a database.

    Args:
        database: Images, numbered from 1, with features and verified matches.
        names: Their names.
        workspace: Folder for intermediate files.
        seed: Seed of every random choice.
        split: Give photos of one camera several cameras if their focal lengths differ.
        progress: Progress callback.

    Returns:
        The right models, which hardly have images in common, largest first. If all are contradicted, the
        least contradicted one alone.

    Raises:
        ReconstructionError: No model is in one piece, with parallax and possible focal lengths.
    """
    workspace.mkdir(parents=True, exist_ok=True)
    return _Search(database, names, workspace, seed, split, progress).run()


class _Search:
    """Maps the images of a database in one way after the other until a model is right."""

    def __init__(
        self,
        database: Path,
        names: list[str],
        workspace: Path,
        seed: int,
        may_split: bool,
        progress: ProgressBar,
    ) -> None:
        self._database, self._names, self._workspace = database, names, workspace
        self._seed, self._progress = seed, progress
        self._may_split, self._split = may_split, ()
        self._ids = {name: image_id for image_id, name in enumerate(names, start=1)}
        self._matches = verified_matches(database, {i: name for name, i in self._ids.items()})

    def run(self) -> list[CheckedModel]:
        """Search, and return the right models or the least contradicted one."""
        first = self._with_right_cameras(self._check(self._map(self._database)))
        attempts, photos = [first], len(self._names)
        if registered(first) < _MOST * photos and self._matches:
            contradicted = is_contradicted(first)
            wanted = _ENOUGH * reached(first) if contradicted else _HALF * photos
            self._check_parallax()
            for attempt in self._ways() if contradicted else chain(self._globally(), self._ways(again=True)):
                attempts.append(attempt)
                if max(map(registered, attempts)) >= max(wanted, 1):
                    break
            found = best(attempts)
            if contradicted and not self._has_order():
                found = [replace(one, quality=replace(one.quality, ambiguous=True)) for one in found]
        else:
            found = best(attempts)
        return [replace(checked, split=self._split) for checked in found]

    def _check_parallax(self) -> None:
        """Check that the camera moved.

        Raises:
            ReconstructionError: Rotations explain the matches of most pairs of photos.
        """
        centered = {name: self._centered(name) for name in self._names}
        share = share_without_parallax(centered, self._matches)
        if share >= WITHOUT_PARALLAX:
            raise ReconstructionError(turned(share))

    def _centered(self, name: str) -> Points2D:
        return centered(self._keypoints[name], self._cameras[self._ids[name]])

    def _has_order(self) -> bool:
        """Whether most photos have most in common with their neighbors in order of name."""
        trusted = trusted_pairs(self._matches, self._names)
        neighbors = pair_subsets.neighbors(self._matches, self._names, overlap=1)
        return 2 * len(trusted & neighbors) >= len(trusted)

    def _map(
        self,
        database: Path,
        way: str = "",
        *,
        seed: int | None = None,
        start: pycolmap.Reconstruction | None = None,
    ) -> list[pycolmap.Reconstruction]:
        return map_incrementally(
            database,
            self._names,
            seed=self._seed if seed is None else seed,
            progress=self._progress,
            label=" ".join(["register images", way]).strip(),
            start=start,
        )

    def _check(self, models: list[pycolmap.Reconstruction], way: str = "") -> Attempt:
        """The models of an attempt, without the smallest, best first."""
        checked = [
            CheckedModel(model=piece, quality=measure(piece, self._matches, self._names), way=way)
            for model in models
            for piece in pieces_of(model, min_images=_SMALLEST)
        ]
        return sorted(checked, key=rank, reverse=True)

    def _with_right_cameras(self, first: Attempt) -> Attempt:
        """Another attempt with more cameras, if photos that share one have several focal lengths."""
        if not self._may_split or not first or not has_several_focal_lengths(first[0].model):
            return first
        shared = self._cameras
        own = {image_id: own_camera(camera, image_id) for image_id, camera in shared.items()}
        apart = self._check(self._map(self._copy("own-cameras", cameras=own), "with own cameras"))
        if not apart:
            return first
        split = split_cameras(apart[0].model, shared)
        database = self._copy("split-cameras", cameras=split)
        grouped = self._check(self._map(database, "with split cameras"))
        if not grouped or not grouped[0].is_right or not explains_more(grouped[0], first[0]):
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

    def _ways(self, *, again: bool = False) -> Iterator[Attempt]:
        """Attempts from some of the pairs, with other seeds and, unless it was done, globally."""
        for overlap in _OVERLAPS:
            pairs = pair_subsets.neighbors(self._matches, self._names, overlap=overlap)
            yield self._from_pairs(pairs, f"from neighbors in order of name, up to {overlap} apart")
        yield self._from_pairs(pair_subsets.strongest(self._matches, self._names), "from the strongest pairs")
        wide = pair_subsets.wide(self._matches, self._keypoints)
        yield self._from_pairs(wide, "from pairs whose matches cover their images")
        for seed in (self._seed + 1, self._seed + 2):
            way = f"with seed {seed}"
            yield self._check(self._map(self._database, way, seed=seed), way)
        if not again:
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
        models = self._check(self._map(self._copy("pairs", pairs=pairs), way), way)
        return sorted((self._extended(model) for model in models), key=rank, reverse=True)

    def _extended(self, start: CheckedModel) -> CheckedModel:
        """The model, with the matches that agree with it and the images that can be added to it."""
        if not start.is_right:
            return start
        images = {name: start.model.image(self._ids[name]) for name in start.images}
        agreeing = agreement(images, self._matches)
        pairs = {pair for pair in self._matches if agreeing.get(pair, 1.0) >= MIN_AGREEING}
        models = self._map(
            self._copy("extended", pairs=pairs), "from all pairs that agree", start=start.model
        )
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
