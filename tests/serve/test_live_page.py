"""The page in a headless Chromium whose camera is a film: a poster, out of sight for a while."""

import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import trimesh
from PIL import Image

pytest.importorskip("websocket", reason="browsing needs websocket-client: pip install websocket-client")

from browser import Page, open_page
from page_film import (
    KEEP_PIXELS,
    RECORD,
    NumberedFilm,
    Return,
    decoded,
    overlap,
    picture_in,
    returns,
    shown,
    with_number,
)
from page_overlap import FLAGS
from poster import poster_camera, poster_map, poster_photo, poster_pose
from serving import served
from slimsfm.execution import num_cores
from slimsfm.geometry import project
from slimsfm.tracking.video import write_video

FRAMES, FRAMES_PER_SECOND, AWAY = 40, 10, range(24, 36)
SOON_S = 0.5
STATE = "document.body.dataset.state"


def pose(index: int) -> pycolmap.Rigid3d:
    """Back and forth in front of the poster, and far to its side for a while."""
    angle = 2 * np.pi * index / FRAMES
    turn = np.array([0.0, np.radians(60) if index in AWAY else 0.0, 0.0])
    away = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.zeros(3))
    return away * poster_pose((0.9 + 0.2 * np.sin(angle), -0.4 + 0.1 * np.cos(angle), -3.6))


@pytest.fixture(scope="module")
def film() -> NumberedFilm:
    poses = [pose(index) for index in range(FRAMES)]
    corners = poster_map().box.corners
    frames = [poster_photo(one) for one in poses]
    return NumberedFilm(frames=frames, camera=poster_camera(), cam_from_world=poses, corners=corners)


@dataclass
class Opened:
    page: Page
    url: str
    folder: Path

    def restart(self) -> None:
        self.page.open(self.url)
        self.page.wait_for(f"{STATE} === 'idle'")


