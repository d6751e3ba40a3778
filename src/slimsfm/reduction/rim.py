"""The rim of a capture, kept by groups: one image of each group must be kept.

Where the cameras around an object end, a query has references on one side only. If these are localized by
images farther from the rim, they are dropped, and no reference near the query remains. Two kinds of groups of
a `DominationProblem` prevent this at the cost of the fewest images:

- a sector of the rim keeps an image that is nearly as far out as any in it;
- a part of the object's surface keeps an image that sees much of it.

The rim is the boundary of a set of directions: its neighbors leave a wide angle empty [1].

References:
    [1] Bendels, Schnabel and Klein, Detecting holes in point set surfaces, WSCG 2006.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import csc_array, csr_array

from slimsfm.geometry import Box
from slimsfm.mapping.map import Map

_NEAR_DEG = 45.0  # between neighbors: if the next image is farther away, the capture ends here
_GAP_DEG = 120.0  # an image without neighbors in an angle this wide is at the rim
_INWARD_DEG = 10.0  # an image may stand for another if it is at most this much farther in
_RELIABLE = 0.9  # share of the image pairs within reach that localize each other
_CELLS = 4  # along each edge of the box
_MIN_POINTS = 20  # of a cell that is a part of the surface
_SHARE = 0.5  # of the most points of a cell that any image sees

Directions = Float64[np.ndarray, "n 3"]
Member = Bool[np.ndarray, " n"]


def rim_groups(map: Map, adjacency: csr_array) -> csr_array:
    """Find groups of images, of each of which one must be kept so that queries at the rim find references.

    Args:
        map: The map.
        adjacency: Entry [u, v] is true where image u localizes image v, in order of the map's names.

    Returns:
        Boolean matrix with one row per group and one column per image; no group is empty or occurs twice.
    """
    rows = [*rim_sectors(viewing_directions(map), adjacency), *surface_parts(map)]
    groups = np.array(rows, dtype=bool).reshape(-1, len(map.images))
    return csr_array(np.unique(groups, axis=0))


def viewing_directions(map: Map) -> Directions:
    """Unit vectors from the center of the box to the cameras, in order of name."""
    eyes = np.array([image.projection_center() for image in map.images.values()]) - map.box.center
    return eyes / np.maximum(np.linalg.norm(eyes, axis=1, keepdims=True), 1e-12)


def rim_sectors(directions: Directions, adjacency: csr_array) -> Iterator[Member]:
    """For each image at the rim, and each of its open sides, the images that can stand for it.

    An image is at the rim if its neighbors, the images within 45 degrees, leave an angle of 120 degrees or
    more empty; the middle of that angle is outward. The images that can stand for it localize it, are at most
    10 degrees farther in, and are within the reach of the map: the angle within which nine of ten pairs of
    images localize each other. An image without neighbors is not at the rim.

    Images all around an object, as on a sphere, have no rim; those on a ring have one above and one below.

    Args:
        directions: From the object to the cameras.
        adjacency: Entry [u, v] is true where image u localizes image v.
    """
    dominators = csc_array(adjacency)
    reach_deg = reach(directions, adjacency)
    for i, here in enumerate(directions):
        angles_deg, ways = _angles_deg(directions, i), _ways(here, directions)
        neighbors = np.flatnonzero((angles_deg <= _NEAR_DEG) & ways.any(axis=1))
        localizes = np.zeros(len(directions), dtype=bool)
        localizes[dominators.indices[dominators.indptr[i] : dominators.indptr[i + 1]]] = True
        for outward in _outward(ways[neighbors]):
            members = localizes & (angles_deg <= reach_deg) & (angles_deg * (ways @ outward) >= -_INWARD_DEG)
            members[i] = True
            yield members


def reach(directions: Directions, adjacency: csr_array) -> int:
    """The largest angle in degrees within which nine of ten pairs of images localize each other, or 0."""
    pairs, edges = np.zeros((2, 181))
    for i in range(len(directions)):
        degrees = np.ceil(_angles_deg(directions, i)).astype(np.int64)
        others = adjacency.indices[adjacency.indptr[i] : adjacency.indptr[i + 1]]
        pairs += np.bincount(np.delete(degrees, i), minlength=181)
        edges += np.bincount(degrees[others[others != i]], minlength=181)
    reliable = np.cumsum(edges) >= _RELIABLE * np.maximum(np.cumsum(pairs), 1)
    return int(np.flatnonzero(reliable).max(initial=0))


def _angles_deg(directions: Directions, i: int) -> Float64[np.ndarray, " n"]:
    return np.degrees(np.arccos(np.clip(directions @ directions[i], -1, 1)))


def _ways(here: np.ndarray, directions: Directions) -> Float64[np.ndarray, "n 2"]:
    """Unit vectors along the sphere from a direction to all others; 0 where they coincide."""
    flat = directions @ np.linalg.svd(here[None])[2][1:].T
    lengths = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.where(lengths > 1e-9, flat / np.maximum(lengths, 1e-9), 0.0)


def _outward(ways: Float64[np.ndarray, "k 2"]) -> Iterator[np.ndarray]:
    """The middles of the wide angles without any neighbor."""
    if len(ways) == 0:
        return
    bearings = np.sort(np.arctan2(ways[:, 1], ways[:, 0]))
    gaps = np.diff(np.append(bearings, bearings[0] + 2 * np.pi))
    for place in np.flatnonzero(gaps >= np.radians(_GAP_DEG)):
        middle = bearings[place] + gaps[place] / 2
        yield np.array([np.cos(middle), np.sin(middle)])


def surface_parts(map: Map) -> Iterator[Member]:
    """For each part of the object's surface, the images that see much of it.

    The box is divided into 4 x 4 x 4 cells. A cell with 20 points or more is a part of the surface. An image
    sees much of it if it sees at least half of the most points of the cell that any image sees.
    """
    cells = _cells(map.points3D_in_world, map.box)
    count = _CELLS**3
    sizes = np.bincount(cells, minlength=count + 1)[:count]
    seen = np.array(
        [np.bincount(cells[np.unique(o.points)], minlength=count + 1) for o in map.observations.values()]
    )
    for cell in np.flatnonzero(sizes >= _MIN_POINTS):
        most = seen[:, cell].max()
        if most > 0:
            yield seen[:, cell] >= _SHARE * most


def _cells(points: np.ndarray, box: Box) -> np.ndarray:
    """Index of the cell of the box that contains each point; one past the last if it is outside."""
    along = (points - box.center) @ np.linalg.pinv(box.half_edges)
    place = np.floor((along + 1) / 2 * _CELLS).astype(np.int64)
    inside = np.all((place >= 0) & (place < _CELLS), axis=1)
    return np.where(inside, place @ [_CELLS**2, _CELLS, 1], _CELLS**3)
