"""Rendered objects, mapped by day and sought in hard light: what learned features give, and what they cost.

    python benchmarks/hard_light.py -o OUT --methods sift xfeat aliked --weights WEIGHTS

Objects are mapped as `slimsfm synthesize` renders them. Each pose of its query video is rendered once per
condition of `CONDITIONS`. Light is computed linearly: lamp and ambient light on matte surfaces with cast
shadows, photons counted with their noise, then one gamma curve to 8 bits. Cameras and poses are exact.

Everything is kept in the output folder and reused; after a change of conditions, remove OUT/queries. Writes
table.md and contact.jpg there, and prints the table.
"""

import argparse
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import trimesh
from jaxtyping import Float64
from PIL import Image as PilImage
from trimesh.visual import TextureVisuals
from trimesh.visual.material import SimpleMaterial

from slimsfm.arrays import Image, Points3D
from slimsfm.cli.output import quiet
from slimsfm.datasets.base import LoadOptions, map_object
from slimsfm.datasets.synthetic import Synthetic
from slimsfm.evaluation.results import Outcomes, PosedQuery, evaluate, prepare_queries
from slimsfm.mapping import Map, read_map, write_map
from slimsfm.mapping.build import BuildOptions
from slimsfm.progress import shown
from slimsfm.reduction import reduce
from slimsfm.synthetic.objects import OBJECTS
from slimsfm.synthetic.render import Light, Rgb, Scene, pixel_centers, render
from slimsfm.synthetic.scene import Take, query_take, surrounded, textured_object
from slimsfm.weights import Runtime, use_runtime

SEED, WIDTH, HEIGHT = 0, 640, 480
GAMMA, READ_NOISE = 2.2, 2.0  # read noise in electrons
SLATS, PENUMBRA_PX = 0.02, 1.0  # period of the slats in meters
OFF_SURFACE = 5e-4  # meters from a surface to the start of its ray to the lamp
STRATEGIES = {"full": "progressive", "default": "direct"}
BACKDROP, DARK, BRIGHT = (52.0, 60.0, 74.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)

Radiance = Float64[np.ndarray, "height width 3"]
Shade = Float64[np.ndarray, "height width"]


@dataclass(frozen=True, kw_only=True)
class Condition:
    """A light, and how a camera exposes. Light of 1 makes a white surface white by day."""

    towards: Rgb = Light.towards
    """Direction to the lamp; by default that of the mapping video."""

    lamp: Rgb = (0.55, 0.55, 0.55)
    ambient: Rgb = (0.45, 0.45, 0.45)
    slats: bool = False
    """Whether the lamp shines through crossed slats."""

    electrons: float = 8000.0
    """Electrons that a pixel collects at light 1."""

    brightness: float = 1.0
    """Linear value of light 1 in the picture; values above 1 are clipped."""

    blur_px: int = 0
    """Length of the path of an image point while the shutter is open, in pixels."""

    lifted: bool = False
    """Whether the 8 bits are then stretched, so that 99 % of all values fill the range."""


UNDEREXPOSED = Condition(electrons=30.0, brightness=1 / 270)
CONDITIONS = {
    "day": Condition(),
    "shadows": Condition(
        towards=(-1.0, 0.6, 0.45), lamp=(1.5, 1.4, 1.2), ambient=(0.07, 0.09, 0.12), slats=True
    ),
    "night": Condition(
        towards=(-0.8, 0.6, 0.5),
        lamp=(1.0, 0.5, 0.15),
        ambient=(0.03, 0.04, 0.08),
        electrons=25.0,
        brightness=0.15,
    ),
    "over": Condition(electrons=160000.0, brightness=20.0),
    "under": UNDEREXPOSED,
    "blur": Condition(blur_px=13),
    "noise": Condition(electrons=5.0),
    "lifted": replace(UNDEREXPOSED, lifted=True),
}
"""The conditions by name."""


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--objects", nargs="+", default=["ball", "boulder", "printed_box"], choices=OBJECTS)
    parser.add_argument("--methods", nargs="+", default=["sift", "xfeat"], help="names of extractors")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--queries", type=int, default=14, help="per object and condition")
    arguments = parser.parse_args()
    use_runtime(Runtime(weights=arguments.weights, device="cpu"))
    queries = {name: rendered(name, arguments.queries, arguments.output) for name in arguments.objects}
    contact_sheet(queries.values(), arguments.output / "contact.jpg")
    lines = [HEAD]
    print(HEAD)
    for name, method in product(queries, arguments.methods):
        for line in rows(name, method, queries[name], arguments.output):
            lines.append(line)
            print(line, flush=True)
    (arguments.output / "table.md").write_text("\n".join(lines) + "\n")


