"""How many wrong poses `check` finds, how many right ones it blames, and what `repair` makes of the map.

    python benchmarks/check_poses.py -o /tmp/check --photos DIR ... --posed DIR --objects boulder printed_box
    python benchmarks/check_poses.py -o /tmp/check --maps MAP ...

Makes poses of right maps wrong: one image, 5 % and 10 %; a third each are moved, have another image's pose,
or stand at the twin position of a symmetric object. Points are triangulated again with the wrong poses, or
stay as they were. Prints what is found, and the share of held-out queries within 0.1 of the diagonal on the
right, the wrong and the repaired map. With `--rooms`, maps rendered rooms with patterned carpet by plain
pycolmap, and prints which images are really wrong, which are found, and which would be blamed if all stood
where they really do.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from time import process_time

import numpy as np

from benchmark_scenes import Scene, scenes
from plain_rooms import ROOMS, plain_room, really_wrong
from posed_scenes import posed
from slimsfm.evaluation.results import evaluate
from slimsfm.mapping import Map, read_map
from slimsfm.upkeep.checking import check
from slimsfm.upkeep.repair import repair
from wrong_maps import made_wrong, retriangulated


def rows(scene: Scene, shares: list[float], seeds: int) -> Iterator[list]:
    """The lines of the table for a scene."""
    right, total = scene.references, len(scene.references.images)
    clean = check(right)
    yield [
        scene.name,
        "as it is",
        0,
        "-",
        f"{len(clean.wrong)} of {total}",
        "-",
        "-",
        within(scene, right),
        "-",
    ]
    for retriangulate in (True, False):
        for share in shares:
            found = blamed = wrong = moved = dropped = 0
            seconds, before, after = [], "-", "-"
            for seed in range(seeds):
                made = made_wrong(right, max(1, round(share * total)), retriangulate=retriangulate, seed=seed)
                start = process_time()
                one = check(made.map)
                seconds.append(process_time() - start)
                names = set(one.wrong_names)
                wrong, found = wrong + len(made.wrong), found + len(names & made.wrong)
                blamed += len(names - made.wrong)
                repaired = repair(made.map, one)
                moved, dropped = moved + len(repaired.moved), dropped + len(repaired.dropped)
                if share == shares[-1] and seed == 0:
                    before, after = within(scene, made.map), within(scene, repaired.map)
            how = "triangulated again" if retriangulate else "points stay"
            alarms = f"{blamed} of {seeds * total - wrong}"
            outcome = f"{moved}, {dropped}"
            yield [
                scene.name,
                how,
                wrong,
                found,
                alarms,
                outcome,
                f"{np.median(seconds):.1f}",
                before,
                after,
            ]


def within(scene: Scene, map: Map) -> str:
    """Percentage of the queries within 0.1 of the diagonal."""
    if not scene.queries:
        return "-"
    outcomes = evaluate(map, scene.queries, "progressive")
    return f"{100 * np.mean(outcomes.error < 0.1):.1f}"


def print_room(name: str, output: Path) -> None:
    """Print what is really wrong in a room, and what is found."""
    room = plain_room(name, output)
    found = check(room.map)
    names = set(found.wrong_names)
    blamed = sorted(names - room.wrong)
    print(f"{name}: {len(room.map.images)} images, really wrong: {', '.join(sorted(room.wrong)) or 'none'}")
    print(f"found {len(names & room.wrong)} of {len(room.wrong)}, blamed: {', '.join(blamed) or 'none'}")
    right = check(retriangulated(room.map, room.true_poses)).wrong_names
    print(f"with the true poses: {len(right)} blamed ({', '.join(right) or 'none'})")
    repaired = repair(room.map, found).map
    left = really_wrong(repaired, room.take)
    print(f"after the repair: {len(repaired.images)} images, of which {len(left)} are wrong")
    for one in (
        *found.wrong,
        *found.misplaced,
        *found.contradicted_pairs,
        *found.unlocalized,
        *found.threads,
    ):
        print(f"  {type(one).__name__}: {one.sentence}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--photos", type=Path, nargs="*", default=[], help="folders of photos")
    parser.add_argument("--posed", type=Path, nargs="*", default=[], help="folders with a transforms.json")
    parser.add_argument("--objects", nargs="*", default=[], help="names of rendered objects")
    parser.add_argument("--maps", type=Path, nargs="*", default=[], help="full maps, without queries")
    parser.add_argument("--seeds", type=int, default=2, help="choices of wrong images (default: 2)")
    parser.add_argument("--shares", type=float, nargs="+", default=[0, 0.05, 0.1], help="wrong; 0: one image")
    parser.add_argument(
        "--rooms", nargs="*", default=[], choices=list(ROOMS), help="mapped by plain pycolmap"
    )
    wanted = parser.parse_args()
    for name in wanted.rooms:
        print_room(name, wanted.output)
    print("| scene | points | wrong | found | right, blamed | set right, dropped | CPU s | queries | after |")
    print("|---|---|---:|---:|---:|---:|---:|---:|---:|")
    made = (posed(folder, wanted.output) for folder in wanted.posed)
    maps = (Scene(name=path.name, references=read_map(path), bytes=0, queries=[]) for path in wanted.maps)
    for some in (maps, scenes(wanted.photos, wanted.objects, wanted.output), made):
        for scene in some:
            for row in rows(scene, wanted.shares, wanted.seeds):
                print("| " + " | ".join(map(str, row)) + " |", flush=True)


if __name__ == "__main__":
    main()
