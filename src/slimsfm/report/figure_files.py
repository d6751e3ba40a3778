"""The figures of a run as files: charts, maps, reference graphs, and queries as images and as a video."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from matplotlib.figure import Figure
from PIL import Image as PillowImage

from slimsfm.arrays import Image
from slimsfm.errors import ImageError, InputError
from slimsfm.evaluation.results import Measurement, ObjectResult, Outcomes, Run, join_outcomes
from slimsfm.evaluation.table import BY_FRAME, average_rows, rows_of
from slimsfm.files import inside, replacing
from slimsfm.mapping.subset import keep_images
from slimsfm.photos import Orientation, read_image, shrink
from slimsfm.progress import ProgressBar, silent
from slimsfm.report.figures import save_figure
from slimsfm.report.formatting import format_error
from slimsfm.report.frames import QueryFrame, draw_frame
from slimsfm.report.graph_view import GraphDrawing, graph_figure
from slimsfm.report.reliability import reliability_chart
from slimsfm.report.report_data import RunMaps, load_run_maps
from slimsfm.report.scene3d import before_after_figure
from slimsfm.report.sphere import query_verdicts, sphere_chart
from slimsfm.report.tradeoffs import frontier_chart
from slimsfm.tracking.video import check_format, write_video

FigureFormat = Literal["png", "svg", "pdf"]
"""File format of the figures that are not photos."""

ReadPhoto = Callable[[Path, Orientation], Image | None]
"""Reads a photo; None if it is missing or unreadable."""

_EXPLANATIONS = {
    "frontier": "accuracy over map size and query time; the Pareto front is joined",
    "reliability": "how often poses of each confidence are right",
    "before-after": "points and cameras of the full map and of the dominating set",
    "graph": "the reference graph; the dominating set is red",
    "sphere": "directions from which queries fail, before and after",
    "queries": "every query; true box green, estimated box red",
    "video": "the same as a video, with the pose errors",
}
_THUMBNAIL_PX = 128
_QUERY_PX = 720  # longer side of a query image
_FRAMES_PER_SECOND = 5.0
_JPEG = {"quality": 88, "subsampling": 0}  # keeps the colors of thin lines
_STRIP = 0.055  # height of the caption, relative to that of the image
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_FONT_PX = 22  # height of its capitals at scale 1


@dataclass(frozen=True, kw_only=True)
class WrittenFigures:
    """Result of `write_figures`."""

    files: dict[Path, str] = field(default_factory=dict)
    """What each file or folder shows, in the order of writing."""

    warnings: list[str] = field(default_factory=list)
    """What could not be written, and why."""


def write_figures(
    run: Run,
    folder: str | Path,
    format: FigureFormat = "png",
    *,
    overwrite: bool = False,
    progress: ProgressBar = silent,
) -> WrittenFigures:
    """Write the figures of a run to FOLDER/OBJECT/METHOD/graph.png and so on.

    Missing photos are left out. Without PyAV no video is written.

    Args:
        run: Results of a benchmark, with its maps.
        folder: Where the figures go.
        format: File format of the figures that are not photos.
        overwrite: Replace existing files; other files in the folder stay.
        progress: Progress callback.

    Raises:
        OutputError: A file exists and `overwrite` is off, or it cannot be written.
        MapError: A map of the run is missing or damaged.
    """
    writer = _Writer(Path(folder), format, overwrite)
    _write_averages(writer, run)
    for result in progress(run.objects, "draw figures"):
        writer.save(frontier_chart(rows_of(result)), Path(result.name), "frontier")
        for mapped in result.maps:
            _write_method(writer, load_run_maps(run, result, mapped.method))
    return WrittenFigures(files=writer.files, warnings=list(writer.warnings.values()))


@dataclass
class _Writer:
    """Writes figures, and keeps the list of files and one warning of each kind."""

    folder: Path
    format: str
    overwrite: bool
    files: dict[Path, str] = field(default_factory=dict)
    warnings: dict[str, str] = field(default_factory=dict)

    def add(self, place: Path, kind: str) -> Path:
        path = inside(self.folder, place.as_posix())
        self.files[path] = _EXPLANATIONS[kind]
        return path

    def save(self, figure: Figure, place: Path, kind: str, name: str = "") -> None:
        path = self.add(place / f"{name or kind}.{self.format}", kind)
        save_figure(figure, path, overwrite=self.overwrite)

    def read(self, path: Path, orientation: Orientation) -> Image | None:
        try:
            return read_image(path, orientation)
        except ImageError as error:
            self.warnings.setdefault("photos", f"{error}; missing photos are left out")
            return None

    def read_reference(self, folder: Path, name: str) -> Image | None:
        try:
            return self.read(inside(folder, name), "upright")
        except InputError as error:
            self.warnings.setdefault("photos", f"{error}; such photos are left out")
            return None


def _write_averages(writer: _Writer, run: Run) -> None:
    rows = [row for row in average_rows(run.objects) if row.object == BY_FRAME]
    if not rows:
        return
    writer.save(frontier_chart(rows), Path(), "frontier")
    for method in dict.fromkeys(row.method for row in rows):
        cells = [_compared(result, method)[1] for result in run.objects if _cells(result, method)]
        outcomes = join_outcomes([cell.map_runs[0].outcomes for cell in cells])
        writer.save(reliability_chart(outcomes), Path(), "reliability", f"reliability-{method}")


def _write_method(writer: _Writer, maps: RunMaps) -> None:
    result, mapped, full = maps.result, maps.mapped, maps.maps["full"]
    place = Path(result.name) / mapped.method
    reduced = keep_images(full, mapped.dominating_set)
    writer.save(before_after_figure(full, reduced), place, "before-after")
    photos = {name: writer.read_reference(result.images, name) for name in maps.graph.names}
    thumbnails = {name: shrink(photo, _THUMBNAIL_PX) for name, photo in photos.items() if photo is not None}
    drawing = GraphDrawing(graph=maps.graph, threshold=maps.threshold, chosen=mapped.dominating_set)
    writer.save(graph_figure(drawing, thumbnails), place, "graph")
    for kind, figure in method_charts(maps).items():
        writer.save(figure, place, kind)
    after = _compared(result, mapped.method)[1].map_runs[0].outcomes
    _write_queries(writer, result, after, place)


def method_charts(maps: RunMaps) -> dict[str, Figure]:
    """Charts that compare the full map with the dominating set, by kind."""
    result, chosen = maps.result, maps.mapped.dominating_set
    before, after = (cell.map_runs[0].outcomes for cell in _compared(result, maps.mapped.method))
    references = {name: image.cam_from_world() for name, image in maps.maps["full"].images.items()}
    queries = [query.cam_from_world for query in result.queries]
    verdicts = query_verdicts(before), query_verdicts(after)
    return {
        "sphere": sphere_chart(result.box, references, chosen, queries, verdicts),
        "reliability": reliability_chart(after),
    }


def _cells(result: ObjectResult, method: str) -> list[Measurement]:
    return [cell for cell in result.measurements if cell.method == method]


def _compared(result: ObjectResult, method: str) -> tuple[Measurement, Measurement]:
    """The full map and the dominating set, with the first strategy that both were measured with.

    Otherwise the full map and any other map with one strategy, or the same map twice.
    """
    cells = _cells(result, method)
    pairs = [(a, b) for a in cells for b in cells if a.strategy == b.strategy and a.variant == "full"]
    for wanted in ("dominating", None, "full"):
        for before, after in pairs:
            if after.variant == wanted or (wanted is None and after.variant != "full"):
                return before, after
    return cells[0], cells[0]


def _write_queries(writer: _Writer, result: ObjectResult, outcomes: Outcomes, place: Path) -> None:
    """Write each query as an image, and all of them as a video of the first image's size."""
    with ExitStack() as stack:
        write, height, width = None, 0, 0
        for drawn in draw_queries(result, outcomes, writer.read):
            if not height:
                height, width = drawn.image.shape[:2]
                writer.add(place / "queries", "queries")
                write = _open_video(writer, stack, place)
            path = writer.folder / place / "queries" / f"{drawn.name}.jpg"
            with replacing(path, overwrite=writer.overwrite) as partial:
                PillowImage.fromarray(drawn.image).save(partial, "JPEG", **_JPEG)
            if write:
                write(query_video_frame(drawn, height, width))


