"""How long does `build` take with one and with two workers, and against an earlier version?

    git worktree add /tmp/before v0.1.0
    python benchmarks/build_speed.py PHOTOS... --before /tmp/before/src

Runs one command after the other. Prints, for each folder of photos, the seconds of each stage, the processor
time of all processes, and what the map holds; of several rounds, the medians. Processor time depends less on
what else the machine does.
"""

import argparse
import os
import re
import resource
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from statistics import median
from time import perf_counter

from slimsfm.files import remove
from slimsfm.mapping.io import read_map

HERE = Path(__file__).parents[1] / "src"
LINE = re.compile(r"(.+?): (?:\d+ of \d+ in|done after) ([\d.]+) s")
STAGES: dict[str, str] = {"extract features": "extraction", "match pairs": "matching"}  # all others: mapping

Seconds = dict[str, float]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="+", help="folders of photos")
    parser.add_argument("--before", type=Path, help="folder src of the earlier version")
    parser.add_argument("-o", "--output", type=Path, default=Path("/tmp/build-speed"))
    parser.add_argument("--rounds", type=int, default=1)
    arguments = parser.parse_args()
    for photos in arguments.photos:
        compare(photos, arguments.output / photos.resolve().name, arguments.before, arguments.rounds)


def compare(photos: Path, output: Path, before: Path | None, rounds: int) -> None:
    """Build one folder of photos in all ways, in turn, and print a table."""
    output.mkdir(parents=True, exist_ok=True)
    ways: dict[str, tuple[Path, list[str]]] = {"before": (before, [])} if before else {}
    ways |= {"1 worker": (HERE, ["--workers", "1"]), "2 workers": (HERE, ["--workers", "2"])}
    times: dict[str, list[Seconds]] = defaultdict(list)
    for turn in range(rounds):
        for way in sorted(ways, reverse=bool(turn % 2)):
            times[way].append(build(photos, output / way.replace(" ", "-"), *ways[way]))
    medians = {way: {key: median(one[key] for one in times[way]) for key in times[way][0]} for way in ways}
    print(f"\n{photos}")
    print("| | extraction | matching, verification | mapping | whole | processor | images | points | px |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for way, seconds in medians.items():
        model = read_map(output / way.replace(" ", "-")).model
        figures = (model.num_reg_images(), model.num_points3D(), model.compute_mean_reprojection_error())
        cells = [f"{one:.1f} s" for one in seconds.values()]
        print(f"| {way} | {' | '.join(cells)} | {figures[0]} | {figures[1]} | {figures[2]:.3f} |")
    one, two = medians["1 worker"], medians["2 workers"]
    shared = [seconds["extraction"] + seconds["matching"] for seconds in (one, two)]
    print(f"two workers: {shared[0] / shared[1]:.2f} times as fast in extraction, matching, verification")
    print(f"equal bytes: {contents(output / '1-worker') == contents(output / '2-workers')}")
    if before:
        whole, cpu = (medians["before"][key] / two[key] for key in ("whole", "processor"))
        print(f"against before: {whole:.2f} times as fast, {cpu:.2f} times less processor time", flush=True)


def build(photos: Path, output: Path, source: Path, options: list[str]) -> Seconds:
    """Build a map by the command; returns the seconds of each stage and of all."""
    remove(output)
    spent, start = processor_seconds(), perf_counter()
    command = [sys.executable, "-m", "slimsfm", "build", str(photos), "-o", str(output), *options]
    environment = {**os.environ, "PYTHONPATH": str(source)}
    done = subprocess.run(command, env=environment, check=True, stderr=subprocess.PIPE, text=True)
    whole, seconds = perf_counter() - start, {"extraction": 0.0, "matching": 0.0, "mapping": 0.0}
    for label, duration in LINE.findall(done.stderr):
        seconds[STAGES.get(label, "mapping")] += float(duration)
    return {**seconds, "whole": whole, "processor": processor_seconds() - spent}


def processor_seconds() -> float:
    """Processor time of all processes that ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def contents(folder: Path) -> dict[str, bytes]:
    """All files in a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


if __name__ == "__main__":
    main()
