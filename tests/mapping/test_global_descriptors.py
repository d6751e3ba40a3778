from dataclasses import replace

import numpy as np
import pytest

from scenes import exact_map
from slimsfm.errors import MapError
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.descriptors import describe_images, with_global_descriptors
from slimsfm.mapping.io import bytes_by_part, read_map, write_map
from slimsfm.mapping.subset import direct_map, keep_images


@pytest.fixture(scope="module")
def narrow():
    """Twelve images that each observe a part of the points."""
    return with_global_descriptors(exact_map(num_images=12, num_points=400, reach_deg=60.0))


def test_an_image_is_most_similar_to_itself_and_then_to_its_neighbors(narrow):
    cosines = narrow.global_descriptors.descriptors @ narrow.global_descriptors.descriptors.T
    assert np.allclose(np.diag(cosines), 1, atol=1e-4)
    opposite = np.roll(cosines, 6, axis=1).diagonal()
    assert np.all(np.roll(cosines, 1, axis=1).diagonal() > opposite)


def test_keypoints_without_a_point_do_not_matter(narrow):
    features = {}
    for name, one in narrow.features.items():
        seen = np.zeros(len(one), bool)
        seen[narrow.observations[name].rows] = True
        features[name] = replace(one, descriptors=np.where(seen[:, None], one.descriptors, 0.5))
    assert np.array_equal(
        describe_images(replace(narrow, features=features)).descriptors, narrow.global_descriptors.descriptors
    )


def test_global_descriptors_are_read_back_up_to_rounding(narrow, tmp_path):
    write_map(narrow, tmp_path / "map")
    read = read_map(tmp_path / "map").global_descriptors
    assert np.array_equal(read.vocabulary, narrow.global_descriptors.vocabulary)
    assert np.all(np.sum(read.descriptors * narrow.global_descriptors.descriptors, axis=1) > 0.94)
    assert bytes_by_part(tmp_path / "map")["global.npz"] > 0


def test_kept_images_keep_their_global_descriptors(narrow):
    names = list(narrow.images)[2:9:3]
    slim = keep_images(narrow, names)
    rows = [list(narrow.images).index(name) for name in names]
    assert np.array_equal(slim.global_descriptors.descriptors, narrow.global_descriptors.descriptors[rows])
    assert direct_map(narrow, describe_points(narrow)).global_descriptors is None


def test_a_map_without_global_descriptors_is_read(narrow, tmp_path):
    write_map(replace(narrow, global_descriptors=None), tmp_path / "map")
    assert not (tmp_path / "map" / "global.npz").exists()
    assert read_map(tmp_path / "map").global_descriptors is None


def test_a_damaged_file_or_one_of_another_map_is_named(narrow, tmp_path):
    write_map(narrow, tmp_path / "map")
    path = tmp_path / "map" / "global.npz"
    whole = path.read_bytes()
    other = keep_images(narrow, list(narrow.images)[:3])
    write_map(other, tmp_path / "other")
    for content in (whole[: len(whole) // 2], b"", b"nonsense", (tmp_path / "other/global.npz").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(MapError, match=r"global\.npz: damaged"):
            read_map(tmp_path / "map")
