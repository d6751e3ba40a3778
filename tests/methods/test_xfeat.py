"""XFeat and LighterGlue against the authors' code, PyTorch's sampling and ONNX; see golden/README.md."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

torch = pytest.importorskip("torch")
pytest.importorskip("kornia")

import torch.nn.functional as F  # noqa: E402, N812

from networks.seeded_xfeat import (  # noqa: E402
    accept_seeded_xfeat,
    seeded_lighterglue,
    seeded_xfeat,
    write_seeded_xfeat,
)
from slimsfm.errors import InputError  # noqa: E402
from slimsfm.features import Features, load_extractor, load_matcher, unit_rows  # noqa: E402
from slimsfm.features.registry import export_method  # noqa: E402
from slimsfm.geometry import corner_error  # noqa: E402
from slimsfm.mapping.build import BuildOptions, KnownPoses, build_map  # noqa: E402
from slimsfm.mapping.io import write_map  # noqa: E402
from slimsfm.methods.lighterglue import LighterGlue  # noqa: E402
from slimsfm.methods.xfeat import CellMaps, describe_keypoints, find_keypoints, score_keypoints  # noqa: E402
from slimsfm.synthetic.objects import OBJECTS  # noqa: E402
from slimsfm.synthetic.scene import mapping_take, object_box  # noqa: E402
from slimsfm.weights import FOLDER, Runtime, use_runtime  # noqa: E402

SHARED = Path(__file__).parents[3] / "shared" / "weights"
GOLDEN = np.load(Path(__file__).parent / "golden" / "xfeat.npz")
needs_trained = pytest.mark.skipif(
    not (SHARED / "xfeat.pt").is_file(), reason="needs the trained XFeat weights in ../shared/weights"
)
KINDS = ["seeded", pytest.param("trained", marks=needs_trained)]
STEP = 32


@pytest.fixture
def seeded(tmp_path, monkeypatch):
    """The weights folder with seeded weights; networks run on the CPU."""
    accept_seeded_xfeat(monkeypatch)
    with use_runtime(Runtime(weights=write_seeded_xfeat(tmp_path), device="cpu")):
        yield tmp_path


@pytest.fixture
def weights(request, seeded):
    """The weights folder of a kind."""
    folder = seeded if request.getfixturevalue("kind") == "seeded" else SHARED
    with use_runtime(Runtime(weights=folder, device="cpu")):
        yield folder


def picture(name: str) -> np.ndarray:
    blocks = np.random.default_rng(2).integers(0, 256, (38, 58, 3), np.uint8)
    pixels = blocks.repeat(4, axis=0).repeat(4, axis=1)
    return pixels[:128, :192].copy() if name == "first" else pixels[8:152, 16:200].copy()


def of_the_authors(kind: str, name: str) -> Features:
    """Golden numbers; their keypoints are multiples of pixels of the input, whose corners we align."""
    height, width = picture(name).shape[:2]
    factors = np.array([width / (width // STEP * STEP), height / (height // STEP * STEP)], np.float32)
    return Features(
        keypoints=GOLDEN[f"{kind}_{name}_keypoints"] + factors / 2,
        descriptors=GOLDEN[f"{kind}_{name}_descriptors"],
        scores=GOLDEN[f"{kind}_{name}_scores"],
        image_size=(width, height),
    )


def assert_equal(one: Features, other: Features) -> None:
    """Equal up to rounding, which decides which of two equally good keypoints is the last."""
    near = np.abs(one.keypoints[:, None] - other.keypoints).max(axis=2) < 1e-3
    rows, columns = np.nonzero(near)
    assert len(rows) >= 0.99 * max(len(one), len(other)) > 50
    assert np.abs(one.scores[rows] - other.scores[columns]).max() < 1e-4
    difference = one.descriptors[rows].astype(np.float32) - other.descriptors[columns].astype(np.float32)
    assert np.abs(difference).max() < 2e-3


@pytest.mark.usefixtures("weights")
@pytest.mark.parametrize("name", ["first", "second"])
@pytest.mark.parametrize("kind", KINDS)
def test_features_are_those_of_the_authors(kind, name):
    found = load_extractor("xfeat", {"max_features": 250}).extract(picture(name))
    assert len(found) == 250
    assert_equal(found, of_the_authors(kind, name))


def test_the_networks_have_the_values_of_the_authors():
    for name, network in (("xfeat", seeded_xfeat()), ("lighterglue", seeded_lighterglue())):
        own = [f"{key} {tuple(value.shape)}" for key, value in sorted(network.state_dict().items())]
        assert own == GOLDEN[f"{name}_keys"].tolist()


def matched_features(kind: str) -> tuple[Features, Features]:
    """What the golden matches were made from: features of the pictures, or random ones and noisy copies."""
    if kind == "trained":
        return of_the_authors(kind, "first"), of_the_authors(kind, "second")
    rng = np.random.default_rng(3)
    keypoints, descriptors = rng.uniform(1, 199, (80, 2)).astype(np.float32), rng.standard_normal((80, 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    order = rng.permutation(80)[:60]
    noisy = descriptors[order] + 0.05 * rng.standard_normal((60, 64))
    return described(keypoints, descriptors), described(keypoints[order], noisy)


def described(keypoints: np.ndarray, descriptors: np.ndarray) -> Features:
    return Features(
        keypoints=keypoints,
        descriptors=descriptors.astype(np.float32),
        scores=np.ones(len(keypoints), np.float32),
        image_size=(200, 200),
    )


@pytest.mark.usefixtures("weights")
@pytest.mark.parametrize("kind", KINDS)
def test_matches_are_those_of_the_authors(kind):
    one, other = matched_features(kind)
    pairs = load_matcher("lighterglue", "xfeat").match(one, other)
    expected = GOLDEN[f"{kind}_pairs"]
    assert len(pairs) == len(expected) > 50
    assert {*map(tuple, pairs.tolist())} == {*map(tuple, expected.tolist())}


@pytest.mark.usefixtures("weights")
@pytest.mark.parametrize("kind", KINDS)
def test_match_scores_are_those_of_the_authors(kind):
    given = []
    for features in matched_features(kind):
        values = features.keypoints - np.float32(0.5), unit_rows(features.descriptors)
        names = "keypoints", "descriptors"
        one = {name: torch.from_numpy(value)[None] for name, value in zip(names, values, strict=True)}
        given.append(one | {"image_size": torch.tensor([features.image_size])})
    with torch.inference_mode():
        found = LighterGlue("xfeat").network({"image0": given[0], "image1": given[1]})
    scores = found["matching_scores0"][0].numpy()[GOLDEN[f"{kind}_pairs"][:, 0]]
    assert scores == pytest.approx(GOLDEN[f"{kind}_match_scores"], abs=5e-3 if kind == "trained" else 1e-4)


@given(seed=st.integers(0, 10_000), height=st.integers(1, 4), width=st.integers(1, 5))
def test_maps_are_sampled_as_pytorch_does(seed, height, width):
    rng = np.random.default_rng(seed)
    shape = STEP * height, STEP * width
    cells = shape[0] // 8, shape[1] // 8
    maps = CellMaps(
        scores=np.ones(shape, np.float32),
        reliability=rng.random(cells, np.float32),
        descriptors=rng.standard_normal((*cells, 64)).astype(np.float32),
    )
    pixels = rng.integers(0, shape[::-1], (40, 2))
    pixels[:2] = (0, 0), (shape[1] - 1, shape[0] - 1)
    grid = torch.from_numpy(2 * pixels / (np.array(shape[::-1]) - 1) - 1).float()[None, :, None]
    sampled = {}
    for mode, values in (("bilinear", maps.reliability[..., None]), ("bicubic", maps.descriptors)):
        given_map = torch.from_numpy(values).permute(2, 0, 1)[None]
        found = F.grid_sample(given_map, grid, mode=mode, align_corners=False)
        sampled[mode] = found[0, :, :, 0].T.numpy()
    assert score_keypoints(maps, pixels) == pytest.approx(sampled["bilinear"][:, 0], abs=1e-4)
    lengths = np.linalg.norm(sampled["bicubic"], axis=1, keepdims=True)
    assert describe_keypoints(maps, pixels) == pytest.approx(sampled["bicubic"] / lengths, abs=1e-3)


@given(seed=st.integers(0, 10_000))
def test_keypoints_are_the_best_pixels_around_them(seed):
    scores = np.random.default_rng(seed).integers(0, 50, (32, 64)).astype(np.float32) / 50
    found = {*map(tuple, find_keypoints(scores, 0.5).tolist())}
    for row, column in np.ndindex(31, 63):
        around = scores[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
        is_best = scores[row, column] == around.max() > 0.5 and (row, column) != (0, 0)
        assert ((column, row) in found) == is_best
    assert all(column < 63 and row < 31 for column, row in found)


def test_a_small_image_is_enlarged_and_a_plain_one_has_no_features(seeded):  # noqa: ARG001
    extractor = load_extractor("xfeat")
    small = extractor.extract(picture("first")[:20, :45].copy())
    assert small.image_size == (45, 20)
    assert ((small.keypoints > 0) & (small.keypoints < (45, 20))).all()
    with_black = extractor.extract(np.zeros((64, 64, 3), np.uint8))
    assert with_black.descriptors.shape[1] == 64
    mask = np.zeros((128, 192), np.uint8)
    assert load_extractor("xfeat").extract(picture("first"), mask).descriptors.shape == (0, 64)


def export(folder: Path, *methods: str) -> None:
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    for method in methods:
        export_method(method, folder / f"{method}.onnx")


def test_onnx_finds_what_pytorch_finds(seeded):
    image = cv2.resize(picture("first"), (211, 139))
    by_torch = load_extractor("xfeat").extract(image)
    export(seeded, "xfeat")
    (seeded / "xfeat.pt").unlink()
    assert_equal(load_extractor("xfeat").extract(image), by_torch)
    (seeded / "xfeat.onnx").write_bytes(b"damaged")
    with pytest.raises(InputError, match=r"xfeat\.onnx: onnxruntime cannot read it"):
        load_extractor("xfeat").extract(image)


def test_onnx_matches_what_pytorch_matches(seeded):
    one, other = matched_features("seeded")
    by_torch = load_matcher("lighterglue", "xfeat").match(one, other)
    export(seeded, "lighterglue")
    (seeded / "xfeat-lighterglue.pt").unlink()
    assert np.array_equal(load_matcher("lighterglue", "xfeat").match(one, other), by_torch)


WITHOUT_TORCH = """
import sys

