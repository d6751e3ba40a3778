"""onnxruntime computes what PyTorch computes."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("kornia")
pytest.importorskip("transformers")
pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")

from kornia.feature import ALIKED  # noqa: E402
from kornia.feature.aliked.aliked import DeformableConv2d  # noqa: E402
from torch import Tensor, nn  # noqa: E402
from transformers import SuperPointConfig, SuperPointForKeypointDetection  # noqa: E402

from networks.seeded import fill  # noqa: E402
from slimsfm.errors import InputError  # noqa: E402
from slimsfm.features import Features, load_extractor, unit_rows  # noqa: E402
from slimsfm.features.registry import export_method  # noqa: E402
from slimsfm.methods.aliked import AlikedMaps, Deformable, dense_maps  # noqa: E402
from slimsfm.methods.lightglue import LightGlue, Network, network_for  # noqa: E402
from slimsfm.methods.superpoint import SuperPoint  # noqa: E402
from slimsfm.networks.onnx import Exportable, onnx_run, write_onnx  # noqa: E402
from slimsfm.weights import Runtime, use_runtime  # noqa: E402

SHARED = Path(__file__).parents[3] / "shared" / "weights"


@pytest.fixture
def folder(tmp_path):
    """The weights folder; networks run on the CPU."""
    with use_runtime(Runtime(weights=tmp_path, device="cpu")):
        yield tmp_path


def picture(height: int, width: int) -> np.ndarray:
    blocks = np.random.default_rng(0).integers(0, 256, (-(-height // 5), -(-width // 5), 3), np.uint8)
    return blocks.repeat(5, axis=0).repeat(5, axis=1)[:height, :width]


def tensor(*shape: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(0).random(shape, np.float32))


def part(network: nn.Module, *shape: int, free: tuple[int, ...] = ()) -> Exportable:
    return Exportable(network=network, inputs={"x": tensor(*shape)}, dynamic={"x": free}, outputs=("y",))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    """A network of one layer in a file that claims to be DISK."""
    path = tmp_path_factory.mktemp("tiny") / "disk.onnx"
    network = nn.Conv2d(2, 3, 3)
    fill(network, 0)
    write_onnx(part(network, 1, 2, 8, 9, free=(2, 3)), "disk", path)
    return path


def test_inputs_of_any_size_give_what_pytorch_gives(tiny, folder):
    network = nn.Conv2d(2, 3, 3)
    fill(network, 0)
    (folder / "disk.onnx").write_bytes(tiny.read_bytes())
    run = onnx_run("disk")
    assert run is not None
    for size in ((8, 9), (20, 31)):
        (found,) = run(tensor(1, 2, *size))
        assert torch.allclose(found, network(tensor(1, 2, *size)), atol=1e-6)


def test_the_file_does_not_contain_local_paths(tiny):
    assert str(Path.home()).encode() not in tiny.read_bytes()
    assert b"site-packages" not in tiny.read_bytes()


def test_pytorch_runs_without_a_file_and_on_a_gpu(tiny, folder, monkeypatch):
    assert onnx_run("disk") is None
    (folder / "disk.onnx").write_bytes(tiny.read_bytes())
    assert onnx_run("disk") is onnx_run("disk") is not None
    with use_runtime(Runtime(device="cpu")):
        assert onnx_run("disk") is None
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    with use_runtime(Runtime(weights=folder, device="cuda")):
        assert onnx_run("disk") is None


def test_files_of_other_methods_are_refused(tiny, folder):
    (folder / "superpoint.onnx").write_bytes(tiny.read_bytes())
    with pytest.raises(
        InputError, match=r"superpoint\.onnx: was not written by slimsfm export onnx superpoint"
    ):
        onnx_run("superpoint")
    (folder / "superpoint.onnx").write_bytes(b"something")
    with pytest.raises(InputError, match=r"superpoint\.onnx: onnxruntime cannot read it .* export it again"):
        onnx_run("superpoint")


def test_a_file_with_other_weights_is_refused(folder):
    (folder / "depth-save.pth").write_bytes(b"some weights")
    write_onnx(part(nn.Identity(), 1, 2), "disk", folder / "disk.onnx")
    assert onnx_run("disk") is not None
    os.utime(folder / "disk.onnx", ns=(1, 1))  # so that the file is loaded again
    (folder / "depth-save.pth").write_bytes(b"other weights")
    with pytest.raises(InputError, match=r"disk\.onnx: was exported from other weights than depth-save\.pth"):
        onnx_run("disk")


def test_a_missing_package_is_named(tiny, folder, monkeypatch):
    (folder / "disk.onnx").write_bytes(tiny.read_bytes())
    for package in ("onnx", "onnxruntime"):
        monkeypatch.setitem(sys.modules, package, None)
    message = r"ONNX files need {}, which is not installed: pip install 'slimsfm\[onnx\]'"
    with pytest.raises(InputError, match=message.format("onnxruntime")):
        onnx_run("disk")
    with pytest.raises(InputError, match=message.format("onnx")):
        write_onnx(part(nn.Identity(), 1, 2), "disk", folder / "disk.onnx")


@pytest.fixture
def superpoint(folder) -> SuperPointForKeypointDetection:
    """Seeded weights that find keypoints, stored in the folder."""
    network = SuperPointForKeypointDetection(SuperPointConfig(keypoint_threshold=0.02)).eval()
    fill(network, 0)
    torch.save(network.state_dict(), folder / "superpoint_v1.pth")
    return network


def test_superpoint_finds_what_the_library_finds(superpoint):
    image = picture(90, 131)
    extractor = SuperPoint(threshold=0.02)
    features = extractor.extract(image)
    assert len(features) > 50
    gray = torch.from_numpy(image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32) / 255)
    with torch.inference_mode():
        found = superpoint(gray.expand(1, 3, -1, -1))
    pixels = found.keypoints[0].numpy() * (131, 90)
    inside = (pixels < np.array([131, 90]) // 8 * 8 - 4).all(axis=1)  # transformers forgets these two sides
    order = np.argsort(-found.scores[0].numpy(), kind="stable")
    order = order[inside[order]]
    keypoints = pixels[order] + 0.5
    assert np.allclose(features.keypoints, keypoints, atol=1e-3)
    assert np.allclose(features.descriptors, found.descriptors[0].numpy()[order], atol=1e-3)


def test_superpoint_finds_by_onnx_what_it_finds_by_pytorch(superpoint, folder):  # noqa: ARG001
    image, extractor = picture(121, 97), SuperPoint(threshold=0.02)
    by_torch = extractor.extract(image)
    export_method("superpoint", folder / "superpoint.onnx")
    (folder / "superpoint_v1.pth").unlink()
    assert_equal(SuperPoint(threshold=0.02).extract(image), by_torch)
    (folder / "superpoint.onnx").write_bytes(b"damaged")
    with pytest.raises(InputError):
        extractor.extract(image)


def assert_equal(one: Features, other: Features) -> None:
    assert len(one) == len(other) > 50
    assert np.abs(one.keypoints - other.keypoints).max() < 1e-3
    difference = one.descriptors.astype(np.float32) - other.descriptors.astype(np.float32)
    assert np.abs(difference).max() < 1e-3
    assert np.abs(one.scores - other.scores).max() < 1e-4


@pytest.fixture
def one_layer(folder, monkeypatch):
    """LightGlue with seeded weights, a single layer because all are alike, that matches similar features."""
    monkeypatch.setitem(Network.default_conf, "n_layers", 1)
    network = network_for("sift")
    fill(network, 0)
    with torch.no_grad():
        network.get_parameter("input_proj.weight").mul_(4)
        for block in ("self_attn", "cross_attn"):
            network.get_parameter(f"transformers.0.{block}.ffn.3.weight").mul_(0.1)
        network.get_parameter("log_assignment.0.final_proj.weight").mul_(2)
        network.get_parameter("log_assignment.0.matchability.bias").fill_(5)
    torch.save(network.state_dict(), folder / "sift_lightglue.pth")
    return network.eval()


def described(rng, count) -> Features:
    return Features(
        keypoints=rng.uniform((1, 1), (319, 239), (count, 2)).astype(np.float32),
        descriptors=unit_rows(rng.normal(size=(count, 128))),
        scores=rng.uniform(0.1, 1, count).astype(np.float32),
        image_size=(320, 240),
        frames=rng.uniform(1, 3, (count, 2)).astype(np.float32),
    )


def of_kornia(features: Features) -> dict[str, Tensor]:
    """The input that kornia's LightGlue takes."""
    given = {
        "keypoints": features.keypoints - np.float32(0.5),
        "descriptors": unit_rows(features.descriptors),
        "image_size": np.array(features.image_size, np.float32),
        "scales": features.frames[:, 0],
        "oris": features.frames[:, 1],
    }
    return {key: torch.from_numpy(np.ascontiguousarray(value))[None] for key, value in given.items()}


