"""Scenes that benchmarks share: folders of photos with every third image held out, and rendered objects."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from slimsfm.cli.output import quiet
from slimsfm.datasets.base import LoadOptions, map_object
from slimsfm.datasets.onepose import read_object
from slimsfm.datasets.reconstructed import Images
from slimsfm.datasets.synthetic import SynthesisOptions, synthesize
from slimsfm.evaluation.results import PreparedQuery, prepare_queries, queries_of
from slimsfm.mapping import Map, read_map, write_map
from slimsfm.mapping.io import bytes_by_part
from slimsfm.progress import shown


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A map and queries that are not in it."""

    name: str
    references: Map
    bytes: int
    queries: list[PreparedQuery]


def scenes(folders: list[Path], objects: Sequence[str], output: Path) -> Iterator[Scene]:
    """The folders of photos, then the rendered objects; results are stored in the output folder."""
    for folder in folders:
        with quiet():
            making = LoadOptions(folder=output / folder.name, progress=shown)
            photos = Images(path=folder).load(folder.resolve().name, making)
            made = map_object(photos, output / "workspace")
        queries = queries_of(photos.query)
        write_map(made, output / f"{folder.name}-map", overwrite=True)
        references = read_map(output / f"{folder.name}-map")
        size = bytes_by_part(output / f"{folder.name}-map")["total"]
        yield Scene(
            name=folder.name, references=references, bytes=size, queries=prepare_queries(references, queries)
        )
    for name in objects:
        yield rendered(name, output)


def rendered(name: str, output: Path) -> Scene:
    """A rendered object, mapped with its known poses."""
    if not (output / "objects" / name).exists():
        synthesize(output / "objects", SynthesisOptions(objects=(name,)), progress=shown)
    made = read_object(output / "objects" / name)
    if not (output / f"{name}-map").exists():
        with quiet(), tempfile.TemporaryDirectory() as workspace:
            write_map(map_object(made, Path(workspace), progress=shown), output / f"{name}-map")
    references = read_map(output / f"{name}-map")
    queries = queries_of(made.query)
    size = bytes_by_part(output / f"{name}-map")["total"]
    return Scene(name=name, references=references, bytes=size, queries=prepare_queries(references, queries))
