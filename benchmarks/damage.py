"""Damage files of maps, runs, queries and other programs, and see what becomes of it.

    python benchmarks/damage.py -o /tmp/damage --mutations 2000

Each damaged file is read by a process of its own, as the commands would. Allowed are an error that the
command line reports in a line, and the result of the undamaged files. Files that nothing can check, because
the program that wrote them stores no checksums, may give other results, but never a traceback, a process
that dies, more than 10 s or more than 1 GB.

Prints a table by kind of file, and what went wrong.
"""

import argparse
import os
import pickle
import shutil
import signal
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from traceback import format_exc

from benchmark_scenes import rendered
from damage_subjects import Read, Sources, Subject, subjects
from mutations import mutations
from slimsfm import reduce
from slimsfm.datasets.synthetic import Synthetic
from slimsfm.errors import SlimsfmError
from slimsfm.evaluation.benchmark import BenchmarkOptions, BenchmarkSetup
from slimsfm.evaluation.result_files import write_results
from slimsfm.evaluation.run import run_benchmark
from slimsfm.graph import GraphOptions, compute_graph
from slimsfm.graph.io import write_graph
from slimsfm.mapping import read_map, write_map
from slimsfm.mapping.hloc import write_hloc
from slimsfm.photos import read_image
from slimsfm.progress import counted, shown

