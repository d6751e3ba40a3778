"""Deceptive scenes that benchmarks share: rendered and mapped once, stored in the output folder.

    python benchmarks/deceptive_scenes.py -o /tmp/deceptions

Prints the scores of the exhaustive strategy for each scene.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

from PIL import Image as PilImage

from benchmark_scenes import Scene
from deception import DECEPTIONS
from slimsfm.cli.output import quiet
from slimsfm.datasets import onepose
from slimsfm.datasets.base import map_object
from slimsfm.evaluation.results import evaluate, prepare_queries, queries_of
from slimsfm.evaluation.scores import score
from slimsfm.execution import processes
from slimsfm.files import replacing
from slimsfm.mapping import read_map, write_map
from slimsfm.mapping.io import bytes_by_part
from slimsfm.progress import shown
from slimsfm.synthetic.scene import Take, object_box

FRAMES, WIDTH, HEIGHT, SEED = 60, 640, 480, 0
KINDS = ("mapping", "query")

Job = TypeVar("Job")


def deceptions(output: Path, *, workers: int = 1) -> Iterator[Scene]:
    """Every deception, mapped with its known poses, with its queries."""
    for name in DECEPTIONS:
        yield deception(name, output, workers=workers)


def deception(name: str, output: Path, *, workers: int = 1) -> Scene:
    """One deception; existing files in the output folder are reused."""
    folder, path = output / "deceptions" / name, output / f"{name}-map"
    if not folder.exists():
        with replacing(folder, overwrite=False) as partial:
            render_object(partial, name, workers)
    made = onepose.read_object(folder)
    if not path.exists():
        with quiet(), tempfile.TemporaryDirectory() as workspace:
            write_map(map_object(made, Path(workspace), progress=shown), path)
    references = read_map(path)
    queries = prepare_queries(references, queries_of(made.query))
    return Scene(name=name, references=references, bytes=bytes_by_part(path)["total"], queries=queries)


def render_object(folder: Path, name: str, workers: int) -> None:
    """Render both takes in OnePose's layout."""
    onepose.write_box(folder, object_box(DECEPTIONS[name].object(SEED)))
    jobs = []
    for number, kind in enumerate(KINDS, start=1):
        made, sequence = take(name, kind), folder / f"{name}-{number}"
        onepose.write_annotation(sequence, made.camera, made.cam_from_object)
        jobs += [(name, kind, index, onepose.image_path(sequence, index)) for index in range(FRAMES)]
    run_all(write_frame, jobs, f"rendering {name}", workers)


def run_all(function: Callable[[Job], None], jobs: Sequence[Job], label: str, workers: int) -> None:
    """Apply a function to every job, here or on processes of this machine."""
    with ExitStack() as opened:
        executor = opened.enter_context(processes(workers)) if workers > 1 else None
        done = map(function, jobs) if executor is None else executor.map(function, jobs, chunksize=10)
        for _ in shown(jobs, label):
            next(done)


@lru_cache(maxsize=1)
def take(name: str, kind: str) -> Take:
    """One take of a deception; the last one is cached."""
    return getattr(DECEPTIONS[name], kind)(FRAMES, WIDTH, HEIGHT, SEED)


def write_frame(job: tuple[str, str, int, Path]) -> None:
    """Render one frame to its file."""
    name, kind, index, path = job
    PilImage.fromarray(take(name, kind).frame(index)).save(path, compress_level=1)


def main() -> None:
    """Render, map, localize and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    for scene in deceptions(parser.parse_args().output):
        outcomes = evaluate(scene.references, scene.queries, "exhaustive")
        print(scene.name, asdict(score(outcomes, metric=True)))


if __name__ == "__main__":
    main()
