"""A data set of small objects with existing maps; other processes import it by name.

ROOT/OBJECT/map/          a map of a few images, from which the queries are held out
ROOT/OBJECT/object.json   the folder of the images, and which of them are queries
ROOT/OBJECT/broken        name of the failure when the object is read; optional
"""

import json
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slimsfm.datasets.base import LoadOptions, ObjectSequences, PosedSequence
from slimsfm.errors import InputError
from slimsfm.evaluation.benchmark import BenchmarkOptions, BenchmarkSetup
from slimsfm.evaluation.run import run_benchmark
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import ProgressBar

OPTIONS = BenchmarkOptions(strategies=("direct",), variants=("full", "dominating", "points:100"))
FAILURES = {
    "input": InputError("its box is missing"),
    "bug": RuntimeError("it is broken"),
    "interrupt": KeyboardInterrupt(),
}


@dataclass(frozen=True, kw_only=True)
class TinyDataset:
    path: Path

    def names(self) -> tuple[str, ...]:
        found = sorted(path.name for path in self.path.iterdir())
        if not found:
            raise InputError(f"{self.path} holds no object")
        return tuple(found)

    def load(self, name: str, options: LoadOptions) -> ObjectSequences:  # noqa: ARG002
        broken = self.path / name / "broken"
        if broken.exists():
            raise FAILURES[broken.read_text()]
        truth = read_map(self.path / name / "map")
        known = json.loads((self.path / name / "object.json").read_text())
        mapping = [image for image in truth.images if image not in known["queries"]]
        return ObjectSequences(
            name=name,
            mapping=_sequence(truth, Path(known["photos"]), mapping),
            query=_sequence(truth, Path(known["photos"]), known["queries"]),
            box=truth.box,
            truth=truth,
        )


def _sequence(truth: Map, folder: Path, names: list[str]) -> PosedSequence:
    return PosedSequence(
        folder=folder,
        names=tuple(names),
        cameras=tuple(truth.camera(name) for name in names),
        cam_from_world=tuple(truth.images[name].cam_from_world() for name in names),
    )


def add_object(root: Path, name: str, map: Map, photos: Path, queries: list[str], others: list[str]) -> None:
    """Make an object of some images of a map."""
    write_map(keep_images(map, [*queries, *others]), root / name / "map")
    (root / name / "object.json").write_text(json.dumps({"photos": str(photos), "queries": queries}))


def doing_at(stage: str, time: int, do: Callable[[], object]) -> ProgressBar:
    """A progress bar that calls `do` when a stage begins for the n-th time."""
    begun = []

    def progress(items, label):
        begun.append(label.startswith(stage))
        if begun[-1] and sum(begun) == time:
            do()
        return iter(items)

    return progress


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    root, run, stage, time = sys.argv[1:]
    progress = doing_at(stage, int(time), die)
    run_benchmark(
        TinyDataset(path=Path(root)), BenchmarkSetup(folder=Path(run), options=OPTIONS, progress=progress)
    )