def _open_video(writer: _Writer, stack: ExitStack, place: Path) -> Callable[[Image], None] | None:
    """Open a video, which is finished with the stack; None if videos cannot be written."""
    name = place / "queries.mp4"
    try:
        check_format(name)
    except InputError as error:
        writer.warnings.setdefault("video", f"no queries.mp4 is written: {error}")
        return None
    path = writer.add(name, "video")
    return stack.enter_context(write_video(path, _FRAMES_PER_SECOND, overwrite=writer.overwrite))


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnQuery:
    """A query with the object's box, the true one in green and the estimated one in red."""

    name: str
    """File name without suffix, with its number in front if several files have the same name."""

    image: Image
    """RGB."""

    caption: str
    """Number of the query, and its pose error."""


def draw_queries(result: ObjectResult, outcomes: Outcomes, read: ReadPhoto) -> Iterator[DrawnQuery]:
    """Draw the queries of an object one by one, without those whose photo is missing."""
    names = _unique([query.path.stem for query in result.queries])
    for i, (query, name) in enumerate(zip(result.queries, names, strict=True)):
        photo = read(query.path, query.orientation)
        if photo is None:
            continue
        verdict = format_error(outcomes.error[i])
        frame = QueryFrame(
            image=photo,
            camera=query.camera,
            estimated_cam_from_world=outcomes.cam_from_world[i],
            true_cam_from_world=query.cam_from_world,
            label=name,
            verdict=verdict,
        )
        caption = f"{i + 1}/{len(names)}  {verdict}".replace("\N{NO-BREAK SPACE}", " ")
        yield DrawnQuery(name=name, image=draw_frame(frame, result.box, _QUERY_PX), caption=caption)


def _unique(stems: Sequence[str]) -> list[str]:
    if len(set(stems)) == len(stems):
        return list(stems)
    return [f"{i:04d}-{stem}" for i, stem in enumerate(stems)]


def query_video_frame(drawn: DrawnQuery, height: int, width: int) -> Image:
    """A video frame of this size: the image centered, shrunk if necessary, its caption at the lower left."""
    frame = np.zeros((height, width, 3), np.uint8)
    own_height, own_width = drawn.image.shape[:2]
    scale = min(height / own_height, width / own_width, 1.0)
    shown = max(1, round(own_width * scale)), max(1, round(own_height * scale))
    x, y = (width - shown[0]) // 2, (height - shown[1]) // 2
    frame[y : y + shown[1], x : x + shown[0]] = cv2.resize(drawn.image, shown, interpolation=cv2.INTER_AREA)
    strip = max(14, round(_STRIP * height))
    frame[-strip:] = frame[-strip:] // 3
    place = (strip // 2, height - strip // 4)
    cv2.putText(frame, drawn.caption, place, _FONT, 0.6 * strip / _FONT_PX, (255, 255, 255), 1, cv2.LINE_AA)
    return frame