Queries = dict[str, list[PosedQuery]]


def rendered(name: str, frames: int, output: Path) -> Queries:
    """The queries of an object under each condition; pictures are stored and reused."""
    folder = output / "queries" / f"{name}-{frames}"
    folder.mkdir(parents=True, exist_ok=True)
    take = query_take(name, frames, WIDTH, HEIGHT, SEED)
    paths = {key: [folder / f"{key}-{frame:02}.png" for frame in range(frames)] for key in CONDITIONS}
    studio = Studio(name, take)
    for frame in shown(range(frames), f"rendering {name}"):
        for number, (key, condition) in enumerate(CONDITIONS.items()):
            if not paths[key][frame].exists():
                rng = np.random.default_rng((*take.seed, frame, number))
                image = exposed(studio.radiance(condition, frame), condition, rng)
                PilImage.fromarray(image).save(paths[key][frame])
    return {
        key: [
            PosedQuery(path=path, camera=take.camera, cam_from_world=pose)
            for path, pose in zip(paths[key], take.cam_from_object, strict=True)
        ]
        for key in CONDITIONS
    }


class Studio:
    """A query scene whose lamp can be moved: the renderer gives the surfaces, this adds light and shadows."""

    def __init__(self, name: str, take: Take) -> None:
        meshes = surrounded(np.random.default_rng(take.seed), textured_object(name, SEED))
        self._white = [white(mesh) for mesh in meshes]
        self._take = take
        self._colors = Scene(meshes, Light(lamp=DARK, ambient=BRIGHT, backdrop=BACKDROP))
        self._lit: dict[Rgb, Scene] = {}

    def radiance(self, condition: Condition, frame: int) -> Radiance:
        """Light from what each pixel of a frame sees."""
        camera, pose = self._take.camera, self._take.cam_from_object[frame]
        towards = condition.towards
        if towards not in self._lit:
            light = Light(towards=towards, lamp=BRIGHT, ambient=DARK, backdrop=DARK)
            self._lit[towards] = Scene(self._white, light)
        albedo = (render(self._colors, camera, pose) / 255.0) ** GAMMA
        cosine = render(self._lit[towards], camera, pose)[..., 0] / 255.0
        lamp = cosine * self._reached(condition, camera, pose)
        return albedo * (lamp[..., None] * condition.lamp + condition.ambient)

    def _reached(self, condition: Condition, camera: pycolmap.Camera, pose: pycolmap.Rigid3d) -> Shade:
        """Share of the lamp that reaches what each pixel sees: less than 1 in cast shadows."""
        rays, eye = world_rays(camera, pose)
        faces = self._colors.intersector.intersects_first(np.broadcast_to(eye, rays.shape), rays)
        seen = np.flatnonzero(faces >= 0)
        normals = self._colors.face_normals[faces[seen]]
        corners = self._colors.vertices[self._colors.faces[faces[seen], 0]]
        depths = np.sum(normals * (corners - eye), axis=1) / np.sum(normals * rays[seen], axis=1)
        starts = eye + depths[:, None] * rays[seen] + OFF_SURFACE * normals
        towards = np.array(condition.towards) / np.linalg.norm(condition.towards)
        reached = np.ones(len(rays))
        reached[seen] = ~self._colors.intersector.intersects_any(
            starts, np.broadcast_to(towards, starts.shape).copy()
        )
        if condition.slats:
            reached[seen] *= between_slats(starts, towards)
        return np.asarray(cv2.GaussianBlur(reached.reshape(camera.height, -1), (0, 0), PENUMBRA_PX))


