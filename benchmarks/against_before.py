"""Is this version slower than an earlier one? Opening a map, localizing, reducing, both in one run.

    git worktree add /tmp/before v0.1.0
    python benchmarks/against_before.py MAP QUERIES --before /tmp/before/src

Each version has a process of its own. They take turns, so that what else the machine does hits both. Each
reads the map as it wrote it itself: checksums are checked by a version that stores them.

Prints medians, and the median of the ratios of turns.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import median

WORKER = """
import json, sys
from pathlib import Path
from time import perf_counter
from threadpoolctl import threadpool_limits
threadpool_limits(1)
from slimsfm import Localizer, read_image, read_map, reduce
from slimsfm.files import remove
from slimsfm.mapping import write_map
where, queries, copy = map(Path, sys.argv[1:])
remove(copy)
write_map(read_map(where), copy)
photos = [read_image(path) for path in sorted(queries.iterdir())[:8]]
localizer = Localizer(read_map(copy))
features = [(localizer.extractor.extract(photo), localizer.camera_of(photo)) for photo in photos]

def localize():
    for found, camera in features:
        localizer.localize_features(found, camera)

work = {"open": lambda: read_map(copy), "localize": localize, "reduce": lambda: reduce(read_map(copy))}
work["localize"]()
for line in sys.stdin:
    start = perf_counter()
    work[line.strip()]()
    print(perf_counter() - start, flush=True)
"""


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("queries", type=Path)
    parser.add_argument("--before", type=Path, required=True, help="folder src of the earlier version")
    parser.add_argument("-o", "--output", type=Path, default=Path("/tmp/against-before"))
    parser.add_argument("--rounds", type=int, default=20, help="turns of opening and localizing")
    parser.add_argument("--reductions", type=int, default=1, help="turns of reducing")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    sources = {"before": arguments.before, "now": Path(__file__).parents[1] / "src"}
    workers = {
        name: subprocess.Popen(
            [sys.executable, "-c", WORKER, arguments.map, arguments.queries, arguments.output / name],
            env={**os.environ, "PYTHONPATH": str(source)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for name, source in sources.items()
    }
    for what, rounds in (
        ("open", arguments.rounds),
        ("localize", arguments.rounds),
        ("reduce", arguments.reductions),
    ):
        seconds: dict[str, list[float]] = {name: [] for name in workers}
        if not rounds:
            continue
        for turn in range(rounds):
            for name in sorted(workers, reverse=bool(turn % 2)):
                seconds[name].append(_timed(workers[name], what))
        ratios = [now / before for before, now in zip(seconds["before"], seconds["now"], strict=True)]
        medians = ", ".join(f"{name} {1e3 * median(some):.1f} ms" for name, some in seconds.items())
        print(f"{what}: {medians}, ratio {median(ratios):.3f}", flush=True)
    for worker in workers.values():
        worker.communicate()


def _timed(worker: subprocess.Popen[str], what: str) -> float:
    if worker.stdin is None or worker.stdout is None:
        raise RuntimeError("the worker has no pipes")
    worker.stdin.write(what + "\n")
    worker.stdin.flush()
    return json.loads(worker.stdout.readline())


if __name__ == "__main__":
    main()
