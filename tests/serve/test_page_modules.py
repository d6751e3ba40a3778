"""The page's modules: their syntax, what they load, and their rules without a browser."""

import itertools
import json
import re
import shutil
import struct
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest

from javascript import PAGE, needs_a_runtime, run
from scenes import BOX, camera
from slimsfm.geometry import BOX_EDGES
from slimsfm.serve.messages import parse_frame, parse_hello
from slimsfm.synthetic.scene import look_at

MODULES = sorted(PAGE.glob("*.js"))


@pytest.fixture(autouse=True)
def runtime():
    needs_a_runtime()


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.name)
def test_syntax(path):
    if not shutil.which("node"):
        pytest.skip("needs node, which is not installed; Chromium runs these modules in other tests")
    command = ["node", "--check", "--input-type=module"]
    checked = subprocess.run(command, input=path.read_text(), capture_output=True, text=True)
    assert checked.returncode == 0, checked.stderr


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.name)
def test_files_are_small_and_import_each_other_alone(path):
    text = path.read_text()
    assert len(text.splitlines()) < 300
    for name in re.findall(r'(?:from|import)\s*\(?"([^"]+)"', text):
        assert name.startswith("./")
        assert (PAGE / name).is_file()
    assert not re.findall(r"https?://|innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(", text)


class Markup(HTMLParser):
    def __init__(self):
        super().__init__()
        self.tags = []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))


