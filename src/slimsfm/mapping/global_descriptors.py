"""What each reference image looks like as a whole: by this those that resemble a query are found."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from slimsfm.arrays import Descriptors
from slimsfm.errors import InputError
from slimsfm.features import unit_rows
from slimsfm.features.vlad import learn_words, vlad
from slimsfm.mapping.map import GlobalDescriptors, Map
from slimsfm.mapping.point_file import UNREADABLE, pack, unpack

_SAMPLE = 500  # descriptors of one image that words are learned from


def with_global_descriptors(map: Map) -> Map:
    """The map with a global descriptor of each reference image."""
    return replace(map, global_descriptors=describe_images(map))


def describe_images(map: Map, seed: int = 0) -> GlobalDescriptors:
    """A global descriptor of each reference image.

    Words are learned from the map's own descriptors, and only keypoints that see a point of the map count:
    what is not in the map must not make a query resemble it. O(observations).
    """
    words = learn_words(np.concatenate([_seen(map, name)[:_SAMPLE] for name in map.images]), seed)
    rows = np.stack([vlad(_seen(map, name), words) for name in map.images])
    return GlobalDescriptors(vocabulary=words, descriptors=rows)


def _seen(map: Map, name: str) -> Descriptors:
    return unit_rows(map.features[name].descriptors[map.observations[name].rows])


def write_global_descriptors(path: Path, global_descriptors: GlobalDescriptors) -> None:
    """Write global descriptors: half a byte a value, as descriptors of points are."""
    with path.open("wb") as file:
        arrays: dict[str, Any] = {
            "words": global_descriptors.vocabulary,
            **pack(global_descriptors.descriptors),
        }
        np.savez(file, **arrays)


def read_global_descriptors(path: Path, num_images: int) -> GlobalDescriptors:
    """Read global descriptors of so many images.

    Raises:
        InputError: The file is damaged, or of another map.
    """
    try:
        with path.open("rb") as opened, np.load(opened) as file:
            words, rows = file["words"].astype(np.float32), unpack(file, num_images)
        if words.ndim != 2 or rows.shape[1] != words.size:
            raise ValueError(f"rows of {rows.shape[1]} values do not fit words of shape {words.shape}")
        return GlobalDescriptors(vocabulary=words, descriptors=rows)
    except UNREADABLE as error:
        raise InputError(f"{path}: damaged ({error}); build or import the map again") from error
