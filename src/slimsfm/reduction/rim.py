"""What keeps the rim of a capture: sets of images of each of which one is to be kept.

Stand at the object and look at the cameras around it. Where the capture ends, a query finds references on one
side only, and if those were localized from farther in, they are dropped and the query is left with nothing.
So two things are asked for, as groups of a `DominationProblem`, which cost the fewest images:

- a sector of the rim keeps an image that is nearly as far out as any in it;
- a part of the object's surface keeps an image that sees much of it.

The rim is found as the boundary of a set of points is: a point whose neighbours leave a wide angle empty [1].

References:
    [1] Bendels, Schnabel and Klein, Detecting holes in point set surfaces, WSCG 2006.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import csc_array, csr_array

from slimsfm.geometry import Box
from slimsfm.mapping.map import Map

_NEAR_DEG = 45.0  # between neighbours: where the next image is farther away, the capture has ended
_GAP_DEG = 120.0  # the angle without neighbours that makes an image one of the rim
_INWARD_DEG = 10.0  # that an image may be less far out than one that it stands for
_RELIABLE = 0.9  # share of the pairs within reach that localize each other
_CELLS = 4  # of the box along each edge
_MIN_POINTS = 20  # of a cell that counts
_SHARE = 0.5  # of a cell's points, of those that the image sees that sees the most of them

Directions = Float64[np.ndarray, "n 3"]
Member = Bool[np.ndarray, " n"]


def rim_groups(map: Map, adjacency: csr_array) -> csr_array:
    """Groups of images of each of which one is to be kept so that queries from the rim find images.

    Args:
        map: The map.
        adjacency: Entry [u, v] is true where image u localizes image v, in order of the map's names.

    Returns:
        Boolean matrix, a row a group, a column an image; no group is empty and none occurs twice.
    """
    rows = [*rim_sectors(viewing_directions(map), adjacency), *surface_parts(map)]
    groups = np.array(rows, dtype=bool).reshape(-1, len(map.images))
    return csr_array(np.unique(groups, axis=0))


def viewing_directions(map: Map) -> Directions:
    """Unit vectors from the centre of the box to the cameras, in order of name."""
    eyes = np.array([image.projection_center() for image in map.images.values()]) - map.box.center
    return eyes / np.maximum(np.linalg.norm(eyes, axis=1, keepdims=True), 1e-12)


def rim_sectors(directions: Directions, adjacency: csr_array) -> Iterator[Member]:
    """For each image at the rim, and each side on which it is, the images that can stand for it.

    An image is at the rim if its neighbours, the images within 45 degrees, leave an angle of 120 degrees or
    more without any; the middle of that angle is outward. Those that can stand for it localize it, are at
    most 10 degrees farther in, and are within the reach of the map: the angle within which nine of ten pairs
    of images localize each other. An image without neighbours is no rim.

    Images all around an object, as on a sphere, have no rim; those on a ring have one above and one below.

    Args:
        directions: From the object to the cameras.
        adjacency: Entry [u, v] is true where image u localizes image v.
    """
    dominators = csc_array(adjacency)
    reach_deg = reach(directions, adjacency)
    for i, here in enumerate(directions):
        angles_deg, ways = _angles_deg(directions, i), _ways(here, directions)
        neighbours = np.flatnonzero((angles_deg <= _NEAR_DEG) & ways.any(axis=1))
        localizes = np.zeros(len(directions), dtype=bool)
        localizes[dominators.indices[dominators.indptr[i] : dominators.indptr[i + 1]]] = True
        for outward in _outward(ways[neighbours]):
            members = localizes & (angles_deg <= reach_deg) & (angles_deg * (ways @ outward) >= -_INWARD_DEG)
            members[i] = True
            yield members


def reach(directions: Directions, adjacency: csr_array) -> int:
    """The most degrees such that nine of ten pairs of images within them localize each other; 0 if none."""
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
    """The way from a direction to each other one along the sphere, a unit vector; 0 where there is no way."""
    flat = directions @ np.linalg.svd(here[None])[2][1:].T
    lengths = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.where(lengths > 1e-9, flat / np.maximum(lengths, 1e-9), 0.0)


def _outward(ways: Float64[np.ndarray, "k 2"]) -> Iterator[np.ndarray]:
    """The middles of the wide angles without any way."""
    if len(ways) == 0:
        return
    bearings = np.sort(np.arctan2(ways[:, 1], ways[:, 0]))
    gaps = np.diff(np.append(bearings, bearings[0] + 2 * np.pi))
    for place in np.flatnonzero(gaps >= np.radians(_GAP_DEG)):
        middle = bearings[place] + gaps[place] / 2
        yield np.array([np.cos(middle), np.sin(middle)])


def surface_parts(map: Map) -> Iterator[Member]:
    """For each part of the object's surface the images that see much of it.

    The box is cut into 4 x 4 x 4 cells. A cell with 20 points or more is a part; an image sees much of it if
    it sees half as many of its points as the image does that sees the most.
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
    """The number of the cell of the box that each point is in; one more than the last if it is outside."""
    along = (points - box.center) @ np.linalg.pinv(box.half_edges)
    place = np.floor((along + 1) / 2 * _CELLS).astype(np.int64)
    inside = np.all((place >= 0) & (place < _CELLS), axis=1)
    return np.where(inside, place @ [_CELLS**2, _CELLS, 1], _CELLS**3)
