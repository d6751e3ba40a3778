"""Two processes write one map over and over while three read it: what does each of them see?

    python benchmarks/writers_and_readers.py MAP SMALL -o /tmp/race --seconds 60

Each writer writes one of the two maps to the same path. A read must give one of them, whole: the same poses,
points, features and matches. The same is done with a file of poses, which each writer fills with its own.

Prints how many writes and reads there were, and what they ended with.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from time import monotonic

from slimsfm.errors import SlimsfmError
from slimsfm.files import remove, replacing
from slimsfm.mapping import Map, read_map, write_map

WRITERS, READERS = 2, 3
LINES = 20_000


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("maps", nargs=WRITERS, type=Path)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--seconds", type=float, default=60)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    for what, write, read in (("map", write_one, content_of), ("file", write_lines, lines_of)):
        path = arguments.output / what
        remove(path)
        write(arguments.maps[0], path)
        whole = {read(path)}
        remove(path)
        write(arguments.maps[1], path)
        whole.add(read(path))
        work = [(write, (source, path)) for source in arguments.maps] + [(read, (path,))] * READERS
        with ProcessPoolExecutor(len(work), get_context("spawn")) as pool:
            jobs = [pool.submit(repeated, *one, arguments.seconds) for one in work]
            found = [job.result() for job in jobs]
        for name, counts in (("writes", found[:WRITERS]), ("reads", found[WRITERS:])):
            total = sum(counts, Counter())
            good = {key: number for key, number in total.items() if key in whole or key == "None"}
            bad = {key: number for key, number in total.items() if key not in good}
            print(f"{what}: {sum(good.values())} {name} whole, {sum(bad.values())} not: {bad}")
        print(f"{what}: left beside it: {[one.name for one in arguments.output.iterdir() if one != path]}")
        remove(path)


def repeated(work: Callable[..., str | None], given: tuple[Path, ...], seconds: float) -> Counter[str]:
    """Do something over and over, and count what comes out."""
    end, found = monotonic() + seconds, Counter[str]()
    while monotonic() < end:
        try:
            found[str(work(*given))] += 1
        except SlimsfmError as error:
            found[f"{type(error).__name__}: {error}"] += 1
    return found


def write_one(source: Path, path: Path) -> None:
    """Write a map."""
    write_map(read_map(source), path, overwrite=True)


def content_of(path: Path) -> str:
    """What a map holds, in short."""
    return _digest(read_map(path))


def _digest(found: Map) -> str:
    parts = sha256(found.fingerprint.encode())
    for features in found.features.values():
        parts.update(features.descriptors.tobytes())
    for pairs in found.matches.values():
        parts.update(pairs.tobytes())
    return parts.hexdigest()[:12]


def write_lines(source: Path, path: Path) -> None:
    """Write a file of many lines that depend on the source."""
    with replacing(path, overwrite=True) as partial:
        partial.write_text(json.dumps([source.name] * LINES))


def lines_of(path: Path) -> str:
    """The one line that a file consists of."""
    (line,) = set(json.loads(path.read_text()))
    return line


if __name__ == "__main__":
    main()