@pytest.fixture(scope="module")
def opened(server, film, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    film.write(folder / "film.y4m", FRAMES_PER_SECOND)
    flags = (*FLAGS, f"--use-file-for-fake-video-capture={folder / 'film.y4m'}")
    with open_page("about:blank", folder / "profile", flags) as page:
        page.prepare(KEEP_PIXELS)
        page.resize(360, 420)
        page.open(server.url)
        page.wait_for(f"{STATE} === 'idle'")
        yield Opened(page, server.url, folder)


@dataclass
class Watched:
    """What the page showed of the film."""

    overlaps: list[float]
    """Of pictures in which the page says that it found the object."""

    lost: list[float]
    """Of pictures in which it says that it lost it."""

    back: list[Return]


@pytest.fixture(scope="module")
def watched(opened, film):
    """Watches until all has happened, or for 20 s: a busy machine answers late."""
    page, found, end = opened.page, Watched([], [], []), time.monotonic() + 20
    page.click("#start")
    page.wait_for(f"{STATE} === 'found'", 60)
    page.run(RECORD)
    while time.monotonic() < end and not (len(found.overlaps) >= 5 and found.lost and is_back(found)):
        canvas, state = shown(page)
        measured = overlap(film, picture_in(canvas, film.camera))
        if measured and state in ("found", "lost"):
            (found.overlaps if state == "found" else found.lost).append(measured[1])
        found.back = returns(film, page.run("record"))
        time.sleep(0.1)
    return found


def is_back(watched: Watched) -> bool:
    return any(one.was_lost and one.seconds < SOON_S for one in watched.back)


def test_the_box_is_drawn_over_the_object(watched):
    assert len(watched.overlaps) >= 5
    assert np.mean(watched.overlaps) >= 0.85


def test_the_object_is_lost_out_of_sight_and_found_again(watched):
    if not is_back(watched) and os.getloadavg()[0] > 1.5 * num_cores():
        pytest.skip("this machine is too busy with other things to measure times")
    assert is_back(watched)


def test_nothing_is_drawn_where_the_object_is_lost(watched):
    assert set(watched.lost) == {0.0}


@pytest.mark.usefixtures("watched")
def test_the_focal_length_of_the_device_is_kept(opened):
    opened.page.wait_for("localStorage.length > 0", 60)
    ((key, value),) = json.loads(opened.page.run("JSON.stringify(Object.entries(localStorage))"))
    assert "320x240" in key
    assert float(value) == pytest.approx(poster_camera().focal_length_x, rel=0.05)


@pytest.mark.usefixtures("watched")
def test_other_hosts_are_not_asked_and_the_console_is_empty(opened):
    assert opened.page.complaints() == []
    hosts = {address.split("/")[2] for address in opened.page.requests() if not address.startswith("blob:")}
    assert hosts == {opened.url.split("/")[2]}


@pytest.mark.usefixtures("watched")
def test_the_camera_stops_while_the_page_is_hidden(opened):
    page = opened.page
    hide = (
        "Object.defineProperty(document, 'hidden', {{ value: {}, configurable: true }});"
        "document.dispatchEvent(new Event('visibilitychange'))"
    )
    page.run("window.tracks = document.getElementById('video').srcObject.getTracks(); 0")
    page.run(hide.format("true"))
    assert page.run("tracks.map((track) => track.readyState)") == ["ended"]
    page.run(hide.format("false"))
    page.wait_for(f"{STATE} === 'found'")


def test_the_film_of_the_server_is_played_and_its_model_drawn(opened, film, poster):
    pytest.importorskip("av", reason="writing videos needs PyAV: pip install 'slimsfm[video]'")
    folder = opened.folder
    cube = trimesh.creation.box((1, 1, 1))
    cube.visual.vertex_colors = [255, 0, 255, 255]
    cube.export(folder / "cube.ply")
    with write_video(folder / "film.webm", float(FRAMES_PER_SECOND)) as write:
        for frame in film.frames[: AWAY.start]:
            write(frame)
    with served(poster, model=folder / "cube.ply", film=folder / "film.webm") as other:
        opened.page.open(f"{other.url}?film")
        opened.page.wait_for(f"{STATE} === 'found'", 60)
        opened.page.wait_for(f"({MAGENTA_SHARE})() > 0.01", 60)
        assert opened.page.complaints() == []


MAGENTA_SHARE = """() => {
  const [view, copy] = [document.getElementById("view"), document.createElement("canvas")];
  [copy.width, copy.height] = [90, 90];
  const context = copy.getContext("2d");
  context.drawImage(view, 0, 0, 90, 90);
  const { data } = context.getImageData(0, 0, 90, 90);
  let count = 0;
  for (let i = 0; i < data.length; i += 4) count += data[i] > 90 && data[i + 1] < 30 && data[i + 2] > 90;
  return count / 8100;
}"""


def choose(page: Page, path: Path) -> None:
    root = page.send("DOM.getDocument")["root"]["nodeId"]
    node = page.send("DOM.querySelector", nodeId=root, selector="#file")["nodeId"]
    page.send("DOM.setFileInputFiles", nodeId=node, files=[str(path)])


def test_a_photo_is_localized(opened, film):
    opened.restart()
    Image.fromarray(film.frames[20]).save(opened.folder / "photo.png")
    choose(opened.page, opened.folder / "photo.png")
    opened.page.wait_for(f"{STATE} === 'found'")
    drawn = picture_in(shown(opened.page)[0], film.camera)
    assert opened.page.run("document.getElementById('title').textContent").startswith("poster")
    assert overlap(film, with_number(drawn, 20))[1] > 0.85


def test_what_is_no_picture_is_named(opened):
    opened.restart()
    (opened.folder / "note.txt").write_text("no picture")
    choose(opened.page, opened.folder / "note.txt")
    opened.page.wait_for(f"{STATE} === 'failed'")
    assert "note.txt" in opened.page.run("document.getElementById('hint').textContent")


SIZES = [(320, 568), (568, 320), (390, 844), (844, 390), (768, 1024), (1280, 720), (1920, 1080)]
LAYOUT = """(() => {
  const seen = [...document.querySelectorAll("button, select, .button, .toggle, .state, .hint:not(:empty)")]
    .filter((one) => one.offsetParent).map((one) => one.getBoundingClientRect());
  const canvas = document.getElementById("view").getBoundingClientRect();
  const buttons = [...document.querySelectorAll("button:not([hidden]), .button, .toggle")];
  const isOutside = (r) => Math.min(r.left, r.top, innerWidth - r.right, innerHeight - r.bottom) < 0;
  return {
    outside: seen.filter(isOutside).length,
    wide: document.documentElement.scrollWidth > innerWidth,
    share: (canvas.width * canvas.height) / (innerWidth * innerHeight),
    lowest: Math.min(...buttons.map((one) => one.offsetHeight)),
  };
})()"""


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_everything_fits_into_windows_of_any_size(opened, size):
    opened.page.resize(*size)
    found = opened.page.run(LAYOUT)
    assert (found["outside"], found["wide"]) == (0, False)
    assert found["share"] > 0.5
    assert found["lowest"] >= 44


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_is_readable_in_both_schemes(opened, scheme):
    opened.page.prefer(scheme)
    contrasts = opened.page.run(
        """(() => {
          const channel = (c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
          const light = (css) => css.match(/[\\d.]+/g).slice(0, 3).map((c) => channel(c / 255))
            .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
          return ["#start", ".button", ".toggle", "#title"].map((selector) => {
            const one = document.querySelector(selector);
            const ground = one.closest(".state") ?? one;
            const a = light(getComputedStyle(one).color);
            const b = light(getComputedStyle(ground).backgroundColor);
            return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
          });
        })()"""
    )
    assert min(contrasts) >= 4.5


def test_controls_have_names_and_are_reached_by_keys(opened):
    page = opened.page
    opened.restart()
    page.send("Accessibility.enable")
    nodes = page.send("Accessibility.getFullAXTree")["nodes"]
    roles = ("button", "combobox", "checkbox", "image", "main", "navigation")
    names = {
        (node["role"]["value"], node["name"].get("value"))
        for node in nodes
        if not node["ignored"] and node["role"]["value"] in roles
    }
    assert all(name for _, name in names)
    assert {"Start camera", "Box", "Points", "Model"} <= {name for _, name in names}
    focused = []
    for _ in range(6):
        page.send("Input.dispatchKeyEvent", type="keyDown", key="Tab", code="Tab", windowsVirtualKeyCode=9)
        focused.append(page.run("document.activeElement.id"))
    assert {"start", "file", "show-box", "show-points", "show-model"} <= set(focused)


PAINT_POINTS = """async ({ points, tints, lens, place }) => {
  const { Painter } = await import("/page/painter.js");
  const { cameraFrom } = await import("/page/cameras.js");
  const { poseFrom } = await import("/page/pose.js");
  const canvas = Object.assign(document.createElement("canvas"), { width: 640, height: 480 });
  const painter = new Painter(canvas);
  painter.show(new ImageData(4, 3), { x: 0, y: 0, width: 640, height: 480 });
  const from = { data: new Float32Array(points), size: 3 };
  const tint = { data: new Float32Array(tints), size: 3 };
  const shape = painter.shape({ from, tint }, points.length / 3);
  const eye = { pose: poseFrom(place), camera: cameraFrom(lens), near: 0.1, far: 20 };
  painter.drawPoints(shape, eye, { width: 9 });
  return canvas.toDataURL();
}"""


def test_the_painter_projects_as_the_library_does(opened):
    """Points through a lens with strong distortion, one color each."""
    camera = pycolmap.Camera(
        model="OPENCV", width=640, height=480, params=[500, 505, 322, 238, -0.2, 0.05, 0.004, -0.003]
    )
    cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, -0.2, 0.3])), np.array([0.1, 0, 3]))
    steps = np.linspace(-1, 1, 4)
    points = np.stack(np.meshgrid(steps, 0.8 * steps, [0.2]), axis=-1).reshape(-1, 3)
    colors = np.array([[255, 255 - 10 * index, 10 * index] for index in range(len(points))])
    values = {
        "points": points.ravel().tolist(),
        "tints": (colors / 255).ravel().tolist(),
        "lens": {"model": "OPENCV", "width": 640, "height": 480, "fx": 500, "fy": 505, "cx": 322, "cy": 238}
        | {"params": camera.params.tolist()},
        "place": {
            "quaternion_xyzw": cam_from_world.rotation.quat.tolist(),
            "translation": cam_from_world.translation.tolist(),
        },
    }
    drawn = decoded(opened.page.run(f"({PAINT_POINTS})({json.dumps(values)})"))
    for color, expected in zip(colors, project(points, cam_from_world, camera), strict=True):
        y, x = np.nonzero(np.abs(drawn.astype(int) - color).max(axis=2) <= 4)
        assert len(x) > 10
        np.testing.assert_allclose([x.mean() + 0.5, y.mean() + 0.5], expected, atol=0.6)
