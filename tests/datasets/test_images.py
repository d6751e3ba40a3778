import pytest

from scenes import exact_map, with_matches
from slimsfm.datasets.base import hold_out
from slimsfm.datasets.reconstructed import query_names
from slimsfm.errors import InputError
from slimsfm.mapping.map import check_map

NAMES = [f"{i:02d}.jpg" for i in range(8)]


def test_every_third_from_the_first_is_a_query():
    assert query_names(NAMES, 3) == ["00.jpg", "03.jpg", "06.jpg"]
    assert query_names(NAMES[::-1], 3) == ["00.jpg", "03.jpg", "06.jpg"]
    assert query_names(NAMES, 100) == ["00.jpg"]


@pytest.mark.parametrize(
    ("names", "every"),
    [(NAMES, 1), (NAMES, 0), (NAMES, -2), (NAMES[:2], 2), (NAMES[:3], 2), ([], 3)],
    ids=str,
)
def test_two_references_and_a_query_are_required(names, every):
    with pytest.raises(InputError, match=f"`query_every={every}`"):
        query_names(names, every)


@pytest.mark.parametrize("every", [2, 3, 5])
def test_held_out_images_leave_no_trace(every):
    truth = with_matches(exact_map(num_images=9, reach_deg=60.0))
    queries = query_names(list(truth.images), every)
    references = hold_out(truth, queries)
    check_map(references)
    assert set(references.images) == set(truth.images) - set(queries)
    assert set(references.features) == set(references.images)
    assert not any(set(pair) & set(queries) for pair in references.matches)
    assert {image.name for image in references.model.images.values()} == set(references.images)
    for point in references.model.points3D.values():
        observers = {references.model.image(element.image_id).name for element in point.track.elements}
        assert len(observers) >= 2
        assert not observers & set(queries)


def test_exactly_the_points_that_two_references_observe_remain():
    truth = exact_map(num_images=9, reach_deg=60.0)
    queries = query_names(list(truth.images), 3)
    seen = [
        set(truth.point3D_ids[truth.observations[name].points].tolist())
        for name in truth.images
        if name not in queries
    ]
    expected = {point for point in truth.point3D_ids.tolist() if sum(point in one for one in seen) >= 2}
    assert set(hold_out(truth, queries).point3D_ids.tolist()) == expected
    assert 0 < len(expected) < len(truth.point3D_ids)


def test_the_full_map_is_unchanged():
    truth = exact_map(num_images=9, reach_deg=60.0)
    before = (list(truth.images), len(truth.model.points3D), truth.model.compute_num_observations())
    hold_out(truth, ["001.png", "004.png"])
    assert (list(truth.images), len(truth.model.points3D), truth.model.compute_num_observations()) == before
