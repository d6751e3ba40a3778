"""Models with their support, and which of them is taken."""

from dataclasses import dataclass

import pycolmap

from slimsfm.errors import InputError, ReconstructionError
from slimsfm.mapping.quality import ModelQuality

_LEAST = 0.1  # share of the photos that a model should contain
_SMALLEST_OTHER = 5  # images of models after the first
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


def rank(checked: CheckedModel) -> tuple:
    """Sort key: the larger, the better."""
    quality = checked.quality
    return (
        not quality.faults,
        _is_large(checked),
        -len(quality.contradictions),
        quality.registered,
        quality.median_observations,
    )


def explains_more(candidate: CheckedModel, first: CheckedModel) -> bool:
    """Whether a model has as many images as another, and fewer contradictions or more observations."""
    fewer = len(candidate.quality.contradictions) < len(first.quality.contradictions)
    observations = [one.model.compute_num_observations() for one in (candidate, first)]
    return candidate.quality.registered >= first.quality.registered and (
        fewer or observations[0] > _MORE * observations[1]
    )


def registered(attempt: Attempt) -> int:
    """Number of images in the right models of an attempt, without the smallest."""
    large = [checked for checked in attempt if checked.is_right and _is_large(checked)]
    return len({name for checked in large for name in checked.images})


def _is_large(checked: CheckedModel) -> bool:
    return checked.quality.registered >= _LEAST * checked.quality.given


def reached(attempt: Attempt) -> int:
    """Number of images in any model of an attempt."""
    return len({name for checked in attempt for name in checked.images})


def is_contradicted(attempt: Attempt) -> bool:
    """Whether a model of many photos is contradicted."""
    return any(checked.quality.contradictions and _is_large(checked) for checked in attempt)


def best(attempts: list[Attempt]) -> list[CheckedModel]:
    """The models of the attempt that registers most images rightly: right ones first, then contradicted ones.

    If no attempt has a right model, the least contradicted one alone.

    Raises:
        ReconstructionError: All models have faults or hardly any images.
    """
    attempt = max(attempts, key=registered)
    if registered(attempt):
        doubted = [one for one in attempt if one.quality.contradictions and not one.quality.faults]
        return _apart([one for one in attempt if one.is_right]) + _apart(doubted, but=attempt)
    usable = [checked for attempt in attempts for checked in attempt if not checked.quality.faults]
    large = [checked for checked in usable if _is_large(checked)]
    if not large:
        raise ReconstructionError(_faults(attempts))
    return [min(large, key=lambda one: (one.quality.contradicted_share, -one.quality.registered))]


def _apart(models: list[CheckedModel], but: Attempt | None = None) -> list[CheckedModel]:
    """Models most of whose images are in no larger one, nor in a right one of an attempt."""
    kept: list[CheckedModel] = []
    used = {name for checked in but or () if checked.is_right for name in checked.images}
    for checked in sorted(models, key=lambda checked: -checked.quality.registered):
        new = len(set(checked.images) - used)
        is_first = not kept and not but
        if is_first or (new >= _SMALLEST_OTHER and 2 * new > len(checked.images)):
            kept.append(checked)
            used.update(checked.images)
    return kept


def _faults(attempts: list[Attempt]) -> str:
    """What is wrong with the largest model, or the reason that there is none."""
    models = [checked for attempt in attempts for checked in attempt]
    if not models:
        return "no three photos could be joined"
    quality = max(models, key=lambda one: one.quality.registered).quality
    small = f"the largest model has only {quality.registered} of {quality.given} photos"
    return "; ".join(quality.faults) or small


@dataclass(frozen=True, kw_only=True, eq=False)
class PickedModel:
    """The model of a map, and what to say about it."""

    model: pycolmap.Reconstruction
    """The model; images have their names."""

    quality: ModelQuality
    """Its support."""

    elsewhere: frozenset[str]
    """Photos that are in other models."""

    notes: tuple[str, ...]
    """How it was mapped, and which other models there are."""


def pick_model(models: list[CheckedModel], number: int) -> PickedModel:
    """Pick a model by its number, from 1.

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
    if split := sorted(set(picked.split).intersection(picked.images)):
        notes.append(
            f"{len(split)} photos have another focal length than others of their camera, and got another "
            f"camera: {', '.join(split)}"
        )
    for other, checked in enumerate(models, start=1):
        if other != number:
            doubt = ", but matches contradict it" if checked.quality.contradictions else ""
            named = ", ".join(checked.images)
            notes.append(
                f"{len(checked.images)} photos form another model, which `model={other}` keeps"
                f"{doubt}: {named}"
            )
    return PickedModel(
        model=picked.model,
        quality=picked.quality,
        elsewhere=frozenset(name for one in models for name in one.images).difference(picked.images),
        notes=tuple(notes),
    )
