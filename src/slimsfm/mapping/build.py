"""Build maps from photos by Structure from Motion."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from slimsfm.devices import Device
from slimsfm.errors import InputError, ReconstructionError
from slimsfm.execution import OpenExecutor
from slimsfm.exif import Exif, ignored_values, read_device, read_orientation
from slimsfm.features import Extractor, load_extractor
from slimsfm.geometry import Box
from slimsfm.mapping.blocks import Workers
from slimsfm.mapping.cameras import devices_by_camera
from slimsfm.mapping.descriptors import with_global_descriptors
from slimsfm.mapping.extraction import Extracted, check_readable, extract_features, guess_cameras
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.inputs import InputOptions
from slimsfm.mapping.keypoint_model import build_from_keypoints
from slimsfm.mapping.map import Map
from slimsfm.mapping.masked_photos import MaskedPhotos
from slimsfm.mapping.model import estimate_box, read_box
from slimsfm.mapping.photo_choice import check_enough, choose_photos
from slimsfm.mapping.quality import ModelQuality
from slimsfm.mapping.sfm import colmap_warnings
from slimsfm.mapping.support import measure
from slimsfm.mapping.work import BuildOptions, BuildWork, KnownPoses, MapParts, ModelBuilder, build_key
from slimsfm.mapping.workspace import Workspace, opened_workspace
from slimsfm.progress import ProgressBar, silent
from slimsfm.skipping import SkippedPhotos


def build_map(
    images: str | Path | Sequence[str | Path],
    options: BuildOptions = BuildOptions(),
    *,
    inputs: InputOptions = InputOptions(),
    known: KnownPoses | None = None,
    workspace: str | Path | None = None,
    open_executor: OpenExecutor | None = None,
    progress: ProgressBar = silent,
    min_seconds: float = Workers.min_seconds,
) -> Map:
    """Build a map from photos and videos by Structure from Motion.

    Photos that cannot be read are skipped with a warning, and a video that is cut off is used until there,
    unless `BuildOptions.strict` is set. Photos that could not be registered are named in `Map.unregistered`,
    and what was skipped or ignored in `MapInfo.notes`. The map reads its features from disk when they are
    needed, so that large maps fit into memory.

    Args:
        images: Folder of photos, video, or several of either. All images in a folder and its subfolders are
            used or, with known poses, those with a pose. See `gather_photos` for the names of several.
        options: How to build.
        inputs: How frames of videos are chosen, and a file of known poses.
        known: Known poses, in Python: points are triangulated from them as from those of a file.
        workspace: Folder that keeps the intermediate files: frames of videos, COLMAP's database, model and
            the features. An equal call goes on from those that an interrupted one left; another call starts
            afresh. By default a temporary folder that is removed. Workers open it.
        open_executor: Opens the executor that extracts and matches features; None: this process. The map has
            equal bytes in any case.
        progress: Progress callback.
        min_seconds: As in `Workers`.

    Raises:
        InputError: A folder, a video, a mask, the poses or the box cannot be used, or fewer than two images
            can; or the matches say that the poses were read in the wrong convention.
        VideoError: With `strict`, a video cannot be read to its end.
        ReconstructionError: The images give no model.
    """
    if known is not None and inputs.poses is not None:
        raise ValueError("known poses are given twice, as known and as inputs.poses")
    sources = [Path(images)] if isinstance(images, str | Path) else [Path(one) for one in images]
    given_box = read_box(options.box) if options.box else (known.box if known else None)
    extractor = _extractor(options)
    workers = Workers(open_executor=open_executor, min_seconds=min_seconds)
    with opened_workspace(workspace) as folder, colmap_warnings():
        chosen = choose_photos(sources, folder, options, inputs, known, progress)
        known, skipped, exifs, folder_of_photos = chosen.known, chosen.skipped, chosen.exifs, chosen.folder
        photos = MaskedPhotos(
            folder_of_photos, chosen.names, options.masks, options.alpha, options.orientation
        )
        key = build_key(folder_of_photos, chosen.names, photos, extractor, options, known)
        space = Workspace(folder, key)
        extracted = _extract(photos, skipped.left(chosen.names), extractor, space, skipped, workers, progress)
        names = skipped.left(chosen.names)
        notes = (*chosen.notes, *skipped.notes)
        check_enough(chosen.label, names, notes)
        photos.keep(names)
        exifs = {name: exifs[name] for name in names} if exifs else {}
        work = _work(folder_of_photos, photos, names, space, exifs, known, options, workers, progress)
        notes = (*notes, *ignored_values(exifs))
        try:
            parts = _build(work, extracted, extractor, options)
        except ReconstructionError as error:  # what was skipped may be the reason
            said = str(error).replace(str(folder_of_photos), chosen.label)
            raise ReconstructionError("; ".join([said, *notes, *photos.notes])) from error
    notes = (*notes, *photos.notes, *(parts.picked.notes if parts.picked else ()), *parts.notes)
    return with_global_descriptors(_map(parts, work, exifs, given_box, notes, options))


def _extract(
    photos: MaskedPhotos,
    names: list[str],
    extractor: Extractor,
    workspace: Workspace,
    skipped: SkippedPhotos,
    workers: Workers,
    progress: ProgressBar,
) -> Extracted | None:
    """Extract features or, for an extractor that finds no keypoints, only find out what can be read."""
    if not isinstance(extractor, ModelBuilder):
        return extract_features(photos, names, extractor, workspace, skipped, workers, progress)
    check_readable(photos, names, skipped)
    return None


def _work(
    images: Path,
    photos: MaskedPhotos,
    names: list[str],
    workspace: Workspace,
    exifs: Mapping[str, Exif],
    known: KnownPoses | None,
    options: BuildOptions,
    workers: Workers,
    progress: ProgressBar,
) -> BuildWork:
    guessed = guess_cameras(exifs, options.camera, options.orientation)
    return BuildWork(
        images=images,
        photos=photos,
        names=names,
        workspace=workspace,
        cameras={name: known.cameras[name] for name in names} if known else guessed.by_name,
        turned=guessed.turned,
        known=known,
        workers=workers,
        progress=progress,
    )


def _build(
    work: BuildWork, extracted: Extracted | None, extractor: Extractor, options: BuildOptions
) -> MapParts:
    if extracted is not None:
        return build_from_keypoints(work, extracted, extractor, options)
    if work.known and work.known.refine:
        raise InputError(f"{options.extractor} finds no keypoints, without which poses cannot be refined")
    if work.turned and options.camera == "shared":
        raise InputError(
            f"{min(work.turned)}: width and height are swapped, and without a detector such images cannot "
            "share a camera with the others; use `camera='auto'`"
        )
    return cast(ModelBuilder, extractor).build_model(work, options)


def _map(
    parts: MapParts,
    work: BuildWork,
    exifs: Mapping[str, Exif],
    given_box: Box | None,
    notes: tuple[str, ...],
    options: BuildOptions,
) -> Map:
    """The map of a model, without global descriptors."""
    names, picked = work.names, parts.picked
    quality = picked.quality if picked else measure(parts.model, parts.matches, names)
    used = {parts.model.image(image_id).name for image_id in parts.model.reg_image_ids()}
    used |= picked.elsewhere if picked else set()
    info = MapInfo(
        extractor=parts.extractor.name,
        extractor_options=parts.extractor.options,
        box=given_box or estimate_box(parts.model),
        box_source="given" if given_box else "estimated",
        unit=work.known.unit if work.known else "unknown",
        origin=f"built from {len(names)} images" + (" with known poses" if work.known else ""),
        quality=quality.with_origins(_origins(quality, work)),
        notes=notes,
        orientation=options.orientation,
        exif_orientations=_exif_orientations(work, exifs) if options.orientation == "upright" else {},
        devices=devices_by_camera(parts.model, _devices(work, exifs)),
    )
    return Map(
        model=parts.model,
        features=parts.features,
        matches=parts.matches,
        photos=parts.photos,
        info=info,
        unregistered=tuple(name for name in names if name not in used),
    )


def _exif_orientations(work: BuildWork, exifs: Mapping[str, Exif]) -> dict[str, int]:
    tags = {
        name: exifs[name].orientation if exifs else read_orientation(work.images / name)
        for name in work.names
    }
    return {name: tag for name, tag in tags.items() if tag != 1}


def _devices(work: BuildWork, exifs: Mapping[str, Exif]) -> dict[str, Device]:
    return {name: exifs[name].device if exifs else read_device(work.images / name) for name in work.names}


def _origins(quality: ModelQuality, work: BuildWork) -> dict[str, str]:
    if work.known:
        return dict.fromkeys(quality.focal_lengths, "given")
    has_prior = {name: work.cameras[name].has_prior_focal_length for name in quality.focal_lengths}
    return {name: "EXIF" if prior else "guessed" for name, prior in has_prior.items()}


def _extractor(options: BuildOptions) -> Extractor:
    wanted: dict = {"max_features": options.max_features, "max_image_size": options.max_image_size}
    return load_extractor(
        options.extractor, {key: value for key, value in wanted.items() if value is not None}
    )
