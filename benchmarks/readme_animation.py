"""The moving picture of the README: an object tracked on the small map that `slimsfm reduce` makes of it.

    python benchmarks/readme_animation.py -o docs/images/tracked.webp --scenes SCENES

Everything is rendered, so anyone can make the picture again. SCENES keeps the object and its two maps.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

from PIL import Image as PilImage
from PIL import ImageDraw, ImageFont

from benchmark_scenes import rendered
from film import FRAMES_PER_SECOND, Film, film
from slimsfm.arrays import Image
from slimsfm.files import replacing
from slimsfm.localization import Localizer
from slimsfm.mapping import read_map
from slimsfm.mapping.io import bytes_by_part
from slimsfm.progress import shown
from slimsfm.report.frames import draw_box
from slimsfm.tracking import Tracked, Tracker
from tracking import slim_map

NAME, FRAMES, FIRST, LAST = "printed_box", 600, 20, 200
STEP = 2  # frames between two that are shown; all are tracked
WIDTH = 480  # pixels of the picture
BOX_RGB, INK_RGB = (255, 196, 0), (255, 255, 255)


def main() -> None:
    """Track the film and write every second frame with the box drawn in."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path, help="the picture, a .webp file")
    parser.add_argument("--scenes", required=True, type=Path, help="folder for the object and its maps")
    arguments = parser.parse_args()
    pictures = list(frames(arguments.scenes))
    with replacing(arguments.output, overwrite=True) as partial, partial.open("wb") as file:
        milliseconds = round(1000 * STEP / FRAMES_PER_SECOND)
        options = {"quality": 55, "method": 6, "duration": milliseconds, "loop": 0}
        pictures[0].save(file, "webp", save_all=True, append_images=pictures[1:], **options)
    print(f"{arguments.output}: {len(pictures)} frames, {arguments.output.stat().st_size / 1e6:.2f} MB")


def frames(scenes: Path) -> Iterator[PilImage.Image]:
    """The frames to show, each with its box and a caption."""
    if not (scenes / f"{NAME}-map").exists():
        rendered(NAME, scenes)
    path = slim_map(scenes / f"{NAME}-map", scenes)
    small, bytes_ = read_map(path), bytes_by_part(path)["total"]
    made, tracker = film(NAME, FRAMES), Tracker(Localizer(small))
    for index in shown(range(FIRST, LAST), "track"):
        image = made.frame(index)
        tracked = tracker.track(image, made.camera)
        if index % STEP == 0:
            caption = f"{len(small.point3D_ids)} points, {bytes_ / 1000:.0f} kB"
            yield drawn(image, tracked, made, caption)


def drawn(image: Image, tracked: Tracked, made: Film, caption: str) -> PilImage.Image:
    """The frame, shrunk, with the box under the estimated pose and the size of the map."""
    image = image.copy()
    if tracked.pose:
        draw_box(image, made.box, tracked.pose.cam_from_world, made.camera, BOX_RGB, thickness=3)
    height = round(WIDTH * image.shape[0] / image.shape[1])
    small = PilImage.fromarray(image).resize((WIDTH, height), PilImage.Resampling.LANCZOS)
    font = ImageFont.load_default(size=18)
    ImageDraw.Draw(small).text((12, height - 30), caption, "white", font, stroke_width=2, stroke_fill="black")
    return small


if __name__ == "__main__":
    main()
