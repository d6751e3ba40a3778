from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("kornia")

from networks.seeded import fill  # noqa: E402
from slimsfm.errors import InputError  # noqa: E402
from slimsfm.methods.loftr.cells import EncodedImage, ImageMatcher  # noqa: E402
from slimsfm.methods.loftr.matcher import Loftr  # noqa: E402
from slimsfm.methods.loftr.network import coarse_tokens, confidences, make_network  # noqa: E402
from slimsfm.weights import FOLDER  # noqa: E402

GOLDEN = np.load(Path(__file__).parent / "golden" / "loftr.npz")
CLOSE = 1e-4  # of confidences: processors round differently, by up to 3e-5 so far
BLOCKS = np.random.default_rng(2).integers(0, 256, (38, 58), dtype=np.uint8)
PICTURE = np.kron(BLOCKS, np.ones((4, 4), np.uint8))
IMAGE1, IMAGE2 = PICTURE[:128, :200], PICTURE[8:152, 16:200]


def seeded(weights, threshold=0.01):
    """A matcher with seeded weights."""
    is_plain = weights == "loftr"
    network = make_network(window=5 if is_plain else 9, coarse_context=is_plain).eval()
    fill(network, 0)
    with torch.no_grad():
        network.backbone.layer3_outconv.weight.mul_(2)  # else confidences are flat
    matcher = Loftr(weights=weights, threshold=threshold)
    matcher.__dict__["network"] = network
    return matcher


@pytest.fixture(scope="module")
def plain():
    return seeded("loftr")


@pytest.fixture(scope="module")
def for_maps():
    return seeded("loftr-onepose++")


def in_golden_order(points2D):
    """Row by row of cells, as the authors' code orders matches."""
    return np.lexsort(points2D.T)


def test_it_is_a_matcher_of_images(plain):
    assert isinstance(plain, ImageMatcher)
    assert isinstance(plain.encode(IMAGE1), EncodedImage)
    assert Loftr(**plain.options) == plain


def test_matches_are_those_of_the_authors_code(plain):
    found = plain.match_images(IMAGE1, IMAGE2)
    order = in_golden_order(found.points2D_1)
    assert np.abs(found.points2D_1[order] - 0.5 - GOLDEN["loftr_points1"]).max() < 1e-9
    assert np.abs(found.points2D_2[order] - 0.5 - GOLDEN["loftr_points2"]).max() < 1e-4
    assert np.abs(found.scores[order] - GOLDEN["loftr_scores"]).max() < CLOSE
    assert np.all(np.diff(found.scores) <= 0)


def test_confidences_are_those_of_the_authors_code(plain):
    one, other = (plain.encode(image).coarse for image in (IMAGE1, IMAGE2))
    with torch.inference_mode():
        sure = confidences(coarse_tokens(plain.network, one, other)).numpy()
    assert np.abs(sure.max(axis=1) - GOLDEN["loftr_best"]).max() < CLOSE
    assert np.abs(sure.max(axis=0) - GOLDEN["loftr_best_of_column"]).max() < CLOSE


def test_stages_for_maps_are_those_of_the_authors_code(for_maps):
    one, other = for_maps.encode(IMAGE1), for_maps.encode(IMAGE2)
    rough = for_maps.match_cells(one, other)
    order = in_golden_order(rough.points2D_1)
    cells1, cells2 = rough.points2D_1[order], rough.points2D_2[order]
    assert np.abs(cells1 - 0.5 - GOLDEN["onepose_cells1"]).max() < 1e-9
    assert np.abs(cells2 - 0.5 - GOLDEN["onepose_cells2"]).max() < 1e-9
    exact = for_maps.align(one, other, cells1, cells2)
    assert np.abs(exact - GOLDEN["onepose_points2"]).max() < 1e-4
    features = for_maps.describe(other, exact)
    assert np.abs(features.astype(np.float32) - GOLDEN["onepose_features2"]).max() < 0.01


@pytest.mark.parametrize("weights", ["loftr", "loftr-onepose++"])
def test_the_networks_have_the_authors_keys_and_shapes(weights, request):
    matcher = request.getfixturevalue("plain" if weights == "loftr" else "for_maps")
    state = matcher.network.state_dict()
    keys = sorted(f"{key} {tuple(value.shape)}" for key, value in state.items())
    assert keys == GOLDEN["loftr_keys" if weights == "loftr" else "onepose_keys"].tolist()


