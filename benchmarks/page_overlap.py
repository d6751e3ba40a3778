"""How exactly and how soon the page of `slimsfm serve` draws an object's box over a live picture.

    python benchmarks/page_overlap.py -o /tmp/page

A headless Chromium has a rendered film as its camera: a hand walks around a printed box among clutter, and
looks away for a second. The pixels that the page shows tell which frame of the film it is (a bar code) and
where the box is drawn. Their overlap with the true outline in this frame, intersection over union, includes
all that can be wrong: the pose, the intrinsics, the painter, and whether picture and pose belong together.
Writes OUTPUT/map, a reduced map, OUTPUT/film-30.y4m and the pictures of the best and the worst overlap.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep

import numpy as np
import pycolmap
from PIL import Image as PilImage

from page_film import (
    KEEP_PIXELS,
    RECORD,
    NumberedFilm,
    Return,
    decoded,
    overlap,
    picture_in,
    returns,
    shown_as_png,
)
from slimsfm.datasets.base import map_object
from slimsfm.datasets.onepose import read_object
from slimsfm.datasets.synthetic import SynthesisOptions, synthesize
from slimsfm.mapping.io import write_map
from slimsfm.reduction import reduce
from slimsfm.synthetic.render import render
from slimsfm.synthetic.scene import (
    elsewhere,
    eyes,
    look_at,
    phone_camera,
    textured_object,
    viewing_distance,
    with_noise,
)

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from browser import Page, open_page

NAME, WIDTH, HEIGHT, FRAMES, SEED = "printed_box", 640, 480, 240, 0
_AWAY = (0.70, 0.73, 0.85, 0.88)  # shares of the film: turns away, is away, returns, is back
_AWAY_DEG = 75.0
FLAGS = (
    "--use-fake-ui-for-media-stream",
    "--use-fake-device-for-media-stream",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-rasterization",  # what software renders is copied back and forth less often without it
    "--disable-gpu-memory-buffer-video-frames",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)


def object_film() -> NumberedFilm:
    """The poses of the film; its frames are rendered when they are asked for."""
    mesh = textured_object(NAME, SEED)
    rng = np.random.default_rng((SEED, 7))
    scene, camera = elsewhere(rng, mesh), phone_camera(WIDTH, HEIGHT, 0.02)
    share = np.arange(FRAMES) / FRAMES
    circle = 2 * np.pi * share
    azimuths = 0.6 + 0.35 * np.sin(circle) + np.radians(0.8) * np.sin(9 * circle)
    elevations = np.radians(32 + 8 * np.sin(2 * circle) + 0.5 * np.sin(11 * circle))
    places = eyes(azimuths, elevations, 1.3 * viewing_distance(mesh) * (1 + 0.1 * np.sin(3 * circle)))
    away = np.interp(share, _AWAY, (0.0, 1.0, 1.0, 0.0), left=0.0, right=0.0)
    turns = np.radians(_AWAY_DEG) * away * away * (3 - 2 * away)
    poses = [turned(turn) * look_at(eye, np.zeros(3)) for eye, turn in zip(places, turns, strict=True)]

    frames = (with_noise(render(scene, camera, pose), (SEED, index)) for index, pose in enumerate(poses))
    corners = np.asarray(mesh.vertices, dtype=np.float64)
    return NumberedFilm(frames=frames, camera=camera, cam_from_world=poses, corners=corners)


def turned(radians: float) -> pycolmap.Rigid3d:
    """A turn to the left."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, radians, 0.0])), np.zeros(3))


def object_map(folder: Path) -> Path:
    """The map of the object, from frames of its mapping take with known poses; made if it is missing."""
    path = folder / "map"
    if not path.exists():
        takes = SynthesisOptions(objects=(NAME,), mapping_frames=36, query_frames=2)
        synthesize(folder / "objects", takes, overwrite=True)
        with tempfile.TemporaryDirectory() as workspace:
            full = map_object(read_object(folder / "objects" / NAME), Path(workspace))
            write_map(reduce(full).map, path)
    return path