OBJECT = "boulder"
SECONDS, MEGABYTES = 10, 1000
FAILURES = "traceback", "died", "hung", "memory", "differs"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a damaged file."""

    result: str
    """same, refused, differs, traceback, died or hung."""

    detail: str = ""
    """The message of an error, or the traceback."""

    value: bytes = b""
    """What the reader returned."""

    megabytes: float = 0.0
    """Most memory that the process held, libraries included."""

    seconds: float = 0.0
    """How long it took."""


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--mutations", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", help="only these kinds of files")
    arguments = parser.parse_args()
    found = list(subjects(_sources(arguments.output), arguments.output))
    found = [one for one in found if not arguments.kinds or one.kind in arguments.kinds]
    share = max(1, arguments.mutations // len({one.kind for one in found}))
    outcomes: dict[str, list[Outcome]] = {}
    for subject in found:
        count = max(1, share // sum(one.kind == subject.kind for one in found))
        some = damaged(subject, arguments.output / "scratch", arguments.seed, count)
        with counted(shown, count, subject.kind) as advance_to:
            for number, (name, outcome) in enumerate(some, start=1):
                outcomes.setdefault(subject.kind, []).append(outcome)
                advance_to(number)
                if is_failure(subject, outcome):
                    print(f"{subject.kind}, {name}: {outcome.result}\n{outcome.detail}", flush=True)
    print(table(outcomes))


def here(read: Read, folder: Path) -> Outcome:
    """Use a folder in this process."""
    try:
        return Outcome(result="same", value=read(folder))
    except SlimsfmError as error:
        return Outcome(result="refused", detail=str(error))
    except Exception:
        return Outcome(result="traceback", detail=format_exc())


def alone(read: Read, folder: Path) -> Outcome:
    """Use a folder in a process of its own."""
    receiving, sending = os.pipe()
    start, process = perf_counter(), os.fork()
    if process == 0:
        signal.alarm(SECONDS)  # its default action ends the process
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        with open(sending, "wb") as pipe:
            pickle.dump(here(read, folder), pipe)
        os._exit(0)
    os.close(sending)
    with open(receiving, "rb") as pipe:
        data = pipe.read()
    _, status, usage = os.wait4(process, 0)
    seconds, megabytes = perf_counter() - start, usage.ru_maxrss / 1000
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        found = Outcome(result="hung" if number == signal.SIGALRM else "died", detail=f"signal {number}")
    else:
        found = pickle.loads(data)
    if megabytes > MEGABYTES:
        found = Outcome(result="memory", detail=f"{megabytes:.0f} MB, {found.result}: {found.detail}")
    return replace(found, seconds=seconds, megabytes=megabytes)


Use = Callable[[Read, Path], Outcome]
"""Uses a folder, in this process or in another."""


def damaged(
    subject: Subject, scratch: Path, seed: int, count: int, use: Use = alone
) -> Iterator[tuple[str, Outcome]]:
    """Damage the files of a subject in turn; yields what was done and what came of it."""
    shutil.rmtree(scratch, ignore_errors=True)
    shutil.copytree(subject.folder, scratch)
    expected = use(subject.read, scratch)
    if expected.result != "same":
        raise RuntimeError(f"{subject.kind}: the undamaged files are not usable: {expected.detail}")
    whole = {name: (scratch / name).read_bytes() for name in subject.files}
    each = {name: mutations(data, seed, count) for name, data in whole.items()}
    for number in range(count):
        name = subject.files[number % len(subject.files)]
        what, data = next(each[name])
        (scratch / name).write_bytes(data)
        outcome = use(subject.read, scratch)
        if outcome.result == "same" and outcome.value != expected.value:
            outcome = Outcome(result="differs", seconds=outcome.seconds, megabytes=outcome.megabytes)
        yield f"{name}, {what}", outcome
        (scratch / name).write_bytes(whole[name])


def is_failure(subject: Subject, outcome: Outcome) -> bool:
    """Whether an outcome must not be."""
    return outcome.result in FAILURES and not (outcome.result == "differs" and subject.may_differ)


def table(outcomes: dict[str, list[Outcome]]) -> str:
    """Counts by kind of file, and the most time and memory that one took."""
    results = "refused", "same", *reversed(FAILURES)
    lines = [f"| files | tried | {' | '.join(results)} | longest | most memory |", "|---" * 10 + "|"]
    for kind, some in outcomes.items():
        counts = Counter(one.result for one in some)
        longest, most = max(one.seconds for one in some), max(one.megabytes for one in some)
        numbers = " | ".join(str(counts[result]) for result in results)
        lines.append(f"| {kind} | {len(some)} | {numbers} | {longest:.1f} s | {most:.0f} MB |")
    return "\n".join(lines)


def _sources(output: Path) -> Sources:
    """Make the undamaged files, unless an earlier call did."""
    scene = rendered(OBJECT, output)
    found = Sources(
        full=output / f"{OBJECT}-map",
        slim=output / "slim",
        run=output / "run",
        photos=output / "photos",
        others=output / "others",
    )
    if not found.slim.exists():
        write_map(reduce(scene.references, progress=shown).map, found.slim)
    options = BenchmarkOptions(strategies=("direct",), variants=("full", "points:200"))
    dataset = Synthetic(path=output / "objects", objects=(OBJECT,))
    write_results(run_benchmark(dataset, BenchmarkSetup(folder=found.run, options=options, progress=shown)))
    found.photos.mkdir(exist_ok=True)
    write_photos(scene.queries[0].query.path, found.photos)
    write_others(found.full, found.others)
    return found


def write_photos(query: Path, folder: Path) -> None:
    """Write a query in the two formats that cameras and programs write most."""
    from PIL import Image

    for name in ("query.jpg", "query.png"):
        Image.fromarray(read_image(query)).save(folder / name)


def write_others(map_path: Path, folder: Path) -> None:
    """Write what other programs would: hloc's files, a text model, a graph, a camera, a box and gravity."""
    full = read_map(map_path)
    write_hloc(full, folder, overwrite=True)
    (folder / "text").mkdir()
    full.model.write_text(folder / "text")
    write_graph(folder / "graph.npz", compute_graph(full, GraphOptions()).graph)
    camera = full.cameras[0].camera
    numbers = " ".join(map(str, camera.params))
    (folder / "camera.txt").write_text(f"1 {camera.model_name} {camera.width} {camera.height} {numbers}\n")
    (folder / "box.json").write_text(str(full.box.corners.tolist()))
    (folder / "gravity.json").write_text('{"world": [0, 0, 1], "images": {"query.jpg": [0, 1, 0]}}')


if __name__ == "__main__":
    main()
