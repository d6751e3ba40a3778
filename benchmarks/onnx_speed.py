"""Speed of learned methods on the CPU: PyTorch against onnxruntime, per extraction or matching.

    python benchmarks/onnx_speed.py -o /tmp/onnx --weights WEIGHTS

Missing weights are random, which changes only the time of LightGlue: with trained weights PyTorch stops as
soon as it is confident, while an ONNX file runs all layers. Both alternate. The smallest times count, once as
wall time and once as CPU time, which other programs disturb less.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, process_time

import cv2
import numpy as np
import torch

from random_weights import write_random_weights
from slimsfm.features import Features, load_extractor, load_matcher, unit_rows
from slimsfm.features.registry import export_method
from slimsfm.weight_files import WEIGHTS
from slimsfm.weights import Runtime, use_runtime

EXTRACTORS = {
    "superpoint": ("superpoint", {}),
    "aliked-n16": ("aliked", {"model": "aliked-n16"}),
    "aliked-t16": ("aliked", {"model": "aliked-t16"}),
    "disk": ("disk", {}),
    "xfeat": ("xfeat", {}),
}
COUNTS = (512, 1024, 2048)
SIZE = (640, 480)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=10)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    folders = prepare(arguments.output, arguments.weights)
    print(f"{arguments.threads} threads, {SIZE[0]} x {SIZE[1]} pixels; ms by the clock and of the processor")
    print(f"{'':24}{'PyTorch':>16}{'onnxruntime':>16}   ratio")
    image = picture()
    for method, (name, options) in EXTRACTORS.items():
        if (folders[1] / f"{method}.onnx").exists():
            ways = [load_extractor(name, options).extract for _ in folders]
            compare(method, folders, ways, (image,), arguments.repeats)
    for count in COUNTS:
        ways = [load_matcher("lightglue", "aliked").match for _ in folders]
        pair = described(count, 0), described(count, 1)
        compare(f"lightglue-aliked {count}", folders, ways, pair, arguments.repeats)


def prepare(output: Path, weights: Path | None) -> tuple[Path, Path]:
    """Two folders of weights, one of which also has ONNX files."""
    folders = output / "torch", output / "onnx"
    write_random_weights(folders[0])
    folders[1].mkdir(parents=True, exist_ok=True)
    for path in sorted(weights.iterdir()) if weights else ():
        (folders[0] / path.name).unlink(missing_ok=True)
        (folders[0] / path.name).symlink_to(path.resolve())
    for path in folders[0].iterdir():
        link = folders[1] / path.name
        link.unlink(missing_ok=True)
        link.symlink_to(path.resolve())
    use_runtime(Runtime(weights=folders[0], device="cpu"))
    known = [method for method in EXTRACTORS if (folders[0] / WEIGHTS[method].file).exists()]
    for method in (*known, "lightglue-aliked"):
        start = perf_counter()
        export_method(method, folders[1] / f"{method}.onnx", overwrite=True)
        print(f"exported {method} in {perf_counter() - start:.1f} s", flush=True)
    return folders


def picture() -> np.ndarray:
    """Noise of several scales."""
    rng = np.random.default_rng(0)
    layers = [
        cv2.GaussianBlur(rng.normal(size=(SIZE[1], SIZE[0], 3)).astype(np.float32), (0, 0), sigma) * sigma
        for sigma in (1.0, 2.0, 4.0, 8.0)
    ]
    return np.clip(128 + 90 * np.sum(layers, axis=0), 0, 255).astype(np.uint8)


def described(count: int, seed: int) -> Features:
    """Random keypoints with random descriptors."""
    rng = np.random.default_rng(seed)
    return Features(
        keypoints=rng.uniform((1, 1), np.array(SIZE) - 1, (count, 2)).astype(np.float32),
        descriptors=unit_rows(rng.normal(size=(count, 128))),
        scores=np.ones(count, np.float32),
        image_size=SIZE,
    )


def compare(title: str, folders: tuple[Path, Path], ways: list[Callable], given: tuple, repeats: int) -> None:
    """Print the times of both runtimes."""
    times = np.zeros((len(folders), repeats + 1, 2))
    for turn in range(repeats + 1):
        for way, folder in enumerate(folders):
            use_runtime(Runtime(weights=folder, device="cpu"))
            start = perf_counter(), process_time()
            ways[way](*given)
            times[way, turn] = perf_counter() - start[0], process_time() - start[1]
    least = 1e3 * times[:, 1:].min(axis=1)  # the first round loads
    by_clock, of_processor = least[0] / least[1]
    cells = "".join(f"{clock:8.0f}{processor:8.0f}" for clock, processor in least)
    print(f"{title:24}{cells}   {by_clock:.2f} {of_processor:.2f}", flush=True)


if __name__ == "__main__":
    main()
