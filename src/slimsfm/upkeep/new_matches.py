"""Match new photos with images of a map and with each other, as building a map does."""

from collections.abc import Mapping

import numpy as np
import pycolmap

from slimsfm.features import load_matcher, runs_on_one_core, shrink_factor
from slimsfm.features.store import FeatureWriter
from slimsfm.geometry import resized_camera
from slimsfm.mapping.blocks import Workers
from slimsfm.mapping.map import Map
from slimsfm.mapping.matching import PairMatching, match_and_verify
from slimsfm.mapping.pairs import Matches
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.neighbors import Neighbors
from slimsfm.upkeep.new_photos import NewPhotos

_FILE = "neighbors.h5"  # features of the images that are matched


def match_new(
    map: Map,
    photos: NewPhotos,
    cameras: Mapping[str, pycolmap.Camera],
    neighbors: Neighbors,
    *,
    matcher: str = "nearest",
    seed: int = 0,
    workers: Workers = Workers(),
    progress: ProgressBar = silent,
) -> Matches:
    """Match pairs of images and verify the matches by two-view geometry.

    Args:
        map: The map.
        photos: The new photos; their workspace keeps the matches.
        cameras: Intrinsics of the new photos, by name.
        neighbors: Pairs of a new photo with another one or with an image of the map. Unsure ones of SIFT are
            left out unless their largest features match, as in a large build.
        matcher: Name of the matcher.
        seed: Seed of the verification.
        workers: Who matches.
        progress: Progress callback.
    """
    pairs = neighbors.pairs
    if not pairs:
        return {}
    names = sorted({name for pair in pairs for name in pair})
    of_image = {name: cameras[name] if name in cameras else map.camera(name) for name in names}
    file = photos.workspace.folder / _FILE
    with FeatureWriter(file) as writer:
        for name in names:
            writer.write(name, (photos.extracted if name in cameras else map).features[name])
    options = map.info.extractor_options
    factors = {name: shrink_factor(options, one.width, one.height) for name, one in of_image.items()}
    matching = PairMatching(
        features=file,
        turns={},
        factors=factors,
        cameras={name: resized_camera(one, 1 / factors[name]) for name, one in of_image.items()},
        matcher=load_matcher(matcher, map.info.extractor),
        one_thread=runs_on_one_core(matcher),
        seed=seed,
    )
    unsure = neighbors.unsure if map.info.extractor == "sift" else frozenset()
    geometries = match_and_verify(matching, pairs, photos.workspace, workers, progress, unsure=unsure)
    found = {
        pair: np.asarray(one.inlier_matches, np.int64).reshape(-1, 2) for pair, one in geometries.items()
    }
    return {pair: found[pair][np.argsort(found[pair][:, 0], kind="stable")] for pair in sorted(found)}