def white(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface, white."""
    made = mesh.copy()
    paper = SimpleMaterial(image=PilImage.new("RGB", (2, 2), "white"))
    made.visual = TextureVisuals(uv=np.full((len(mesh.vertices), 2), 0.5), material=paper)
    return made


def world_rays(camera: pycolmap.Camera, pose: pycolmap.Rigid3d) -> tuple[Points3D, Float64[np.ndarray, "3"]]:
    """Directions of the rays of all pixels, row by row, and their common origin."""
    directions = np.asarray(camera.cam_from_img(pixel_centers(camera)))
    rays = np.column_stack([directions, np.ones(len(directions))])
    world_from_cam = pose.inverse()
    return rays @ world_from_cam.rotation.matrix().T, world_from_cam.translation


def between_slats(points: Points3D, towards: Float64[np.ndarray, "3"]) -> np.ndarray:
    """Whether light from this direction passes between crossed slats of unequal width."""
    right = np.cross(towards, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    across = (points @ right / SLATS + 0.3) % 1
    along = (points @ np.cross(right, towards) / (1.7 * SLATS)) % 1
    return (across < 0.55) & (along < 0.8)


def exposed(radiance: Radiance, condition: Condition, rng: np.random.Generator) -> Image:
    """What a camera makes of it: blur, photon and read noise, brightness, clipping, gamma, 8 bits."""
    if condition.blur_px:
        blurred = cv2.filter2D(radiance, -1, streak(condition.blur_px, rng.uniform(0, np.pi)))
        radiance = np.maximum(blurred, 0)  # large kernels are applied by a DFT, which rounds
    electrons = rng.poisson(condition.electrons * radiance) + rng.normal(0, READ_NOISE, radiance.shape)
    linear = np.clip(electrons / condition.electrons * condition.brightness, 0, 1)
    image = np.rint(255 * linear ** (1 / GAMMA))
    if condition.lifted:
        image = np.clip(np.rint(image * (255 / np.percentile(image, 99))), 0, 255)
    return image.astype(np.uint8)


def streak(length: int, angle: float) -> np.ndarray:
    """Kernel of a straight motion, symmetric so that the pose is that of the middle of the exposure."""
    center = length // 2
    kernel = np.zeros((length, length))
    end = 0.5 * (length - 1) * np.array([np.cos(angle), np.sin(angle)])
    for x, y in np.linspace(center - end, center + end, 8 * length):
        kernel[round(y), round(x)] += 1
    return kernel / kernel.sum()


def contact_sheet(queries: Iterable[Queries], path: Path) -> None:
    """One picture per object and condition, at a third of its size."""
    rows = []
    for of_object in queries:
        pictures = [PilImage.open(chosen[3 * len(chosen) // 8].path) for chosen in of_object.values()]
        rows.append(np.hstack([np.asarray(one.reduce(3)) for one in pictures]))
    PilImage.fromarray(np.vstack(rows)).save(path, quality=80)


HEAD = (
    "| object | method | map | condition | within 0.1 d | within 0.02 d | median error | wrong "
    "| extract | match + pose |\n|---|---|---|---|---:|---:|---:|---:|---:|---:|"
)


def rows(name: str, method: str, queries: Queries, output: Path) -> Iterator[str]:
    """Rows of the table of one object and method, per map and condition."""
    maps = mapped(name, method, output)
    prepared = {condition: prepare_queries(maps["full"], chosen) for condition, chosen in queries.items()}
    for kind, strategy in STRATEGIES.items():
        for condition, chosen in prepared.items():
            found = evaluate(maps[kind], chosen, strategy)
            yield f"| {name} | {method} | {kind} | {condition} | {measures(found)} |"


def measures(found: Outcomes) -> str:
    """The values of a row. Wrong are poses that are given with an error above 0.1 d."""
    wrong = np.isfinite(found.error) & (found.error >= 0.1)
    shares = [f"{100 * np.mean(one):.0f} %" for one in (found.error < 0.1, found.error < 0.02, wrong)]
    median = np.median(found.error)
    error = f"{median:.4f} d" if np.isfinite(median) else "none"
    extract, *others = np.median(found.seconds * 1000, axis=0)
    return f"{shares[0]} | {shares[1]} | {error} | {shares[2]} | {extract:.0f} ms | {sum(others):.1f} ms"


def mapped(name: str, method: str, output: Path) -> dict[str, Map]:
    """The full map of an object and what `reduce` makes of it; existing ones are read."""
    made = Synthetic(path=output / "objects").load(name, LoadOptions(folder=output, progress=shown))
    full, slim = (output / "maps" / f"{name}-{method}{suffix}" for suffix in ("", "-slim"))
    full.parent.mkdir(exist_ok=True)
    with quiet(), tempfile.TemporaryDirectory() as workspace:
        if not full.exists():
            options = BuildOptions(extractor=method)
            write_map(map_object(made, Path(workspace), options, progress=shown), full)
        if not slim.exists():
            write_map(reduce(read_map(full), progress=shown).map, slim)
    return {"full": read_map(full), "default": read_map(slim)}


if __name__ == "__main__":
    main()