def test_the_markup_has_nothing_inline_and_loads_its_own_files_alone():
    markup = Markup()
    markup.feed((PAGE / "index.html").read_text())
    for tag, attributes in markup.tags:
        assert not [name for name in attributes if name.startswith("on") or name == "style"]
        assert tag != "style"
        assert tag != "script" or attributes.get("src")
        for address in (attributes.get("src"), attributes.get("href")):
            assert address is None or (PAGE / address.removeprefix("page/")).is_file()
    ids = [attributes["id"] for _, attributes in markup.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    used = {name for path in MODULES for name in re.findall(r'element\("([a-z-]+)"\)', path.read_text())}
    assert used <= set(ids)


def test_frames_and_hellos_are_read_by_the_server():
    found = run(
        """const m = await load("protocol.js");
        const message = m.frameMessage(7, 123.5, new Uint8Array([255, 216, 255, 9]).buffer);
        const camera = { fx: 400, fy: 400, cx: 160, cy: 120 };
        const hello = m.hello({ maps: ["a"], width: 320, height: 240, camera, token: "t" });
        const broken = ["{", "3", new ArrayBuffer(1)].map((data) => m.parsed(data));
        return { frame: [...message], hello, broken };"""
    )
    data = bytes(found["frame"])
    assert data == struct.pack("<BBHId", 1, 1, 0, 7, 123.5) + b"\xff\xd8\xff\x09"
    frame, hello = parse_frame(data), parse_hello(found["hello"])
    assert (frame.sequence, frame.captured, frame.orientation) == (7, 123.5, 1)
    assert (hello.maps, hello.width, hello.height, hello.token) == (("a",), 320, 240, "t")
    assert found["broken"] == [None, None, None]


def test_the_edges_are_those_of_the_library_and_hidden_ones_are_behind():
    eyes = np.array(list(itertools.product((-4.0, 4.0), (-3.0, 3.0), (-2.0, 2.0))))
    poses = [look_at(eye, np.zeros(3)) for eye in eyes]
    found = run(
        """const { edgePieces, hiddenEdges, centerOfBox } = await load("box.js");
        const { poseFrom } = await load("pose.js");
        const pieces = edgePieces(corners);
        const per = pieces.length / 12;
        const edge = (_, i) => [pieces[i * per][0], pieces[(i + 1) * per - 1][1]];
        const edges = Array.from({ length: 12 }, edge);
        const hidden = poses.map((pose) => hiddenEdges(corners, poseFrom(pose)));
        return { edges, hidden, center: centerOfBox(corners) };""",
        corners=BOX.corners,
        poses=[{"quaternion_xyzw": pose.rotation.quat, "translation": pose.translation} for pose in poses],
    )
    of_library = {tuple(np.round(BOX.corners[list(edge)].ravel(), 9)) for edge in BOX_EDGES}
    assert {tuple(np.round(np.ravel(edge), 9)) for edge in found["edges"]} == of_library
    np.testing.assert_allclose(found["center"], BOX.center, atol=1e-12)
    ends = np.array(found["edges"])
    for eye, hidden in zip(eyes, found["hidden"], strict=True):
        farthest = np.linalg.norm(BOX.corners - eye, axis=1).argmax()
        touches = np.all(np.isclose(ends, BOX.corners[farthest]), axis=2).any(axis=1)
        np.testing.assert_array_equal(hidden, touches)  # who sees three faces does not see three edges


def test_states_follow_the_answers():
    answers = [
        {"found": False},
        {"found": True, "confidence": 0.9},
        {"found": True, "confidence": 0.4},
        {"found": True, "confidence": None},
        {"found": False},
        {"found": False},
        {"found": True, "confidence": 0.9},
    ]
    states = run(
        """const { nextState } = await load("states.js");
        let state = "searching";
        return answers.map((answer) => (state = nextState(state, answer)));""",
        answers=answers,
    )
    assert states == ["searching", "found", "unsure", "found", "lost", "lost", "found"]


PLACES = {
    "": (0, 0, 2), "left": (-3, 0.5, 2), "right": (3, -0.5, 2), "up": (0.5, -3, 2), "down": (0, 3, 2),
    "around": (0.1, 0.1, -2),
}  # fmt: skip


@pytest.mark.parametrize("direction", PLACES)
def test_the_hint_says_where_to_turn(direction):
    one = camera("PINHOLE")
    words = run(
        """const m = await load("states.js");
        const pose = { rotation: [0, 0, 0, 1], translation: [0, 0, 0] };
        const direction = m.directionTo(pose, point, { ...lens, distortion: [0.1, 0, 0, 0] });
        return [direction, m.wordsFor("lost", { name: "fox", confidence: null, direction }).hint];""",
        point=PLACES[direction],
        lens={"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": one.principal_point_x, "cy": 240},
    )
    assert words[0] == direction
    assert direction in words[1].lower() or not direction


def test_what_is_shown_depends_on_the_gyroscope_and_the_age_of_the_pose():
    body = 'const { manner } = await load("live.js"); return asked.map(([has, age]) => manner(has, age))'
    asked = [(False, 80), (False, 2000), (True, 80), (True, 2000)]
    assert run(body, asked=asked) == ["held", "alone", "carried", "alone"]


STORAGE = """const kept = {};
const storage = { getItem: (key) => kept[key] ?? null, setItem: (key, value) => { kept[key] = value; } };
"""


def test_the_median_focal_length_is_kept_per_device_and_size():
    found = run(
        STORAGE
        + """const { FocalEstimates, KnownCameras } = await load("cameras.js");
        const known = new KnownCameras(storage);
        const estimates = new FocalEstimates();
        const camera = (focal) => ({ fx: focal, fy: focal });
        const answer = (focal, confidence = 0.9, found = true) =>
          ({ found, confidence, camera: camera(focal) });
        const medians = [
          answer(9000, 0.4), answer(9000, 0.9, false),
          ...[500, 502, 498, 700, 501, 499, 500].map((focal) => answer(focal)),
        ].map((one) => estimates.add(one));
        known.set("rear", 640, 480, medians.at(-1));
        return { medians, upright: known.get("rear", 480, 640), other: known.get("rear", 640, 360),
          front: known.get("front", 640, 480), none: new KnownCameras(null).get("rear", 640, 480) };"""
    )
    assert found["medians"] == [None] * 8 + [500]
    assert found["upright"] == {"fx": 500, "fy": 500, "cx": 240, "cy": 320}
    assert (found["other"], found["front"], found["none"]) == (None, None, None)


def test_storage_that_refuses_or_holds_nonsense_is_no_obstacle():
    found = run(
        """const { KnownCameras } = await load("cameras.js");
        const refuse = () => { throw new Error("denied"); };
        const refusing = new KnownCameras({ getItem: refuse, setItem: refuse });
        refusing.set("rear", 640, 480, 500);
        const nonsense = new KnownCameras({ getItem: () => "x-1", setItem: () => {} });
        return [refusing.get("rear", 640, 480), nonsense.get("rear", 640, 480)];"""
    )
    assert found == [None, None]


def test_the_token_leaves_the_address_and_stays_in_the_tab():
    found = run(
        STORAGE
        + """const { takeToken } = await load("api.js");
        const shown = [];
        const history = { replaceState: (state, title, address) => shown.push(address) };
        const at = (hash) => takeToken({ hash, pathname: "/", search: "?film" }, history, storage);
        return { tokens: [at("#token=a%2Bb"), at(""), at("#other=1")], shown };"""
    )
    assert found == {"tokens": ["a+b"] * 3, "shown": ["/?film"]}


def test_sizes_of_pictures_keep_their_shape():
    body = 'const { fitted } = await load("encoding.js"); return sizes.map(([w, h]) => fitted(w, h, 640))'
    found = run(body, sizes=[(1280, 720), (1080, 1920), (320, 240)])
    sizes = [(640, 360), (360, 640), (320, 240)]
    assert found == [{"width": width, "height": height} for width, height in sizes]


def test_replies_with_unknown_camera_models_are_drawn_without_distortion():
    reply = {
        "model": "FOV",
        "width": 2,
        "height": 2,
        "fx": 1,
        "fy": 1,
        "cx": 1,
        "cy": 1,
        "params": [1, 1, 1, 1, 0.5],
    }
    found = run('return (await load("cameras.js")).cameraFrom(reply)', reply=json.loads(json.dumps(reply)))
    assert found["distortion"] == [0, 0, 0, 0]
