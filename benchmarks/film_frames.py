"""The film for tracking that benchmarks share: rendered once, stored in the output folder.

    python benchmarks/film_frames.py -o /tmp/film

Writes OUTPUT/color_full/0.png ..., OUTPUT/poses_ba/0.txt ... and intrinsics.txt as in OnePose, and
OUTPUT/film.npz: visible (unoccluded share of the object per frame), cut (first frame after it) and occlusion
(first frame with the object completely hidden, and first frame with the object visible again).
"""

import argparse
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from PIL import Image as PilImage

from deceptive_scenes import run_all
from film import Film, film
from slimsfm.datasets import onepose
from slimsfm.datasets.base import PosedSequence
from slimsfm.files import replacing

NAME, FRAMES, WIDTH, HEIGHT, SEED = "printed_box", 600, 640, 480, 0


@dataclass(frozen=True, eq=False, kw_only=True)
class FilmFrames:
    """The frames of the film as files, with their ground truth."""

    sequence: PosedSequence
    """Image files, camera and true poses, in the frame of the object."""

    visible: Float64[np.ndarray, " frames"]
    """Unoccluded share of the object."""

    cut: int
    """The first frame after the cut."""

    occlusion: range
    """The frames in which the object is completely hidden."""


def film_frames(output: Path, *, workers: int = 2) -> FilmFrames:
    """The film; rendered unless the output folder exists."""
    if not output.exists():
        with replacing(output, overwrite=False) as partial:
            render_film(partial, workers)
    with np.load(output / "film.npz") as known:
        return FilmFrames(
            sequence=onepose.read_sequence(output),
            visible=known["visible"],
            cut=int(known["cut"]),
            occlusion=range(*known["occlusion"].tolist()),
        )


def render_film(folder: Path, workers: int) -> None:
    """Render every frame and write the ground truth."""
    made = the_film()
    onepose.write_annotation(folder, made.camera, made.cam_from_object)
    ends = (made.occlusion.start, made.occlusion.stop)
    np.savez(folder / "film.npz", visible=made.visible, cut=made.cut, occlusion=ends)
    run_all(
        write_frame,
        [(index, onepose.image_path(folder, index)) for index in range(FRAMES)],
        "rendering the film",
        workers,
    )


@lru_cache(maxsize=1)
def the_film() -> Film:
    """The film, made once per process."""
    return film(NAME, FRAMES, WIDTH, HEIGHT, SEED)


def write_frame(job: tuple[int, Path]) -> None:
    """Render one frame to its file."""
    index, path = job
    PilImage.fromarray(the_film().frame(index)).save(path, compress_level=1)


def main() -> None:
    """Render and print a summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    made = film_frames(parser.parse_args().output)
    print(
        f"{len(made.sequence.image_paths)} frames; hidden from {made.occlusion.start} "
        f"to {made.occlusion.stop - 1}; cut before {made.cut}"
    )


if __name__ == "__main__":
    main()
