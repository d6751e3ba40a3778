"""How long extractors take for whole images of one size, in turns, in one run.

python benchmarks/extraction_speed.py PHOTOS --methods sift xfeat --weights WEIGHTS
"""

import argparse
from pathlib import Path
from time import perf_counter

import numpy as np

from slimsfm.features import Extractor, load_extractor
from slimsfm.image_files import list_images
from slimsfm.photos import read_photo, shrink
from slimsfm.weights import Runtime, use_runtime


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("photos", type=Path, help="folder of photos")
    parser.add_argument("--methods", nargs="+", default=["sift", "xfeat"])
    parser.add_argument("--size", type=int, default=640, help="longer side of the images, in pixels")
    parser.add_argument("--most", type=int, default=20, help="number of photos")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--device", default="cpu", choices=["auto", "cpu", "cuda"])
    options = parser.parse_args()
    names = list_images(options.photos)[: options.most]
    images = [shrink(read_photo(options.photos / name).image, options.size) for name in names]
    with use_runtime(Runtime(weights=options.weights, device=options.device)):
        extractors = [load_extractor(name) for name in options.methods]
        for one in extractors:
            one.extract(images[0])  # loads the network
        found = np.array([[_measured(one, image) for one in extractors] for image in images])
    for name, (seconds, count) in zip(options.methods, np.median(found, axis=0).tolist(), strict=True):
        print(f"{name:12} {1e3 * seconds:7.1f} ms, {count:.0f} keypoints")


def _measured(extractor: Extractor, image: np.ndarray) -> tuple[float, int]:
    start = perf_counter()
    features = extractor.extract(image)
    return perf_counter() - start, len(features)


if __name__ == "__main__":
    main()