@contextmanager
def serving(path: Path) -> Iterator[str]:
    """The address of a server of a map."""
    command = [sys.executable, "-m", "slimsfm", "serve", str(path), "--port", "0"]
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=one_thread)
    try:
        assert server.stdout
        lines = iter(server.stdout.readline, "")
        yield next(word for line in lines for word in line.split() if word.startswith("http"))
    finally:
        server.terminate()
        server.wait(20)


def pictures(page: Page, film: NumberedFilm, seconds: float) -> Iterator[tuple[np.ndarray, str]]:
    """What is shown of the film, and the page's state; decoded at the end, which takes time of the cores."""
    end, taken = monotonic() + seconds, []
    while monotonic() < end:
        taken.append(shown_as_png(page))
        sleep(0.05)
    for data, state in taken:
        yield picture_in(decoded(data), film.camera), state


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--address", help="of a server that serves OUTPUT/map already")
    parser.add_argument("--seconds", type=float, default=25.0, help="of measuring")
    parser.add_argument("--fps", type=int, default=30, help="of the film; fewer make a slower film")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    film, path, file = object_film(), object_map(options.output), options.output / f"film-{options.fps}.y4m"
    if not file.exists():
        film.write(file, options.fps)
    if options.address:
        measure(options.address, film, file, options)
    else:
        with serving(path) as address:
            measure(address, film, file, options)


def measure(address: str, film: NumberedFilm, file: Path, options: argparse.Namespace) -> None:
    """Open the page, look at it, print what was seen."""
    flags = (*FLAGS, f"--use-file-for-fake-video-capture={file}")
    with tempfile.TemporaryDirectory() as profile, open_page("about:blank", Path(profile), flags) as page:
        page.prepare(KEEP_PIXELS)
        page.open(address)
        page.resize(400, 460)
        page.wait_for("document.body.dataset.state === 'idle'")
        page.run("document.getElementById('show-model').click()")
        page.click("#start")
        page.wait_for("document.body.dataset.state === 'found'", 60)
        page.send("Network.disable")  # it would report each frame that is sent, which takes time of the cores
        page.run(RECORD)
        overlaps = list(measured(film, page, options))
        record = page.run("record")
        later = page.run("performance.getEntriesByType('resource').map((one) => one.name)")
        hosts = {one.split("/")[2] for one in (*page.requests(), *later) if one.startswith(("http", "ws"))}
        figures = page.run(
            "document.getElementById('figures').textContent + ', ' + document.getElementById('figures').title"
        )
        report(overlaps, returns(film, record), figures, hosts, page.complaints())


def measured(film: NumberedFilm, page: Page, options: argparse.Namespace) -> Iterator[float]:
    """Overlaps of the pictures in which the whole object is to be seen and the page says that it found it."""
    extremes: dict[str, float] = {}
    for picture, state in pictures(page, film, options.seconds):
        found = overlap(film, picture) if state == "found" else None
        if found is None or film.visible_share(found[0]) < 0.999:
            continue
        for name, better in (("worst", min), ("best", max)):
            if better(found[1], extremes.get(name, found[1])) == found[1]:
                extremes[name] = found[1]
                PilImage.fromarray(picture).save(options.output / f"{name}.png")
        yield found[1]


def report(
    overlaps: list[float], back: list[Return], figures: str, hosts: set[str], complaints: list[str]
) -> None:
    """Print the table."""
    seconds, lost = [one.seconds for one in back], sum(one.was_lost for one in back)
    print("| what | figure |\n|---|---|")
    print(f"| pictures | {len(overlaps)} |")
    if overlaps:
        tenth = np.quantile(overlaps, 0.1)
        print(f"| overlap: mean, 10th percentile | {np.mean(overlaps):.3f}, {tenth:.3f} |")
    print(f"| returns into sight; said to be lost before | {len(back)}; {lost} |")
    if seconds:
        print(f"| found again: median, longest | {np.median(seconds):.2f} s, {max(seconds):.2f} s |")
    print(f"| capture to pose, rate | {figures} |")
    print(f"| hosts | {', '.join(sorted(hosts))} |")
    print(f"| complaints of the browser | {len(complaints)} {'; '.join(complaints)[:300]} |")


if __name__ == "__main__":
    main()
