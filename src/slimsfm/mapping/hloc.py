"""Export maps to hloc.

OUT/
  sfm/                COLMAP model; keypoint i of an image in it is row i of its features
  features.h5         the images' features
  matches.h5          verified matches of pairs of images; if the map has any
  references.txt      names of the images, one per line
  pairs-queries.txt   `query reference`, one pair per line; if queries are given

hloc multiplies descriptors as they are stored, so bytes become half floats of unit length. It measures
orientations in degrees. Keypoints stay single floats: hloc's half floats are off by up to a quarter of a
pixel beyond column 512, and by half a pixel beyond column 1024. hloc reads images as they are stored and
ignores their EXIF orientation, so a map of upright pictures is turned; mirrored images are left out.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.errors import InputError, MapError
from slimsfm.features import Features, unit_rows
from slimsfm.features.store import FeatureWriter, indistinct_names, write_matches
from slimsfm.files import contents_of, read_text, replacing
from slimsfm.image_files import list_images
from slimsfm.mapping.map import Map, check_num_features
from slimsfm.mapping.orientation import stored_model, turned_features, turns_to_stored


def write_hloc(map: Map, path: str | Path, queries: Iterable[str] = (), *, overwrite: bool = False) -> None:
    """Write a folder for hloc's `match_features` and `localize_sfm`.

    Args:
        map: A map with image features.
        path: The folder to write.
        queries: Names of queries; each is paired with every image of the map.
        overwrite: Replace an existing folder.

    Raises:
        MapError: The map is for direct matching only.
        InputError: A query has the name of an image of the map, a name in a pair has a space, or a name has a
            line break.
        OutputError: The folder exists and `overwrite` is off, or it cannot be written.
    """
    if map.is_for_direct_matching:
        raise MapError(
            "the map is for direct matching alone, and hloc matches images; "
            "reduce the full map for images instead"
        )
    if indistinct := indistinct_names(map.images):
        raise InputError(
            f"{indistinct[0]!r}: hloc's matches cannot tell this name from another that has - instead of /; "
            "rename the image"
        )
    turns, model = turns_to_stored(map), stored_model(map)
    pairs = _pairs(queries, map, list(turns))
    with replacing(Path(path), overwrite=overwrite) as partial:
        (partial / "sfm").mkdir(parents=True)
        model.write(partial / "sfm")
        _write_features(map, turns, partial / "features.h5")
        if map.matches:
            counts = {name: image.num_points2D() for name, image in map.images.items()}
            kept = {pair: map.matches[pair] for pair in map.matches if turns.keys() >= set(pair)}
            write_matches(partial / "matches.h5", kept, counts)
        _write_lines(partial / "references.txt", turns)
        if pairs:
            _write_lines(partial / "pairs-queries.txt", (f"{query} {name}" for query, name in pairs))


def read_query_names(path: str | Path) -> list[str]:
    """Read the names of queries from a folder of images or a text file.

    Args:
        path: A folder, or a file with a name or hloc's `NAME MODEL WIDTH HEIGHT PARAMS...` per line.

    Raises:
        InputError: The file is missing or holds no name, or a line has another format.
    """
    path = Path(path)
    if path.is_dir():
        return list_images(path)
    with contents_of(path, "neither a folder of images nor a readable list of names"):
        lines = read_text(path).splitlines()
    names = [_name(line, path) for line in lines if line.strip() and not line.startswith("#")]
    if not names:
        raise InputError(f"{path}: holds no name of a query")
    return list(dict.fromkeys(names))


def _name(line: str, path: Path) -> str:
    name, *camera = line.split()
    if camera and camera[0] not in pycolmap.CameraModelId.__members__:
        raise InputError(
            f"{path}: {line.strip()!r} is neither a name without spaces "
            "nor `NAME MODEL WIDTH HEIGHT PARAMS...`"
        )
    return name


def _pairs(queries: Iterable[str], map: Map, references: list[str]) -> list[tuple[str, str]]:
    pairs = [(query, name) for query in queries for name in references]
    for name in dict.fromkeys(name for pair in pairs for name in pair):
        if len(name.split()) > 1:
            raise InputError(f"{name!r}: hloc cannot read pairs of names with spaces; rename the image")
    for query, _ in pairs:
        if query in map.images:
            raise InputError(
                f"query {query!r} has the name of an image of the map, and hloc identifies images by name; "
                "list only queries"
            )
    return pairs


def _write_features(map: Map, turns: Mapping[str, int], path: Path) -> None:
    with FeatureWriter(path) as writer:
        for name, turn in turns.items():
            features = map.features[name]
            check_num_features(map.images[name], len(features))
            writer.write(name, _as_in_hloc(turned_features(features, turn)))


def _as_in_hloc(features: Features) -> Features:
    descriptors, frames = features.descriptors, features.frames
    if not np.issubdtype(descriptors.dtype, np.floating):
        descriptors = unit_rows(descriptors).astype(np.float16)
    if frames is not None:
        frames = np.stack([frames[:, 0], np.degrees(frames[:, 1])], axis=1)
    return replace(features, descriptors=descriptors, frames=frames)


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    lines = list(lines)
    if broken := [line for line in lines if line.splitlines() != [line]]:
        raise InputError(f"{broken[0]!r}: a list with a name per line cannot hold it; rename the image")
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
