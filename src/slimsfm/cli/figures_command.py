"""`slimsfm figures`."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from matplotlib.figure import Figure
from rich.markup import escape

from slimsfm.arrays import Image
from slimsfm.cli.options import Argument, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish
from slimsfm.errors import ImageError, InputError
from slimsfm.evaluation.outcomes import Outcomes, join
from slimsfm.evaluation.result_files import read_run
from slimsfm.evaluation.results import Cell, ObjectResult, Run
from slimsfm.evaluation.table import BY_FRAME, average_rows, rows_of
from slimsfm.mapping.subset import keep_images
from slimsfm.photos import read_image, shrink
from slimsfm.progress import shown
from slimsfm.report.charts import (
    before_after_figure,
    frontier_chart,
    graph_figure,
    query_places,
    reference_places,
    reliability_chart,
    sphere_chart,
)
from slimsfm.report.figures import save_figure
from slimsfm.report.query_video import FRAMES_PER_SECOND, drawn_queries, film_frame, save_jpeg
from slimsfm.report.run_maps import OpenedObject, open_object
from slimsfm.tracking.video import check_format, write_video

_THUMBNAIL_PX = 128

_EXPLANATIONS = {
    "frontier": "accuracy over size and time; what nothing else beats is joined",
    "reliability": "how often poses of each confidence are right",
    "before-after": "points and cameras of the full map and of the dominating set",
    "graph": "the reference graph; the dominating set is red",
    "sphere": "from where queries fail, before and after",
    "queries": "every query; true box green, estimated box red",
    "video": "the same as a video, with how far poses are off",
}


def figures(
    run: Annotated[Path, Argument("RUN")],
    /,
    output: OutputPath,
    format: Literal["png", "svg", "pdf"] = "png",
    overwrite: bool = False,
) -> None:
    """Draw the figures of a run of `slimsfm benchmark`: OUTPUT/OBJECT/METHOD/graph.png and so on.

    Queries are drawn as images and, with PyAV, as a video.

    Args:
        run: Folder of a run, with its maps.
        output: Folder for the figures.
        format: Of the figures that are no photos.
        overwrite: Replace files that are there; others in the folder stay.
    """
    watch = Stopwatch()
    check_output(output, run, overwrite=overwrite)
    measured = read_run(run)
    if not measured.objects:
        raise InputError(f"{run}: no object could be measured; run slimsfm benchmark again")
    studio = _Studio(output, format, overwrite)
    _draw_overall(studio, measured)
    for result in shown(measured.objects, "draw figures"):
        studio.save(frontier_chart(rows_of(result)), Path(result.name), "frontier")
        for mapped in result.maps:
            _draw_method(studio, open_object(measured, result, mapped.method))
    for path, what in studio.index.items():
        console.print(f"{escape(str(path))}  [dim]{what}[/dim]")
    finish(f"{output}: {len(studio.index)} figures", watch, "report", run, "-o", "report.html")


@dataclass
class _Studio:
    """Writes figures, knows what it wrote, and says once what is missing."""

    output: Path
    format: str
    overwrite: bool
    index: dict[Path, str] = field(default_factory=dict)
    told: set[str] = field(default_factory=set)

    def add(self, place: Path, kind: str) -> Path:
        """Put something into the index; returns where it goes."""
        path = self.output / place
        self.index[path] = _EXPLANATIONS[kind]
        return path

    def save(self, figure: Figure, folder: Path, kind: str, name: str = "") -> None:
        """Write a figure, named as its kind where no name is given."""
        path = self.add(folder / f"{name or kind}.{self.format}", kind)
        save_figure(figure, path, overwrite=self.overwrite)

    def read(self, path: Path) -> Image | None:
        """Read a photo; None where that is not possible, which is told once."""
        try:
            return read_image(path)
        except ImageError as error:
            self.tell("photos", f"{error}; photos that are missing are left out")
            return None

    def tell(self, what: str, message: str) -> None:
        """Say something once."""
        if what not in self.told:
            self.told.add(what)
            console.print(escape(message), style="yellow")


def _draw_overall(studio: _Studio, run: Run) -> None:
    """What is told of several objects together."""
    rows = [row for row in average_rows(run.objects) if row.object == BY_FRAME]
    if not rows:
        return
    studio.save(frontier_chart(rows), Path(), "frontier")
    for method in dict.fromkeys(row.method for row in rows):
        cells = [_compared(result, method)[1] for result in run.objects if _cells(result, method)]
        outcomes = join([cell.trials[0].outcomes for cell in cells])
        studio.save(reliability_chart(outcomes), Path(), "reliability", f"reliability-{method}")


def _draw_method(studio: _Studio, opened: OpenedObject) -> None:
    """What is told of one object by one method."""
    result, mapped = opened.result, opened.mapped
    folder = Path(result.name) / mapped.method
    full = opened.maps["full"]
    reduced = keep_images(full, mapped.dominating_set)
    studio.save(before_after_figure(full, reduced), folder, "before-after")
    photos = {name: studio.read(result.images / name) for name in opened.graph.names}
    thumbnails = {name: shrink(photo, _THUMBNAIL_PX) for name, photo in photos.items() if photo is not None}
    graph = graph_figure(opened.graph, mapped.dominating_set, thumbnails, opened.threshold)
    studio.save(graph, folder, "graph")
    before, after = (cell.trials[0].outcomes for cell in _compared(result, mapped.method))
    places = reference_places(full, reduced), query_places(result.queries, before, after)
    studio.save(sphere_chart(result.box, *places), folder, "sphere")
    studio.save(reliability_chart(after), folder, "reliability")
    _draw_queries(studio, result, after, folder)


def _cells(result: ObjectResult, method: str) -> list[Cell]:
    return [cell for cell in result.cells if cell.method == method]


def _compared(result: ObjectResult, method: str) -> tuple[Cell, Cell]:
    """The full map and the dominating set by the first strategy that both were measured with.

    Where there is none, what comes nearest: any two maps by one strategy, or one map twice.
    """
    cells = _cells(result, method)
    pairs = [(a, b) for a in cells for b in cells if a.strategy == b.strategy and a.variant == "full"]
    for wanted in ("dominating", None, "full"):
        for before, after in pairs:
            if after.variant == wanted or (wanted is None and after.variant != "full"):
                return before, after
    return cells[0], cells[0]


def _draw_queries(studio: _Studio, result: ObjectResult, outcomes: Outcomes, folder: Path) -> None:
    """Write every query as an image, and all of them as a video of the first one's size."""
    with ExitStack() as stack:
        write, height, width = None, 0, 0
        for drawn in drawn_queries(result, outcomes, studio.read):
            if not height:
                height, width = drawn.image.shape[:2]
                studio.add(folder / "queries", "queries")
                write = _video(studio, stack, folder)
            path = studio.output / folder / "queries" / f"{drawn.name}.jpg"
            save_jpeg(drawn.image, path, overwrite=studio.overwrite)
            if write:
                write(film_frame(drawn, height, width))


def _video(studio: _Studio, stack: ExitStack, folder: Path) -> Callable[[Image], None] | None:
    """Begin a video, which ends with the stack; None where none can be written."""
    name = folder / "queries.mp4"
    try:
        check_format(name)
    except InputError as error:
        studio.tell("video", f"no queries.mp4 is written: {error}")
        return None
    path = studio.add(name, "video")
    return stack.enter_context(write_video(path, FRAMES_PER_SECOND, overwrite=studio.overwrite))
