"""A benchmark over all objects of a data set: object by object, resumable, on several processes if wanted."""

import json
import logging
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from slimsfm.datasets.base import Dataset
from slimsfm.errors import OutputError, SlimsfmError
from slimsfm.evaluation.benchmark import Bench, benchmark_object
from slimsfm.evaluation.environment import environment
from slimsfm.evaluation.result_files import (
    FORMAT_VERSION,
    object_to_json,
    read_object_result,
    write_json,
)
from slimsfm.evaluation.results import Run, maps_path
from slimsfm.execution import OpenExecutor, run_tasks
from slimsfm.files import remove
from slimsfm.progress import ProgressBar, silent

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Task:
    """One object to measure, wherever that is done."""

    dataset: Dataset
    name: str
    bench: Bench


def run_benchmark(
    dataset: Dataset,
    bench: Bench,
    open_executor: OpenExecutor | None = None,
    progress: ProgressBar = silent,
    *,
    overwrite: bool = False,
) -> Run:
    """Measure every object of a data set, and write what comes of it into the run's folder.

    An object that is done is kept there, so that the same call goes on where it was cut off, and gives the
    same but for times. One that fails is told of, tried again by the next call, and holds up no other.

    Args:
        dataset: The data set.
        bench: The folder of the run, and what is compared.
        open_executor: Where objects are measured; None: here, one after the other. Times are comparable only
            where nothing else runs.
        progress: Told of each object.
        overwrite: Start anew where the folder holds a run of other options.

    Raises:
        OutputError: The folder holds a run of other options and `overwrite` is off, or something else.
        InputError: The data set has no object, or the result of one that was done is damaged.
    """
    names = dataset.names()
    _claim(bench.folder, _asked(dataset, bench), overwrite=overwrite)
    todo = [name for name in names if not object_path(bench.folder, name).exists()]
    inner = replace(bench, progress=silent) if open_executor else bench
    tasks = [_Task(dataset=dataset, name=name, bench=inner) for name in todo]
    failed: dict[str, str] = {}
    with closing(run_tasks(_measure, tasks, open_executor)) as results:
        for _ in progress(tasks, "measure objects"):
            index, why = next(results)
            if why:
                failed[todo[index]] = why
    if len(list(bench.folder.iterdir())) == 1:  # nothing came of it but the note of what was asked
        remove(bench.folder)
    return _finished(dataset, bench, [name for name in names if name not in failed], failed)


def object_path(folder: Path, name: str) -> Path:
    """Where a run in a folder keeps the result of an object."""
    return folder / "objects" / f"{name}.json"


def _measure(task: _Task) -> str | None:
    """Measure an object and write its result; returns why it could not be, and then leaves no map of it."""
    try:
        sequences = task.dataset.load(task.name, task.bench.dataset_making(task.name))
        result = benchmark_object(sequences, task.bench)
        write_json(object_path(task.bench.folder, task.name), object_to_json(result))
    except OutputError:
        raise  # the folder of the run is at fault, not the object
    except SlimsfmError as error:
        why = str(error)
    except Exception as error:  # whatever is broken in one object, the others go on
        _LOGGER.exception("%s could not be measured", task.name)
        why = f"{type(error).__name__}: {error}"
    else:
        return None
    remove(maps_path(task.bench.folder, task.name))  # what is mended may be what they were made of
    return why


def _asked(dataset: Dataset, bench: Bench) -> dict:
    """What a run is of: a folder holds results of one such."""
    asked = {
        "format": FORMAT_VERSION,
        "dataset": {"kind": type(dataset).__name__, **asdict(dataset)},  # pyright: ignore[reportArgumentType]
        "options": asdict(bench.options),
        "build": asdict(bench.build),
    }
    return json.loads(json.dumps(asked, default=str))


def _claim(folder: Path, asked: dict, *, overwrite: bool) -> None:
    """Make the folder one of this run, unless it is that already.

    Raises:
        OutputError: It is of another run and `overwrite` is off, or it holds something else.
    """
    known = _read(folder / "run.json")
    if known == asked:
        return
    if known is None and folder.exists() and not _is_empty(folder):
        raise OutputError(f"{folder}: exists already and is no run; choose another output")
    if known is not None:
        if not overwrite:
            raise OutputError(
                f"{folder}: holds a run of other options; choose another output or pass `overwrite=True`"
            )
        remove(folder)
    write_json(folder / "run.json", asked)


def _is_empty(folder: Path) -> bool:
    """Whether it is a folder that holds nothing, but perhaps what a process that was killed left."""
    return folder.is_dir() and all(path.name.startswith(".") for path in folder.iterdir())


def _read(path: Path) -> dict | None:
    """What a run was of; None where there is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and "format" in found else None


def _finished(dataset: Dataset, bench: Bench, names: Sequence[str], failed: dict[str, str]) -> Run:
    return Run(
        folder=bench.folder,
        dataset=f"{type(dataset).__name__} {dataset.path.resolve().name}",
        options={**asdict(bench.options), "build": asdict(bench.build)},
        environment=environment(),
        objects=tuple(read_object_result(object_path(bench.folder, name)) for name in names),
        failed=failed,
    )
