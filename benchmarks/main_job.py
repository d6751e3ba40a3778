"""Full against slim maps on folders of photos: accuracy, size of the dominating set and speed, in one run.

    python benchmarks/main_job.py ../shared/data/plush ../shared/data/fox -o /tmp/main-job

Runs `slimsfm benchmark images` on each folder and holds its results against the targets.
"""

import argparse
import json
from pathlib import Path

from slimsfm.cli import run


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("-o", "--output", required=True, type=Path)
    arguments = parser.parse_args()
    for folder in arguments.folders:
        output = arguments.output / folder.name
        if run(["benchmark", "images", str(folder), "-o", str(output), "--query-every", "3"]):
            raise SystemExit(2)
        report(folder.name, json.loads((output / "results.json").read_text()))


def report(name: str, results: dict) -> None:
    """Print what the targets speak of."""
    rows = {(row["strategy"], row["variant"]): row for row in results["rows"]}
    full, slim, random = (rows["exhaustive", variant] for variant in ("full", "dominating", "random"))
    speedup = (full["ms_match"] + full["ms_pose"]) / (slim["ms_match"] + slim["ms_pose"])
    print(f"{name}: full ADD-0.1d {full['add_0.1d']:.1f} % (target 100)")
    print(f"{name}: dominating set {len(results['objects'][name]['dominating_set'])} images")
    print(f"{name}: matching + pose {speedup:.1f} times faster (target 10)")
    print(f"{name}: random is {slim['add_0.1d'] - random['add_0.1d']:.1f} points below (target 5)")


if __name__ == "__main__":
    main()
