"""Damage ends in no traceback, and in no other pose where a map has checksums; see `benchmarks/damage.py`."""

from pathlib import Path

import pytest

from damage import damaged, here, is_failure, write_others, write_photos
from damage_subjects import Sources, subjects
from slimsfm.evaluation.benchmark import BenchmarkSetup
from slimsfm.evaluation.result_files import write_results
from slimsfm.evaluation.run import run_benchmark
from tiny_dataset import OPTIONS, TinyDataset, add_object

KINDS = "map", "older map", "slim map", "older slim map", "run", "query", "other files"
COUNT = 24  # damaged files per folder


@pytest.fixture(scope="module")
def sources(boulder, tmp_path_factory) -> Sources:
    folder = tmp_path_factory.mktemp("sources")
    images = [f"{number}.png" for number in range(2, 10)]
    add_object(folder / "objects", "can", boulder.map, boulder.photos, images[:1], images[1:])
    run = run_benchmark(
        TinyDataset(path=folder / "objects"), BenchmarkSetup(folder=folder / "run", options=OPTIONS)
    )
    write_results(run)
    (folder / "photos").mkdir()
    write_photos(boulder.photos / images[0], folder / "photos")
    maps = folder / "run" / "maps" / "can" / "sift"
    write_others(maps / "full", folder / "others")
    return Sources(
        full=maps / "full",
        slim=maps / "points-100",
        run=folder / "run",
        photos=folder / "photos",
        others=folder / "others",
    )


@pytest.mark.parametrize("kind", KINDS)
def test_damage_is_refused_or_changes_nothing(sources: Sources, tmp_path: Path, kind: str) -> None:
    found = [one for one in subjects(sources, tmp_path) if one.kind == kind]
    for subject in found:
        count = max(2, COUNT // len(found))
        for name, outcome in damaged(subject, tmp_path / "scratch", seed=7, count=count, use=here):
            assert not is_failure(subject, outcome), f"{name}: {outcome.result} {outcome.detail}"
