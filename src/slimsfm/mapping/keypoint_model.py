"""Build a model from keypoints: match, reconstruct."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pycolmap

from slimsfm.errors import ReconstructionError
from slimsfm.exif import read_orientation
from slimsfm.features import Extractor, Features, load_matcher, runs_on_one_core
from slimsfm.mapping.choice import PickedModel, pick_model
from slimsfm.mapping.diagnosis import diagnose
from slimsfm.mapping.extraction import Extracted, color_points
from slimsfm.mapping.known_model import triangulate_known
from slimsfm.mapping.matching import PairMatching, match_and_verify
from slimsfm.mapping.orientation import TurnedFeatures, turned_model
from slimsfm.mapping.pairs import choose_pairs, unsure_pairs
from slimsfm.mapping.principal_point import with_principal_points
from slimsfm.mapping.reconstruction import reconstruct
from slimsfm.mapping.scratch import put_keypoints, verified_matches, write_database, write_geometries
from slimsfm.mapping.shrinking import ShrunkImages
from slimsfm.mapping.support import measure
from slimsfm.mapping.work import BuildOptions, BuildWork, MapParts
from slimsfm.mapping.workspace import DATABASE, FEATURES, SFM

_FEW = 0.5  # share of the photos below which a map needs an explanation


def build_from_keypoints(
    work: BuildWork, extracted: Extracted, extractor: Extractor, options: BuildOptions
) -> MapParts:
    """Match keypoints, and reconstruct a model of them.

    Raises:
        InputError: An option cannot be used.
        ReconstructionError: The images give no model; says what they lack.
    """
    features = extracted.features
    sideways = TurnedFeatures(features, _turns(work))
    shrunk = ShrunkImages.by_extractor(sideways, {**work.cameras, **work.turned}, extractor.options)
    database = _match(work, features, shrunk, options)
    picked, notes = None, ()
    if work.known is None:
        picked = _reconstruct(work, database, shrunk, options)
        model = picked.model
    else:
        sfm, seed = work.workspace.folder / SFM, options.seed
        posed = triangulate_known(database, work.names, sfm, work.known, seed=seed, progress=work.progress)
        model, notes = posed.model, posed.notes
    matches = verified_matches(database, {i: model.image(i).name for i in model.reg_image_ids()})
    shrunk.enlarge(model, known_cameras=work.known is not None)
    if work.turned:
        turns_back = {image.name: -int(image.name in work.turned) for image in model.images.values()}
        model = turned_model(model, turns_back)
        put_keypoints(model, features)
    color_points(model, extracted.colors)
    return MapParts(
        extractor=extractor, model=model, features=features, matches=matches, picked=picked, notes=notes
    )


def _turns(work: BuildWork) -> dict[str, int]:
    return dict.fromkeys(work.turned, 1)


def _reconstruct(work: BuildWork, database: Path, shrunk: ShrunkImages, options: BuildOptions) -> PickedModel:
    names, sfm, seed = work.names, work.workspace.folder / SFM, options.seed
    split = options.camera == "auto"  # otherwise the user knows
    try:
        models = reconstruct(database, names, sfm, seed=seed, split=split, progress=work.progress)
    except ReconstructionError as error:
        reasons = filter(None, [str(error), _lacking(work, database, shrunk)])
        raise ReconstructionError(
            f"{work.images}: these {len(names)} photos give no model: {'; '.join(reasons)}"
        ) from error
    picked = _adjusted(pick_model(models, options.model), work, database, options)
    registered = picked.quality.registered
    if registered + len(picked.elsewhere) >= _FEW * len(names):
        return picked
    few = f"the map has only {registered} of {len(names)} photos"
    lacking = "; ".join(filter(None, [few, _lacking(work, database, shrunk)]))
    return replace(picked, notes=(lacking, *picked.notes))


def _adjusted(picked: PickedModel, work: BuildWork, database: Path, options: BuildOptions) -> PickedModel:
    """The model with the principal points that it determines, unless matches then contradict more of it."""
    cameras = _held_alike(picked.model, work, options)
    model = with_principal_points(picked.model, cameras, work.progress)
    if model is picked.model:
        return picked
    matches = verified_matches(database, {i: model.image(i).name for i in model.reg_image_ids()})
    quality = replace(measure(model, matches, work.names), ambiguous=picked.quality.ambiguous)
    if len(quality.contradictions) > len(picked.quality.contradictions) or quality.faults:
        return picked
    return replace(picked, model=model, quality=quality)


def _held_alike(model: pycolmap.Reconstruction, work: BuildWork, options: BuildOptions) -> set[int]:
    """Ids of the cameras that were held the same way for all of their photos."""
    orientations: dict[int, set[tuple[bool, int]]] = defaultdict(set)
    for image in (model.image(image_id) for image_id in model.reg_image_ids()):
        tag = read_orientation(work.images / image.name) if options.orientation == "upright" else 1
        orientations[image.camera_id].add((image.name in work.turned, tag))
    return {camera_id for camera_id, found in orientations.items() if len(found) == 1}


def _lacking(work: BuildWork, database: Path, shrunk: ShrunkImages) -> str:
    """What the photos lack for a model of all of them."""
    matches = verified_matches(database, dict(enumerate(work.names, start=1)))
    return diagnose(work.images, work.names, shrunk.features, matches)


def _match(
    work: BuildWork, features: Mapping[str, Features], shrunk: ShrunkImages, options: BuildOptions
) -> Path:
    """The database of the photos with their verified matches."""
    database, names = work.workspace.folder / DATABASE, list(features)
    matching = PairMatching(
        features=work.workspace.folder / FEATURES,
        turns=_turns(work),
        factors=shrunk.factors,
        cameras=shrunk.cameras,
        matcher=load_matcher(options.matcher, options.extractor),
        one_thread=runs_on_one_core(options.matcher),
        seed=options.seed,
    )
    pairs = choose_pairs(features, options.pairs, seed=options.seed)
    unsure = unsure_pairs(names, pairs, options.pairs) if options.extractor == "sift" else frozenset()
    geometries = match_and_verify(matching, pairs, work.workspace, work.workers, work.progress, unsure=unsure)
    write_database(database, shrunk.features, shrunk.cameras)
    write_geometries(database, names, geometries)
    return database