for package in ("torch", "kornia", "transformers"):
    sys.modules[package] = None
"""
EXTRACT = """
import numpy as np
from slimsfm.errors import InputError
from slimsfm.features import load_extractor

image, out = np.load(sys.argv[1]), sys.argv[2]
try:
    found = load_extractor("xfeat").extract(image)
except InputError as error:
    sys.exit(str(error))
np.savez(out, keypoints=found.keypoints, descriptors=found.descriptors, scores=found.scores)
"""
COMMAND = """
from slimsfm.cli import run
sys.exit(run(sys.argv[1:]))
"""


def without_torch(code: str, *arguments: object, weights: Path) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", WITHOUT_TORCH + code, *map(str, arguments)]
    environment = {**os.environ, FOLDER: str(weights), "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)


def test_onnx_needs_no_pytorch(seeded, tmp_path):
    image = picture("second")
    paths = tmp_path / "image.npy", tmp_path / "out.npz"
    np.save(paths[0], image)
    done = without_torch(EXTRACT, *paths, weights=seeded)
    assert done.returncode == 1
    assert done.stderr.strip() == (
        "extractor 'xfeat' needs torch, which is not installed: pip install 'slimsfm[learned]'"
    )
    export(seeded, "xfeat")
    (seeded / "xfeat.pt").unlink()
    done = without_torch(EXTRACT, *paths, weights=seeded)
    assert done.returncode == 0, done.stderr
    found, here = np.load(paths[1]), load_extractor("xfeat").extract(image)
    for name in ("keypoints", "descriptors", "scores"):
        assert np.array_equal(found[name], getattr(here, name))


@needs_trained
def test_onnx_localizes_without_pytorch(tmp_path):
    """From the frames of a video around an object but one, whose pose is found."""
    take, left_out = mapping_take("printed_box", 80, 320, 240, 0), 4
    photos, onnx = tmp_path / "photos", tmp_path / "onnx"
    photos.mkdir()
    onnx.mkdir()
    frames = {f"{i}.png": i for i in range(8) if i != left_out}
    for name, i in frames.items():
        Image.fromarray(take.frame(i)).save(photos / name)
    Image.fromarray(take.frame(left_out)).save(tmp_path / "query.png")
    take.camera.camera_id = 1
    box = object_box(OBJECTS["printed_box"](0))
    known = KnownPoses(
        cameras=dict.fromkeys(frames, take.camera),
        cam_from_world={name: take.cam_from_object[i] for name, i in frames.items()},
        box=box,
        unit="metre",
    )
    with use_runtime(Runtime(weights=SHARED, device="cpu")):
        write_map(build_map(photos, BuildOptions(extractor="xfeat"), known=known), tmp_path / "map")
        export(onnx, "xfeat")
    for extraction in ("rounds", "whole"):
        out = tmp_path / f"{extraction}.json"
        given = "localize", tmp_path / "map", tmp_path / "query.png", "-o", out, "--extraction", extraction
        done = without_torch(COMMAND, *given, weights=onnx)
        assert done.returncode == 0, done.stderr
        (row,) = json.loads(out.read_text())["images"]
        pose = row["cam_from_world"]
        found = pycolmap.Rigid3d(pycolmap.Rotation3d(pose["quaternion_xyzw"]), pose["translation"])
        assert corner_error(found, take.cam_from_object[left_out], box) < 0.02


@needs_trained
def test_other_files_under_the_published_names_are_refused(tmp_path):
    whole = (SHARED / "xfeat.pt").read_bytes()
    with use_runtime(Runtime(weights=tmp_path, device="cpu")):
        for content in (whole[: len(whole) // 2], (SHARED / "aliked-t16.pth").read_bytes()):
            (tmp_path / "xfeat.pt").write_bytes(content)
            with pytest.raises(
                InputError, match=r"xfeat\.pt: not the published weights .*get xfeat\.pt from"
            ) as e:
                load_extractor("xfeat").extract(picture("first"))
            assert "\n" not in str(e.value)


def test_weights_of_another_network_are_refused(seeded):
    (seeded / "xfeat.pt").write_bytes((seeded / "xfeat-lighterglue.pt").read_bytes())
    with pytest.raises(InputError, match=r"xfeat\.pt: these are not the weights of XFeatModel"):
        load_extractor("xfeat").extract(picture("first"))
    torch.save(seeded_xfeat().state_dict(), seeded / "xfeat-lighterglue.pt")
    with pytest.raises(InputError, match=r"xfeat-lighterglue\.pt: these are not the weights of LightGlue"):
        load_matcher("lighterglue", "xfeat").match(*matched_features("seeded"))
