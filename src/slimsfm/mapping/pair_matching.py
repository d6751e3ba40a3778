"""Matching pairs of images by any matcher, and verifying the matches by two-view geometry."""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.arrays import IndexPairs
from slimsfm.features import Features, Matcher
from slimsfm.mapping.pairs import Pairs
from slimsfm.progress import ProgressBar, silent

_CACHED = 256  # images whose features are kept in memory


def match_pairs_with(
    matcher: Matcher, features: Mapping[str, Features], pairs: Pairs, progress: ProgressBar = silent
) -> dict[tuple[str, str], IndexPairs]:
    """Match pairs of images by their features; pairs without a match are left out."""
    read = lru_cache(_CACHED)(features.__getitem__)
    found = {}
    for a, b in progress(pairs, "match pairs"):
        matches = matcher.match(read(a), read(b))
        if len(matches):
            found[a, b] = matches
    return found


def verify_pairs(
    database: Path, names: list[str], matches: Mapping[tuple[str, str], IndexPairs], *, seed: int
) -> None:
    """Write matches into a database whose images are numbered from 1 in order of names, and verify them."""
    ids = {name: image_id for image_id, name in enumerate(names, start=1)}
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        for (a, b), pairs in sorted(matches.items()):
            opened.write_matches(ids[a], ids[b], pairs.astype(np.uint32))
    verifier, geometry = pycolmap.GeometricVerifierOptions(), pycolmap.TwoViewGeometryOptions()
    verifier.num_threads = 1  # equal matches are to give equal inliers
    geometry.ransac.random_seed = seed
    pycolmap.geometric_verification(database, verifier, two_view_geometry_options=geometry)
