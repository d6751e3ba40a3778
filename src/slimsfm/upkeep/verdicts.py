"""Which poses of a map are wrong, decided jointly.

An image is tried by up to three disjoint sets of the other images. A set contradicts the pose that the map
has if the pose it gives is far off, compared with what is predicted and with how far off poses of this map
usually are, and if fewer than half of its matches also agree with the pose of the map.

A part that hangs on the rest by contradicted pairs alone confirms itself, so it is tried by the rest first.
Where one pose is wrong, right ones may be contradicted by it. So the worst images are taken out first, with
all they contributed, and their neighbors are tried again. In the end each image that was taken out is tried
by those that are left, and comes back if they confirm it.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from slimsfm.geometry import Box, corner_error
from slimsfm.progress import ProgressBar, counted
from slimsfm.upkeep.witnesses import Testimony, Witnesses

_SETS = 3  # of references, disjoint
_AGREEING = 0.5  # share of the matches of a set below which it contradicts a pose
_SIGMAS = 6.0  # times the usual error: no error is as large by chance
_ROUNDS = 3  # of bringing images back


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """What the other images say about the pose of an image."""

    testimonies: tuple[Testimony, ...]
    """By disjoint sets of references; empty if none localizes the image."""

    together: Testimony | None
    """By all of them."""

    contradicting: tuple[Testimony, ...]
    """Those that contradict the pose of the map and agree with each other."""

    together_contradicts: bool = False
    """Whether all together contradict it."""

    @property
    def is_contradicted(self) -> bool:
        """Whether several sets of references, more than confirm it, and all together say it is wrong."""
        if not self.together_contradicts:
            return False
        against, heard = len(self.contradicting), len(self.testimonies)
        return against >= min(2, max(heard, 1)) and 2 * against > heard

    @property
    def blame(self) -> float:
        """Share of the matches that agree with a pose of the others but not with that of the map."""
        inliers = sum(one.inliers for one in self.testimonies)
        return sum(one.inliers - one.agreeing for one in self.contradicting) / max(inliers, 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Verdicts:
    """The images whose poses are wrong, and what the right ones say about each image."""

    wrong: tuple[int, ...]
    """Indices of the images whose poses are contradicted."""

    trials: tuple[Trial, ...]
    """The trial of each image without the wrong ones."""

    usual: float
    """How far off poses usually are in this map, over the predicted error; at least 1."""


class Court:
    """Tries images until no pose is contradicted by images that are not contradicted themselves."""

    def __init__(self, witnesses: Witnesses, box: Box, progress: ProgressBar) -> None:
        self._witnesses = witnesses
        self._box = box
        self._progress = progress
        self._usual = 1.0
        self._count = len(witnesses.names)

    def decide(self, parts: Sequence[Collection[str]] = ()) -> Verdicts:
        """Find the wrong poses.

        Args:
            parts: Images that confirm each other but may be wrong together; the others try them first.
        """
        numbers = range(self._count)
        sworn = [self._hear(i) for i in self._progress(numbers, "localize images from the others")]
        self._usual = _usual_ratio(sworn)
        trials = {i: self._judge(one) for i, one in zip(numbers, sworn, strict=True)}
        wrong: set[int] = set()
        for part in parts:
            wrong |= self._misplaced({i for i in numbers if self._witnesses.names[i] in part})
        if wrong:
            self._retry(trials, wrong, wrong)
        with counted(self._progress, self._count, "take out wrong poses") as advance_to:
            while worst := self._worst(trials, wrong):
                wrong |= worst
                advance_to(len(wrong))
                self._retry(trials, worst, wrong)
        for _ in range(_ROUNDS):
            back = {i for i in sorted(wrong) if not self._try_again(trials, i).is_contradicted}
            if not back:
                break
            wrong -= back
            self._retry(trials, back, wrong)
            wrong |= {i for i in trials if trials[i].is_contradicted}
            self._witnesses.suspect(wrong)
        return Verdicts(
            wrong=tuple(sorted(wrong)), trials=tuple(trials[i] for i in numbers), usual=self._usual
        )

    def reconsider(self, verdicts: Verdicts, unreliable: Collection[int]) -> Verdicts:
        """Try the images with wrong poses again, by images that are neither wrong nor unreliable.

        Those that none of these localizes stay wrong, as they were tried before.
        """
        self._witnesses.suspect({*verdicts.wrong, *unreliable})
        trials = list(verdicts.trials)
        for i in verdicts.wrong:
            again = self._judge(self._hear(i))
            trials[i] = again if again.testimonies else trials[i]
        wrong = tuple(i for i in verdicts.wrong if trials[i].is_contradicted)
        return Verdicts(wrong=wrong, trials=tuple(trials), usual=verdicts.usual)

    def _misplaced(self, part: set[int]) -> set[int]:
        """Those of a part whose poses all others contradict, if these are most of the ones they localize."""
        self._witnesses.suspect(part)
        tried = {i: self._judge(self._hear(i)) for i in sorted(part)}
        against = {i for i, one in tried.items() if one.is_contradicted}
        return against if 2 * len(against) > sum(bool(one.testimonies) for one in tried.values()) else set()

    def _retry(self, trials: dict[int, Trial], changed: set[int], wrong: set[int]) -> None:
        """Try those images again that have matches with images that were taken out or brought back."""
        self._witnesses.suspect(wrong)
        near = {other for one in changed for other in self._witnesses.neighbors(one)}
        for i in sorted(near | changed):
            self._try_again(trials, i)

    def _worst(self, trials: dict[int, Trial], wrong: set[int]) -> set[int]:
        """Contradicted images that are more to blame than all contradicted images they have matches with."""
        blame = {i: one.blame for i, one in trials.items() if i not in wrong and one.is_contradicted}
        return {
            i
            for i in blame
            if all(
                (blame[i], -i) > (blame[other], -other)
                for other in self._witnesses.references(i)
                if other in blame
            )
        }

    def _try_again(self, trials: dict[int, Trial], index: int) -> Trial:
        """The new trial of an image; the former one, if what is left of the others does not localize it."""
        trial = self._judge(self._hear(index))
        if trial.testimonies or not trials[index].is_contradicted:
            trials[index] = trial
        return trials[index]

    def _hear(self, index: int) -> list[Testimony]:
        """Testimonies of disjoint sets of references, if each gives one, then the one of all together."""
        references = self._witnesses.references(index)
        together = self._witnesses.testimony(index, references) if references else None
        if together is None:
            return []
        for number in range(min(_SETS, len(references)), 1, -1):
            sets = [references[start::number] for start in range(number)]
            found = [one for one in (self._witnesses.testimony(index, some) for some in sets) if one]
            if len(found) == number:
                return [*found, together]
        return [together]

    def _judge(self, heard: Sequence[Testimony]) -> Trial:
        if not heard:
            return Trial(testimonies=(), together=None, contradicting=())
        sets, together = heard[:-1] or heard, heard[-1]
        against = [one for one in sets if self._contradicts(one)]
        return Trial(
            testimonies=tuple(sets),
            together=together,
            contradicting=tuple(self._agreeing(against)),
            together_contradicts=self._contradicts(together),
        )

    def _contradicts(self, one: Testimony) -> bool:
        is_far = one.distance > _SIGMAS * self._usual * one.predicted_error
        return is_far and one.agreeing < _AGREEING * one.inliers

    def _agreeing(self, found: list[Testimony]) -> list[Testimony]:
        """The testimonies that agree with another one; a single one agrees with itself."""
        if len(found) < 2:
            return found
        close = {
            i
            for (i, a), (j, b) in combinations(enumerate(found), 2)
            if corner_error(a.cam_from_world, b.cam_from_world, self._box) < 0.5 * min(a.distance, b.distance)
            for i in (i, j)
        }
        return [found[i] for i in sorted(close)]


def _usual_ratio(heard: Sequence[Sequence[Testimony]]) -> float:
    """The median, over all testimonies, of the distance to the pose of the map over the predicted error."""
    ratios = [one.distance / max(one.predicted_error, 1e-12) for some in heard for one in some]
    return max(1.0, float(np.median(ratios))) if ratios else 1.0
