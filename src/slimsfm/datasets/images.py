"""Any folder of photos as a data set with pseudo ground truth.

No pose is known, so all images are reconstructed together, and the poses that this gives are taken for true.
Then the queries are held out: their keypoints go, and with them every point that fewer than two of the
remaining images observe. What is left is a map that knows nothing of them.
"""

from slimsfm.errors import InputError
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images

_TWO_VIEWS = 2


def query_names(names: list[str], every: int) -> list[str]:
    """Of the names in order every n-th one, starting with the first.

    Raises:
        InputError: No query or fewer than two references would be left.
    """
    queries = sorted(names)[::every] if every >= 1 else []
    if not queries or len(names) - len(queries) < _TWO_VIEWS:
        raise InputError(
            f"--query-every {every} leaves {len(names) - len(queries)} references of {len(names)} images; "
            "two are needed"
        )
    return queries


def hold_out(ground_truth: Map, queries: list[str]) -> Map:
    """The map without the queries: of the other images, and the points that two of them observe."""
    held_out = set(queries)
    references = [name for name in ground_truth.images if name not in held_out]
    return keep_images(ground_truth, references, min_track_length=_TWO_VIEWS)