def test_lightglue_matches_by_onnx_what_it_matches_by_pytorch(one_layer, folder):
    rng = np.random.default_rng(0)
    one = described(rng, 60)
    order = rng.permutation(60)[:45]
    other, alone = one[order], one[order[:1]]
    matcher = LightGlue("sift")
    matcher.network.conf.width_confidence = matcher.network.conf.depth_confidence = -1
    by_torch = matcher.match(one, other)
    assert len(by_torch) > 30
    assert np.mean(order[by_torch[:, 1]] == by_torch[:, 0]) > 0.9
    with torch.inference_mode():
        inputs = {f"image{i}": of_kornia(features) for i, features in enumerate((one, other))}
        one_layer.conf.width_confidence = one_layer.conf.depth_confidence = -1
        of_library = one_layer(inputs)["matches"][0].numpy()
    assert np.array_equal(by_torch, of_library)
    export_method("lightglue-sift", folder / "lightglue-sift.onnx")
    assert np.array_equal(LightGlue("sift").match(one, other), by_torch)
    assert LightGlue("sift").match(alone, other).tolist() == [[0, 0]]


def test_deformable_convolution_is_the_librarys_by_pytorch_and_onnx(folder):
    layer = DeformableConv2d(4, 5).eval()
    fill(layer, 0)
    with torch.no_grad():
        layer.offset_conv.weight.mul_(3)
    ours = Deformable(layer)
    write_onnx(part(ours, 1, 4, 6, 7, free=(2, 3)), "disk", folder / "disk.onnx")
    run = onnx_run("disk")
    assert run is not None
    for size in ((6, 7), (9, 24), (1, 3)):
        features = tensor(1, 4, *size)
        expected = layer(features)
        assert torch.allclose(ours(features), expected, atol=1e-5)
        assert torch.allclose(run(features)[0], expected, atol=1e-5)