def test_cells_alone_match_as_they_do_with_all_features(for_maps):
    whole = for_maps.match_cells(for_maps.encode(IMAGE1), for_maps.encode(IMAGE2))
    one, other = (for_maps.encode(image, cells_only=True) for image in (IMAGE1, IMAGE2))
    cells = for_maps.match_cells(one, other)
    assert np.array_equal(cells.points2D_1, whole.points2D_1)
    assert np.array_equal(cells.points2D_2, whole.points2D_2)
    with pytest.raises(ValueError, match="encoded whole"):
        for_maps.align(one, other, cells.points2D_1, cells.points2D_2)


def test_matches_of_an_enlarged_image_are_enlarged(for_maps):
    """Pixels are exact: enlarging by whole factors moves what is at x to factor times x."""
    limited = Loftr(weights="loftr-onepose++", max_image_size=200, threshold=0.01)
    limited.__dict__["network"] = for_maps.network
    small = for_maps.match_images(IMAGE1, IMAGE2)
    large = limited.match_images(np.kron(IMAGE1, np.ones((3, 3), np.uint8)), IMAGE2)
    assert len(small) == len(large) > 20
    assert np.allclose(large.points2D_1, 3 * small.points2D_1)
    assert np.allclose(large.points2D_2, small.points2D_2, atol=1e-4)


def test_pixels_and_positions_are_inverse_and_cells_lie_in_the_middle_of_a_pixel(plain):
    encoded = plain.encode(np.zeros((99, 203, 3), np.uint8))
    assert encoded.image_size == (203, 99)
    assert encoded.coarse.shape[2:] == (12, 25)
    assert encoded.cell_px == pytest.approx(99 / 12)
    corner = encoded.pixels(torch.zeros(1, 2))
    assert np.allclose(corner, [[0.5 * 203 / 200, 0.5 * 99 / 96]])
    points2D = np.random.default_rng(0).uniform(0, 99, (10, 2))
    assert np.allclose(encoded.pixels(encoded.positions(points2D)), points2D, atol=1e-4)


def test_a_place_off_the_grid_stays_off_by_as_much(for_maps):
    one, other = for_maps.encode(IMAGE1), for_maps.encode(IMAGE2)
    places = np.array([[40.5, 48.5], [80.5, 64.5]])
    shift = np.array([16.0, 8.0])
    on_grid = for_maps.align(one, other, places, places - shift)
    off_grid = for_maps.align(one, other, places + 0.4, places - shift + 0.4)
    assert np.allclose(off_grid, on_grid + 0.4, atol=1e-4)


def test_images_without_matches_give_none(plain):
    one = plain.encode(np.zeros((64, 64, 3), np.uint8))
    strict = Loftr(threshold=0.99)
    strict.__dict__["network"] = plain.network
    found = strict.match(one, one)
    assert (len(found), found.points2D_1.shape, found.points2D_2.shape) == (0, (0, 2), (0, 2))
    assert plain.describe(one, found.points2D_1).shape == (0, 384)


def test_published_files_are_found_by_name_and_hold_the_framework_s_prefix(plain, tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    state = {f"matcher.{key}": value for key, value in plain.network.state_dict().items()}
    torch.save({"state_dict": state}, tmp_path / "loftr_outdoor.ckpt")
    loaded = Loftr(threshold=0.01).match_images(IMAGE1, IMAGE2)
    assert np.allclose(loaded.points2D_2, plain.match_images(IMAGE1, IMAGE2).points2D_2, atol=1e-3)
    (tmp_path / "LoFTR_wsize9.ckpt").hardlink_to(tmp_path / "loftr_outdoor.ckpt")
    with pytest.raises(InputError, match="is not one of its values"):
        Loftr(weights="loftr-onepose++").match_images(IMAGE1, IMAGE2)


@pytest.mark.parametrize("wrong", [{"max_image_size": 8}, {"threshold": 1.0}])
def test_options_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Loftr(**wrong)
