"""Rendered objects in OnePose's layout: a data set with exact poses, rendered in seconds from a seed."""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from PIL import Image as PilImage

from slimsfm.datasets import onepose
from slimsfm.datasets.base import LoadOptions, ObjectSequences
from slimsfm.datasets.reading import check_object_name
from slimsfm.errors import InputError
from slimsfm.files import check_writable, replacing
from slimsfm.progress import ProgressBar, silent
from slimsfm.synthetic.objects import OBJECTS
from slimsfm.synthetic.scene import TAKES, Take, object_box


@dataclass(frozen=True, kw_only=True)
class SynthesisOptions:
    """What to render."""

    objects: tuple[str, ...] = tuple(OBJECTS)
    """Names of the objects; all by default."""

    mapping_frames: int = 60
    """Frames of the mapping video: half a minute at two frames per second."""

    query_frames: int = 40
    """Frames of the query video."""

    width: int = 640
    """Image width, in pixels."""

    height: int = 480
    """Image height, in pixels."""

    seed: int = 0
    """Seed of prints, surroundings, camera shake and noise: equal options give equal bytes."""

    def __post_init__(self) -> None:
        if (
            not self.objects
            or len(set(self.objects)) < len(self.objects)
            or not OBJECTS.keys() >= set(self.objects)
        ):
            raise ValueError(f"objects must be distinct and among {', '.join(OBJECTS)}, got {self.objects}")
        for field in ("mapping_frames", "query_frames", "width", "height"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field} must be positive, got {getattr(self, field)}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


@dataclass(frozen=True, kw_only=True)
class Synthetic:
    """Rendered objects; missing ones are rendered first."""

    path: Path
    """Folder with one folder per object."""

    objects: tuple[str, ...] = tuple(OBJECTS)
    """Names of the objects; all by default."""

    mapping_frames: int | None = None
    """Frames of the mapping video. By default here and below: the value of an existing object, or the default
    of `slimsfm synthesize`."""

    query_frames: int | None = None
    """Frames of the query video."""

    width: int | None = None
    """Image width, in pixels."""

    height: int | None = None
    """Image height, in pixels."""

    render_seed: int = 0
    """Seed of new objects, as for `slimsfm synthesize`; existing objects may have any."""

    def __post_init__(self) -> None:
        self._options(self.objects)

    def names(self) -> tuple[str, ...]:
        """Sorted names of the objects."""
        return tuple(sorted(self.objects))

    def load(self, name: str, options: LoadOptions) -> ObjectSequences:
        """Read one object; render it first if it is missing. An existing one must match the options."""
        check_object_name(name, self.names(), self.path)
        if not (self.path / name).exists():
            synthesize(self.path, self._options((name,)), progress=options.progress)
        made = onepose.read_object(self.path / name)
        found = {
            "mapping_frames": len(made.mapping.names),
            "query_frames": len(made.query.names),
            "width": made.mapping.cameras[0].width,
            "height": made.mapping.cameras[0].height,
        }
        for field, value in found.items():
            if getattr(self, field) not in (None, value):
                raise InputError(
                    f"{self.path / name} was rendered with {field} {value}, not {getattr(self, field)}: "
                    "use these values, or choose another folder"
                )
        return made

    def _options(self, objects: tuple[str, ...]) -> SynthesisOptions:
        fields = ("mapping_frames", "query_frames", "width", "height")
        asked = {field: getattr(self, field) for field in fields if getattr(self, field) is not None}
        return SynthesisOptions(objects=objects, seed=self.render_seed, **asked)


@dataclass(frozen=True, kw_only=True)
class _TakeKey:
    """The arguments of a take: small enough to send to another process."""

    kind: str
    name: str
    frames: int
    width: int
    height: int
    seed: int


def synthesize(
    directory: Path,
    options: SynthesisOptions = SynthesisOptions(),
    *,
    overwrite: bool = False,
    progress: ProgressBar = silent,
    executor: Executor | None = None,
) -> list[ObjectSequences]:
    """Render objects in OnePose's layout: `NAME/NAME-1` for mapping, `NAME/NAME-2` for queries.

    Args:
        directory: Folder for the objects; created if missing. An object appears when it is complete.
        options: What to render.
        overwrite: Replace existing objects.
        progress: Progress callback, called once per frame.
        executor: Renders frames in parallel, such as a `ProcessPoolExecutor`; None renders them here.

    Returns:
        The objects, read from the folder, in the order of `options.objects`.

    Raises:
        OutputError: An object exists and `overwrite` is off, or the folder cannot be written.
    """
    for name in options.objects:
        check_writable(directory / name, overwrite=overwrite)
    for name in options.objects:
        with replacing(directory / name, overwrite=overwrite) as folder:
            _write_object(folder, name, options, progress, executor)
    return [onepose.read_object(directory / name) for name in options.objects]


def _write_object(
    folder: Path, name: str, options: SynthesisOptions, progress: ProgressBar, executor: Executor | None
) -> None:
    onepose.write_box(folder, object_box(OBJECTS[name](options.seed)))
    jobs: list[tuple[_TakeKey, int, Path]] = []
    counts = (options.mapping_frames, options.query_frames)
    for number, (kind, frames) in enumerate(zip(TAKES, counts, strict=True), start=1):
        key = _TakeKey(
            kind=kind, name=name, frames=frames, width=options.width, height=options.height, seed=options.seed
        )
        take, sequence = _take(key), folder / f"{name}-{number}"
        onepose.write_annotation(sequence, take.camera, take.cam_from_object)
        jobs += [(key, frame, onepose.image_path(sequence, frame)) for frame in range(frames)]
    _render(jobs, f"rendering {name}", progress, executor)


def _render(
    jobs: Sequence[tuple[_TakeKey, int, Path]], label: str, progress: ProgressBar, executor: Executor | None
) -> None:
    done = map(_write_frame, jobs) if executor is None else executor.map(_write_frame, jobs)
    for _ in progress(jobs, label):
        next(done)


@lru_cache(maxsize=2)
def _take(key: _TakeKey) -> Take:
    return TAKES[key.kind](key.name, key.frames, key.width, key.height, key.seed)


def _write_frame(job: tuple[_TakeKey, int, Path]) -> None:
    key, frame, path = job
    PilImage.fromarray(_take(key).frame(frame)).save(path, compress_level=1)