@pytest.mark.parametrize("model", ["aliked-n16", "aliked-t16"])
@pytest.mark.parametrize("size", [(64, 96), (75, 101)])
def test_aliked_sees_what_the_library_sees(model, size):
    made = [ALIKED(model).eval().requires_grad_(False) for _ in range(2)]
    for network in made:
        fill(network, 0)
    pixels = tensor(1, 3, *size)
    features, scores = made[0].extract_dense_map(pixels)
    found = dense_maps(AlikedMaps(made[1]), pixels)
    assert torch.allclose(found.scores, scores, atol=1e-5)
    assert torch.allclose(found.features, features, atol=1e-5)


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the trained ALIKED weights in ../shared/weights")
def test_aliked_finds_what_the_library_finds():
    image = picture(150, 210)
    with use_runtime(Runtime(weights=SHARED, device="cpu")):
        features = load_extractor("aliked").extract(image)
    network = ALIKED("aliked-n16", 2048, 0.2).eval()
    state = torch.load(SHARED / "aliked-n16.pth", weights_only=True)
    network.load_state_dict(state | {"dkd.hw_grid": network.dkd.hw_grid})
    with torch.inference_mode():
        found = network(torch.from_numpy(image / np.float32(255)).permute(2, 0, 1)[None])[0]
    order = np.argsort(-found.keypoint_scores.numpy(), kind="stable")
    expected = Features(
        keypoints=found.keypoints.numpy()[order] + np.float32(0.5),
        descriptors=found.descriptors.numpy()[order],
        scores=found.keypoint_scores.numpy()[order],
        image_size=(210, 150),
    )
    assert_equal(features, expected)
