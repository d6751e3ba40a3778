"""Disturbed queries of a scene, as files with their features: written and extracted once."""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from PIL import ExifTags
from PIL import Image as PilImage

from disturbances import (
    CHANGES,
    DISTURBANCES,
    Disturbance,
    Place,
    View,
    film_focal_mm,
    given_camera,
)
from disturbed_scenes import MappedScene
from slimsfm.arrays import Image, evenly_spaced
from slimsfm.evaluation.results import PosedQuery
from slimsfm.features import Features, load_extractor
from slimsfm.files import replacing
from slimsfm.photos import read_image

QUERIES = 12
OTHER = "other"
"""Name and group of the disturbance that shows another scene."""

_FILE, _QUALITY = "file", 95
_NOTHING = np.zeros((0, 0, 3), np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class DisturbedQuery:
    """A query that was disturbed, with what is true of it and what its user believes."""

    scene: str
    """Name of the scene whose map it is localized in."""

    disturbance: str
    """A key of `DISTURBANCES`, or `OTHER`."""

    group: str
    """Class of the disturbance."""

    name: str
    """Name of the query, unique in the scene and disturbance."""

    path: Path
    """The image file, with the EXIF data that its user has."""

    features: Features
    """Features of the file by the extractor of the map."""

    camera: pycolmap.Camera
    """The true intrinsics."""

    cam_from_world: pycolmap.Rigid3d | None
    """The true pose; None if no pose is right."""

    believed: pycolmap.Camera | None
    """The camera that the user gives; None: the user gives none, and the file has to say."""


def examples(
    scene: MappedScene, others: Sequence[MappedScene] = (), *, queries: int = QUERIES, every: int = 1
) -> Iterator[DisturbedQuery]:
    """Every disturbance of some queries of a scene, then clean queries of other scenes.

    Args:
        scene: The scene.
        others: Scenes whose queries have no pose in this one; the scene itself is left out.
        queries: Number of queries per scene, spread evenly.
        every: 2: only every second one of all of these.
    """
    own = [(scene, query, name) for name in DISTURBANCES for query in spread(scene.queries, queries)]
    strange = [
        (other, query, "clean")
        for other in others
        if other.name != scene.name
        for query in spread(other.queries, queries)
    ]
    for owner, query, name in (own + strange)[::every]:
        made = disturbed(owner, query, name)
        yield made if owner is scene else of_other(scene.name, made)


def spread(queries: Sequence[PosedQuery], count: int) -> list[PosedQuery]:
    """This many of the queries, or all, spread evenly."""
    chosen = evenly_spaced(len(queries), count)
    return [queries[index] for index in chosen]


def of_other(scene: str, clean: DisturbedQuery) -> DisturbedQuery:
    """A clean query of another scene as a query of this one."""
    values = vars(clean) | {"scene": scene, "disturbance": OTHER, "group": OTHER, "cam_from_world": None}
    return DisturbedQuery(**values | {"name": f"{clean.scene}-{clean.name}"})


def disturbed(scene: MappedScene, query: PosedQuery, name: str) -> DisturbedQuery:
    """One disturbed query; its file and features are written unless they exist."""
    disturbance = DISTURBANCES[name]
    kept = scene.folder / f"{disturbance.pixels}-{query.path.stem}.npz"
    if not kept.exists():
        _prepare(scene, query, disturbance, kept)
    features, camera, has_pose = _read(kept)
    path = query.path if disturbance.pixels == _FILE else kept.with_suffix(".jpg")
    if (focal_mm := film_focal_mm(disturbance, camera)) is not None:
        path = scene.folder / f"{name}-{query.path.stem}.jpg"
        if not path.exists():
            _write_photo(path, _changed(scene, query, disturbance).image, focal_mm)
    return DisturbedQuery(
        scene=scene.name,
        disturbance=name,
        group=disturbance.group,
        name=query.path.stem,
        path=path,
        features=features,
        camera=camera,
        cam_from_world=query.cam_from_world if has_pose else None,
        believed=given_camera(disturbance, camera),
    )


def _prepare(scene: MappedScene, query: PosedQuery, disturbance: Disturbance, kept: Path) -> None:
    """Write the photo and, once it is complete, its features and camera."""
    scene.folder.mkdir(parents=True, exist_ok=True)
    path, view = query.path, View(image=_NOTHING, camera=query.camera, cam_from_world=query.cam_from_world)
    if disturbance.pixels != _FILE:
        path, view = kept.with_suffix(".jpg"), _changed(scene, query, disturbance)
        _write_photo(path, view.image, None)
    info = scene.full.info
    features = load_extractor(info.extractor, info.extractor_options).extract(
        read_image(path, info.orientation)
    )
    arrays = {
        field: getattr(features, field)
        for field in ("keypoints", "descriptors", "scores", "image_size", "frames")
        if getattr(features, field) is not None
    }
    np.savez(
        kept,
        model=view.camera.model_name,
        params=view.camera.params,
        size=(view.camera.width, view.camera.height),
        has_pose=view.cam_from_world is not None,
        **arrays,
    )


def _read(kept: Path) -> tuple[Features, pycolmap.Camera, bool]:
    """Features, true camera, and whether a pose can be right."""
    with np.load(kept) as stored:
        width, height = stored["size"].tolist()
        features = Features(
            keypoints=stored["keypoints"],
            descriptors=stored["descriptors"],
            scores=stored["scores"],
            image_size=(width, height),
            frames=stored.get("frames"),
        )
        camera = pycolmap.Camera(
            model=str(stored["model"]), width=width, height=height, params=stored["params"].tolist()
        )
        return features, camera, bool(stored["has_pose"])


def _changed(scene: MappedScene, query: PosedQuery, disturbance: Disturbance) -> View:
    seed = zlib.crc32(f"{disturbance.pixels}-{query.path.stem}".encode())
    place = Place(box=scene.full.box, rng=np.random.default_rng(seed))
    image = read_image(query.path, query.orientation)
    view = View(image=image, camera=query.camera, cam_from_world=query.cam_from_world)
    return CHANGES[disturbance.pixels](view, place)


def _write_photo(path: Path, image: Image, film_focal_mm: int | None) -> None:
    """Write a JPEG file, with EXIF if there is a focal length to write."""
    exif = PilImage.Exif()
    if film_focal_mm is not None:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = film_focal_mm
    with replacing(path, overwrite=True) as partial:
        PilImage.fromarray(image).save(partial, "JPEG", quality=_QUALITY, exif=exif)
