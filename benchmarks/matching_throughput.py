"""Matching by a network: pairs of images per second one at a time and in batches, and queries per second.

    python benchmarks/matching_throughput.py -o OUT --extractor aliked --weights WEIGHTS --device cuda
    python benchmarks/matching_throughput.py -o OUT --features 128 --pairs 4 --references 2

Missing weights are random, for which every keypoint goes through all layers; trained networks stop early. The
images are one picture, shifted by different distances. A query is extracted and matched with all references,
several queries at a time as `localize` does. The fastest of several rounds counts.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from onnx_speed import picture
from random_weights import write_random_weights
from slimsfm.arrays import Image, IndexPairs
from slimsfm.execution import map_on_threads, num_cores
from slimsfm.features import Extractor, Features, Matcher, load_extractor, load_matcher, match_many
from slimsfm.networks import batches
from slimsfm.networks.loading import choose_device
from slimsfm.weights import Runtime, use_runtime

Pairs = Sequence[tuple[Features, Features]]
Match = Callable[[Pairs], list[IndexPairs]]

SIZES = (2, 4, 8, 16, 32, 64)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    parser.add_argument("--extractor", default="superpoint")
    parser.add_argument("--matcher", default="lightglue")
    parser.add_argument("--features", type=int, default=1024, help="of an image, at most")
    parser.add_argument("--pairs", type=int, default=64)
    parser.add_argument("--references", type=int, nargs="*", default=[4, 64])
    parser.add_argument("--queries", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    use_runtime(Runtime(weights=folder(arguments.output, arguments.weights), device=arguments.device))
    extractor = load_extractor(arguments.extractor, {"max_features": arguments.features})
    matcher = load_matcher(arguments.matcher, arguments.extractor)
    print(f"{choose_device()}, {torch.get_num_threads()} threads, {arguments.extractor}, {arguments.matcher}")
    measure_pairs(extractor, matcher, arguments.pairs, arguments.rounds)
    for count in arguments.references:
        measure_queries(extractor, matcher, count, arguments.queries, arguments.rounds)


def folder(output: Path, weights: Path | None) -> Path:
    """A folder with the given weights, and random ones where they are missing."""
    made = write_random_weights(output / "weights")
    for path in sorted(weights.iterdir()) if weights else ():
        (made / path.name).unlink(missing_ok=True)
        (made / path.name).symlink_to(path.resolve())
    return made


def view(number: int) -> Image:
    """The picture, shifted."""
    return np.ascontiguousarray(np.roll(picture(), (13 * number, 29 * number), axis=(0, 1)))


def measure_pairs(extractor: Extractor, matcher: Matcher, count: int, rounds: int) -> None:
    """Pairs per second of one image with others: one at a time, as `match_many` chooses, and in batches."""
    query, *references = (extractor.extract(view(number)) for number in range(count + 1))
    pairs = [(query, reference) for reference in references]
    keypoints = np.mean([len(one) for one in references])
    print(f"{count} pairs of {len(query)} and {keypoints:.0f} keypoints: pairs per second")
    alone = fastest(lambda: one_at_a_time(matcher)(pairs), rounds)
    chosen = fastest(lambda: match_many(matcher, pairs), rounds)
    print(f"  one at a time {count / alone[0]:8.1f}")
    print(f"  match_many    {count / chosen[0]:8.1f}   {agreement(alone[1], chosen[1])}")
    for size in SIZES:
        if size <= count:
            seconds, found = fastest(lambda size=size: in_batches_of(matcher, pairs, size), rounds)
            print(f"  batches of {size:2d} {count / seconds:8.1f}   {agreement(alone[1], found)}", flush=True)


def measure_queries(extractor: Extractor, matcher: Matcher, count: int, queries: int, rounds: int) -> None:
    """Queries per second, each extracted and matched with some references."""
    references = [extractor.extract(view(number)) for number in range(count)]
    images = [view(number) for number in range(count, count + queries)]

    def run(match: Match) -> list[int]:
        def solve(image: Image) -> int:
            query = extractor.extract(image)
            return sum(map(len, match([(query, reference) for reference in references])))

        return list(map_on_threads(solve, images, num_cores()))

    alone = fastest(lambda: run(one_at_a_time(matcher)), rounds)[0]
    together = fastest(lambda: run(lambda pairs: match_many(matcher, pairs)), rounds)[0]
    print(
        f"{queries} queries, {count} references: queries per second one pair at a time "
        f"{queries / alone:.2f}, match_many {queries / together:.2f}",
        flush=True,
    )


def one_at_a_time(matcher: Matcher) -> Match:
    """Match pairs one after the other."""
    return lambda pairs: [matcher.match(*pair) for pair in pairs]


def in_batches_of(matcher: Matcher, pairs: Pairs, size: int) -> list[IndexPairs]:
    """Match pairs in batches of a size that memory does not choose."""
    chosen = batches.keypoint_pairs_of
    batches.keypoint_pairs_of = lambda _: 2**62
    try:
        parts = [match_many(matcher, pairs[start : start + size]) for start in range(0, len(pairs), size)]
    finally:
        batches.keypoint_pairs_of = chosen
    return [one for part in parts for one in part]


def fastest(function: Callable, rounds: int) -> tuple[float, list]:
    """The shortest of several times, after a first call that loads, and the result."""
    result, times = function(), []
    for _ in range(rounds):
        start = perf_counter()
        function()
        times.append(perf_counter() - start)
    return min(times), result


def agreement(one: list[IndexPairs], other: list[IndexPairs]) -> str:
    """How many pairs of images have the same matches."""
    equal = sum(map(np.array_equal, one, other))
    return f"{equal} of {len(one)} with the same matches, {sum(map(len, one))} in all"


if __name__ == "__main__":
    main()
