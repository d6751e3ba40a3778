"""How exact aligned maps are: by known positions, by a printed tag, and by noisy GPS.

    python benchmarks/alignment.py -o OUT --map OFFICE_MAP --transforms office/transforms.json

1. A map that `slimsfm build` made without poses is aligned by the first 20 positions of a device, in
   nerfstudio's layout. Its scale is compared with that by all positions.
2. An object on a table with a printed tag is rendered and mapped without poses, and aligned by the tag. Its
   scale is compared with that by the exact positions of the cameras.
3. The same map, enlarged to a building, is aligned by positions with normal errors of 5 m, many times. Its
   heading is compared with the exact one.

Prints a Markdown table. Rendered photos and their map are kept in the output folder.
"""

import argparse
from collections.abc import Mapping
from math import erf
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from PIL import Image as PilImage

from posed_scenes import read_transforms
from slimsfm.cli.output import quiet
from slimsfm.errors import InputError
from slimsfm.mapping import Map, build_map, read_map, write_map
from slimsfm.mapping.georeference import wgs84_of_enu
from slimsfm.progress import shown
from slimsfm.synthetic import shapes, texture
from slimsfm.synthetic.render import Light, Scene
from slimsfm.synthetic.scene import Take, mapping_take, textured_object
from slimsfm.upkeep.align import Positions, Tag, align
from slimsfm.upkeep.positions import KnownPositions

OBJECT, FRAMES, WIDTH, HEIGHT, SEED = "boulder", 30, 640, 480, 0
TAG, TAG_SIDE, MARGIN = 7, 0.12, 0.125  # number, side in meters, and margin over the side
ASIDE = (0.24, 0.0, 0.0)  # where the object stands, so that the tag is in the center
RADIUS, NOISE, DRAWS = 40.0, 5.0, 100  # meters, meters, repetitions
ORIGIN = np.array([55.7058, 13.1932, 50.0])
FIRST = 20

Truth = Mapping[str, np.ndarray]
"""Position of the camera by name of the image."""


