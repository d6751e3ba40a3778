"""Run a benchmark over all objects of a data set: resumable, and on several processes on request."""

import json
import logging
import os
import platform
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from slimsfm.datasets.base import Dataset
from slimsfm.errors import InputError, OutputError, SlimsfmError
from slimsfm.evaluation.benchmark import BenchmarkSetup, benchmark_object
from slimsfm.evaluation.result_files import (
    RESULT_FORMAT_VERSION,
    object_to_json,
    read_object_result,
    write_json,
)
from slimsfm.evaluation.results import Run, maps_path
from slimsfm.execution import OpenExecutor, run_tasks
from slimsfm.files import contents_of, inside, locked, read_json, remove
from slimsfm.progress import ProgressBar, silent

_LOGGER = logging.getLogger(__name__)

_PACKAGES = (
    *("slimsfm", "numpy", "scipy", "pycolmap", "poselib", "opencv-python-headless"),
    *("torch", "kornia", "transformers", "onnxruntime"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Task:
    """One object to measure; sent to another process if there is one."""

    dataset: Dataset
    name: str
    setup: BenchmarkSetup


def run_benchmark(
    dataset: Dataset,
    setup: BenchmarkSetup,
    open_executor: OpenExecutor | None = None,
    progress: ProgressBar = silent,
    *,
    overwrite: bool = False,
) -> Run:
    """Measure every object of a data set and write its results into the folder of the run.

    The results of finished objects stay in the folder. After an interruption the same call continues, and its
    result is the same except for times. An object that fails does not stop the others; its error is in
    `Run.failed`, and the next call tries it again.

    Args:
        dataset: The data set.
        setup: Folder of the run and options.
        open_executor: Opens the executor that measures objects; None measures them here, one after the other.
            Times are comparable only if nothing else runs.
        progress: Progress callback, called once per object.
        overwrite: Start from scratch if the folder holds a run with other options.

    Raises:
        OutputError: The folder holds a run with other options and `overwrite` is off, or other files, or
            another process is measuring into it.
        InputError: The data set has no object, or the results of a finished object are damaged.
    """
    names = dataset.names()
    _claim(setup.folder, _description(dataset, setup), overwrite=overwrite)
    with _alone_in(setup.folder):
        failed = _measure_all(dataset, setup, names, open_executor, progress)
        if len(list(setup.folder.iterdir())) == 1:  # only run.json: no object was measured
            remove(setup.folder)
        return _finished(dataset, setup, [name for name in names if name not in failed], failed)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Keep other processes from measuring into the folder of a run.

    Raises:
        OutputError: Another process does.
    """
    with locked(folder) as held:
        if held is False:
            raise OutputError(
                f"{folder}: another process is measuring into it; wait, or choose another output"
            )
        yield


def _measure_all(
    dataset: Dataset,
    setup: BenchmarkSetup,
    names: Sequence[str],
    open_executor: OpenExecutor | None,
    progress: ProgressBar,
) -> dict[str, str]:
    """Measure the objects that no earlier call has finished; returns the errors of those that failed."""
    todo = [name for name in names if not object_path(setup.folder, name).exists()]
    inner = replace(setup, progress=silent) if open_executor else setup
    tasks = [_Task(dataset=dataset, name=name, setup=inner) for name in todo]
    failed: dict[str, str] = {}
    with closing(run_tasks(_measure, tasks, open_executor)) as results:
        for _ in progress(tasks, "measure objects"):
            index, why = next(results)
            if why:
                failed[todo[index]] = why
    return failed


def object_path(folder: Path, name: str) -> Path:
    """File with the results of a finished object, inside the folder of a run."""
    return inside(folder / "objects", f"{name}.json")


def _measure(task: _Task) -> str | None:
    """Measure an object and write its results. On failure, remove its maps and return the error message."""
    try:
        sequences = task.dataset.load(task.name, task.setup.load_options(task.name))
        result = benchmark_object(sequences, task.setup)
        write_json(object_path(task.setup.folder, task.name), object_to_json(result))
    except OutputError:
        raise  # the folder of the run is the problem, not the object
    except SlimsfmError as error:
        why = str(error)
    except Exception as error:  # one broken object must not stop the others
        _LOGGER.exception("%s failed", task.name)
        why = f"{type(error).__name__}: {error}"
    else:
        return None
    remove(maps_path(task.setup.folder, task.name))  # a fix of the input may change them
    return why


def _description(dataset: Dataset, setup: BenchmarkSetup) -> dict:
    """The content of run.json: a folder holds the results of one data set and set of options."""
    described = {
        "format": RESULT_FORMAT_VERSION,
        "dataset": {"kind": type(dataset).__name__, **asdict(dataset)},  # pyright: ignore[reportArgumentType]
        "options": asdict(setup.options),
        "build": asdict(setup.build),
    }
    return json.loads(json.dumps(described, default=str))


def _claim(folder: Path, description: dict, *, overwrite: bool) -> None:
    """Write run.json into the folder, unless it already holds this run.

    Raises:
        OutputError: The folder holds another run and `overwrite` is off, or other files.
    """
    known = _read_description(folder / "run.json")
    if known == description:
        return
    if known is None and folder.exists() and not _is_empty(folder):
        raise OutputError(f"{folder}: exists already and is not a run; choose another output")
    if known is not None:
        if not overwrite:
            raise OutputError(
                f"{folder}: holds a run with other options; choose another output or pass `overwrite=True`"
            )
        with _alone_in(folder):
            remove(folder)
    write_json(folder / "run.json", description)


def _is_empty(folder: Path) -> bool:
    """Whether it is a folder without files, except hidden ones that a killed process left."""
    return folder.is_dir() and all(path.name.startswith(".") for path in folder.iterdir())


def _read_description(path: Path) -> dict | None:
    try:
        with contents_of(path, "is no run"):
            found = read_json(path)
    except InputError:
        return None
    return found if isinstance(found, dict) and "format" in found else None


def _finished(dataset: Dataset, setup: BenchmarkSetup, names: Sequence[str], failed: dict[str, str]) -> Run:
    return Run(
        folder=setup.folder,
        dataset=f"{type(dataset).__name__} {dataset.path.resolve().name}",
        options={**asdict(setup.options), "build": asdict(setup.build)},
        environment=describe_environment(),
        objects=tuple(read_object_result(object_path(setup.folder, name)) for name in names),
        failed=failed,
    )


def describe_environment() -> dict[str, str]:
    """Versions of the installed packages that compute results, and the machine."""
    found = {package: number for package in _PACKAGES if (number := _version(package))}
    return {
        **found,
        "python": platform.python_version(),
        "system": platform.platform(),
        "cpu": _cpu(),
        "cores": str(len(os.sched_getaffinity(0))),
        "gpu": _gpu(),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _gpu() -> str:
    """Names from nvidia-smi, because importing torch takes seconds."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return "none"
    command = [tool, "--query-gpu=name", "--format=csv,noheader"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return ", ".join(found.stdout.split("\n")[:-1]) or "none"
