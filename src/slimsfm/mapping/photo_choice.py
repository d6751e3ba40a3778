"""Choose the photos of a map: those that are given or, with known poses, those with a pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slimsfm.errors import InputError
from slimsfm.exif import Exif, read_exif
from slimsfm.mapping.extraction import guess_cameras
from slimsfm.mapping.inputs import GatheredPhotos, InputOptions, gather_photos
from slimsfm.mapping.known_poses import pose_photos, read_given
from slimsfm.mapping.known_poses.matching import PhotosToPose
from slimsfm.mapping.masked_photos import find_photos
from slimsfm.mapping.work import BuildOptions, KnownPoses
from slimsfm.progress import ProgressBar
from slimsfm.skipping import SkippedPhotos


@dataclass(frozen=True, kw_only=True, eq=False)
class ChosenPhotos:
    """The photos that a map is built from."""

    folder: Path
    """Their folder."""

    label: str
    """What was given, for messages."""

    names: list[str]
    """Their names, relative to the folder, sorted; some may be skipped already."""

    skipped: SkippedPhotos
    """Those that cannot be read, as far as this is known."""

    exifs: Mapping[str, Exif]
    """Their EXIF data by name; empty if poses and cameras are known."""

    known: KnownPoses | None
    """Their poses, if they are known."""

    notes: tuple[str, ...]
    """Sentences on what else was given."""


def choose_photos(
    sources: Sequence[Path],
    workspace: Path,
    options: BuildOptions,
    inputs: InputOptions,
    known: KnownPoses | None,
    progress: ProgressBar,
) -> ChosenPhotos:
    """Choose the photos of a map, before the long work.

    Raises:
        InputError: A source or the poses cannot be used, or fewer than two photos can.
    """
    given = read_given(inputs.poses) if inputs.poses else None
    gathered = gather_photos(sources, workspace, fps=inputs.fps, strict=options.strict, progress=progress)
    skipped = SkippedPhotos(gathered.folder, strict=options.strict)
    if known is not None:
        names, notes, exifs = sorted(known.cam_from_world), gathered.notes, {}
        check_enough(gathered.label, names, notes)
        return _chosen(gathered, names, skipped, exifs, known, (*notes, *known.notes))
    found = find_photos(gathered.folder, options.masks)
    names, notes = list(found.names), (*gathered.notes, *found.notes)
    check_enough(gathered.label, names, notes)
    if given is None:
        exifs = _read_exifs(gathered.folder, names, skipped)
        guess_cameras(exifs, options.camera, options.orientation)  # fails before the long work
        return _chosen(gathered, names, skipped, exifs, None, notes)
    posed = pose_photos(
        given,
        PhotosToPose(folder=gathered.folder, names=names, seconds=gathered.seconds),
        lambda some: _read_exifs(gathered.folder, some, skipped),
        sharing=options.camera,
        orientation=options.orientation,
        unit=inputs.unit,
    )
    names = sorted({*posed.cam_from_world, *skipped.reasons})
    posed = replace(posed, refine=inputs.refine)
    return _chosen(gathered, names, skipped, {}, posed, (*notes, *posed.notes))


def _chosen(
    gathered: GatheredPhotos,
    names: list[str],
    skipped: SkippedPhotos,
    exifs: Mapping[str, Exif],
    known: KnownPoses | None,
    notes: tuple[str, ...],
) -> ChosenPhotos:
    return ChosenPhotos(
        folder=gathered.folder,
        label=gathered.label,
        names=names,
        skipped=skipped,
        exifs=exifs,
        known=known,
        notes=notes,
    )


def check_enough(label: str, names: list[str], notes: tuple[str, ...]) -> None:
    """Check that there are at least two images.

    Raises:
        InputError: There are fewer; the message also has the notes, because they may say why.
    """
    if len(names) < 2:
        few = f"{label}: holds {len(names)} image{'s' * (not names)}; a map needs at least two"
        raise InputError("; ".join([few, *notes]))


def _read_exifs(images: Path, names: list[str], skipped: SkippedPhotos) -> dict[str, Exif]:
    exifs = {}
    for name in names:
        with skipped.skipping(name):
            exifs[name] = read_exif(images / name)
    return exifs