def main() -> None:
    """Align and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--map", type=Path, help="map of photos with known poses, built without them")
    parser.add_argument("--transforms", type=Path, help="these poses, in nerfstudio's layout")
    arguments = parser.parse_args()
    print("| aligned by | what | error | bound (95 %) | residual |\n|---|---|---|---|---|", flush=True)
    if arguments.map:
        by_positions(read_map(arguments.map), positions_of(arguments.transforms))
    take = tagged_take()
    built = mapped(take, arguments.output)
    truth = {f"{k:03}.png": pose.inverse().translation for k, pose in enumerate(take.cam_from_object)}
    by_tag(built, truth, arguments.output / "photos")
    by_gps(built, truth)
    if arguments.map:
        print_camera(read_map(arguments.map), "the photos")
    print_camera(built, "the rendered photos")


def positions_of(transforms: Path) -> Truth:
    """Positions by the name of the file alone."""
    poses = read_transforms(transforms)[1]
    return {Path(name).name: pose.inverse().translation for name, pose in poses.items()}


def exact(map_: Map, truth: Truth) -> pycolmap.Sim3d:
    """The similarity to the true frame, by least squares over all cameras."""
    names = [name for name in map_.images if name in truth]
    centers = np.array([map_.images[name].projection_center() for name in names])
    found = pycolmap.estimate_sim3d(centers, np.array([truth[name] for name in names]))
    if found is None:
        raise InputError("the true positions do not determine a similarity")
    return found


def print_camera(map_: Map, what: str) -> None:
    """Print the focal length and the principal point of the first camera."""
    camera = map_.camera(next(iter(map_.images)))
    point = f"{camera.principal_point_x:.1f}, {camera.principal_point_y:.1f}"
    print(
        f"camera of {what}: focal length {camera.mean_focal_length():.1f}, principal point {point}",
        flush=True,
    )


def by_positions(map_: Map, truth: Truth) -> None:
    """Print how the scale by the first positions differs from that by all."""
    names = [name for name in map_.images if name in truth][:FIRST]
    found = align(map_, Positions(known=KnownPositions(by_name={name: truth[name] for name in names})))
    error = found.new_from_old.scale / exact(map_, truth).scale - 1
    what = f"scale of {len(map_.images)} photos"
    print(
        f"| {found.by} | {what} | {100 * error:+.2f} % | {100 * (found.scale_bound or 0):.2f} % "
        f"| {100 * (found.median_residual or 0):.1f} cm |",
        flush=True,
    )


def tagged_take() -> Take:
    """The take of an object as `slimsfm synthesize` renders it, with a tag on the table."""
    take = mapping_take(OBJECT, FRAMES, WIDTH, HEIGHT, SEED)
    mesh = textured_object(OBJECT, SEED)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    pixels = 800
    tag = cv2.aruco.generateImageMarker(dictionary, TAG, pixels)
    sheet = np.pad(tag, round(MARGIN * pixels), constant_values=255)
    rgb = np.repeat((sheet // 2 + 50)[..., None], 3, axis=2).astype(np.uint8)
    lying = shapes.ground(TAG_SIDE * (1 + 2 * MARGIN), rgb, shapes.lowest(mesh) + 1e-3)
    mesh.apply_translation(ASIDE)
    cloth = texture.page(np.random.default_rng(take.seed), 2000, 2000, cell=150) // 4 + 110
    table = shapes.ground(2.4, cloth, shapes.lowest(mesh))
    return Take(
        scene=Scene([mesh, table, lying], Light()),
        camera=take.camera,
        cam_from_object=take.cam_from_object,
        seed=take.seed,
    )


def mapped(take: Take, output: Path) -> Map:
    """Render the photos and build their map without poses; existing ones are reused."""
    photos, path = output / "photos", output / "map"
    photos.mkdir(parents=True, exist_ok=True)
    for index in shown(range(FRAMES), "render"):
        file = photos / f"{index:03}.png"
        if not file.exists():
            PilImage.fromarray(take.frame(index)).save(file)
    if not path.exists():
        with quiet():
            write_map(build_map(photos, progress=shown), path)
    return read_map(path)


def by_tag(map_: Map, truth: Truth, photos: Path) -> None:
    """Print how the scale by the tag differs from the exact one."""
    found = align(map_, Tag(images=photos, side=TAG_SIDE), progress=shown)
    error = found.new_from_old.scale / exact(map_, truth).scale - 1
    print(
        f"| {found.by}, in {found.inliers} of {len(map_.images)} photos | scale | {100 * error:+.3f} % "
        f"| {100 * (found.scale_bound or 0):.2f} % | {found.median_residual:.2f} px |",
        flush=True,
    )


def by_gps(map_: Map, truth: Truth) -> None:
    """Print how the heading by noisy positions differs from the exact one, over many draws."""
    names = [name for name in map_.images if name in truth]
    there = np.array([truth[name] for name in names])
    there *= RADIUS / np.linalg.norm(there[:, :2], axis=1).mean()
    straight = exact(map_, dict(zip(names, there, strict=True)))
    errors, bounds, residuals, refused = [], [], [], 0
    for seed in shown(range(DRAWS), "noisy GPS"):
        noisy = there + np.random.default_rng(seed).normal(size=there.shape) * NOISE
        places = dict(zip(names, wgs84_of_enu(noisy, ORIGIN), strict=True))
        try:
            found = align(map_, Positions(known=KnownPositions(by_name=places, is_geographic=True)))
        except InputError:
            refused += 1
            continue
        *_, z, w = (found.new_from_old.rotation * straight.rotation.inverse()).quat
        errors.append(abs(np.degrees(2 * np.arctan2(z, abs(w)))))
        bounds.append(found.heading_bound_deg)
        residuals.append(found.median_residual)
    least = np.degrees(NOISE / np.linalg.norm(there[:, :2] - there[:, :2].mean(axis=0)))
    print(
        f"| {len(names)} GPS positions with errors of {NOISE:g} m on a ring of {RADIUS:g} m, {DRAWS} draws "
        f"({refused} refused) | heading | median {np.median(errors):.2f}°, "
        f"{100 * np.mean(np.array(errors) < 2):.0f} % below 2°, largest {max(errors):.2f}° "
        f"(no estimate has a standard deviation below {least:.2f}°: median {0.674 * least:.2f}°, "
        f"{100 * erf(2 / least / np.sqrt(2)):.0f} % below 2°) "
        f"| {np.median(bounds):.1f}° | {np.median(residuals):.1f} m |"
    )


if __name__ == "__main__":
    main()
