"""Tracking by WebSocket: poses are the library's, clients share the workers, maps are replaced meanwhile."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from itertools import pairwise

import cv2
import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from poster import poster_map
from serving import EYES, encoded, frame, hello, photo, served, tracking
from slimsfm.localization import Localizer
from slimsfm.localization.cameras import QueryCamera, guess_camera
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.subset import keep_images
from slimsfm.photos import upright
from slimsfm.serve.options import ServeLimits
from slimsfm.serve.replies import pose_reply
from slimsfm.tracking import Tracker

CAMERAS = {
    "map": ("map", None),
    "unknown": (None, QueryCamera(camera=guess_camera(320, 240), source="unknown")),
}


def answers(client, frames):
    """The answers to frames, each sent after the answer to the one before."""
    found = []
    for one in frames:
        client.send(one)
        found.append(json.loads(client.recv(30)))
    return found


def decoded(data, tmp_path):
    from slimsfm.photos import read_image

    path = tmp_path / "frame.jpg"
    path.write_bytes(data[16:])
    return read_image(path, "stored")


@pytest.mark.parametrize("camera", CAMERAS)
def test_poses_are_those_of_the_library_for_the_same_frames(server, poster, tmp_path, camera):
    asked, given = CAMERAS[camera]
    tracker = Tracker(Localizer(read_map(poster)))
    count = len(EYES) if given is None else 2  # to estimate a focal length takes longer
    frames = [frame(index, sequence=10 + index) for index in range(count)]
    with tracking(server.socket_url, hello(camera=asked)) as client:
        replies = answers(client, frames)
    assert [one["sequence"] for one in replies] == [10, 11, 12, 13][:count]
    assert [one["captured"] for one in replies] == [1e4, 1.1e4, 1.2e4, 1.3e4][:count]
    for reply, sent in zip(replies, frames, strict=True):
        found = tracker.track(decoded(sent, tmp_path), given)
        assert reply["cam_from_world"] == (found.pose and pose_reply(found.pose.cam_from_world))
        assert (reply["state"], reply["found"]) == (found.state, found.pose is not None)
        assert reply["confidence"] == (found.pose and found.pose.confidence)
        assert (reply["type"], reply["dropped"], reply["map"]) == ("pose", 0, "poster")
        assert set(reply["ms"]) == {"decode", "wait", "track", "total"}
    assert replies[-1]["state"] == ("localized" if given else "tracked")


def test_frames_held_sideways_are_turned_upright(server):
    turned = frame(0)[:16] + encoded(upright(photo(), 8), ".jpg")
    turned = turned[:1] + b"\x06" + turned[2:]  # orientation 6 turns them back
    with tracking(server.socket_url) as client:
        (reply,) = answers(client, [turned])
    assert reply["found"]
    assert (reply["camera"]["width"], reply["camera"]["height"]) == (320, 240)


def test_a_frame_without_the_object_is_lost_and_the_next_one_found(server):
    nothing = frame(0)[:16] + encoded(np.full((240, 320, 3), 90, np.uint8), ".jpg")
    with tracking(server.socket_url) as client:
        states = [one["state"] for one in answers(client, [frame(0), nothing, frame(0)])]
    assert states == ["localized", "lost", "localized"]


def test_the_newest_frame_replaces_one_that_waits(server):
    with tracking(server.socket_url) as client:
        for sequence in range(30):
            client.send(frame(0, sequence))
        got, dropped = [], 0
        while not got or got[-1] < 29:
            reply = json.loads(client.recv(30))
            got.append(reply["sequence"])
            dropped += reply["dropped"]
    assert got == sorted(got)
    assert len(got) + dropped == 30
    assert dropped > 0


def test_a_further_hello_begins_anew(server):
    with tracking(server.socket_url) as client:
        assert answers(client, [frame(0)])[0]["camera"]["fx"] == 400
        client.send(hello(camera={"fx": 410, "fy": 410, "cx": 160, "cy": 120}))
        assert json.loads(client.recv(20))["type"] == "welcome"
        (reply,) = answers(client, [frame(0)])
    assert (reply["camera"]["fx"], reply["camera_source"]) == (410, "given")


def test_clients_share_the_workers_fairly_with_one_who_asks_much(poster):
    limits = ServeLimits(workers=1, requests_per_second=1000.0, burst=1000)
    with served(poster, limits=limits) as server, ExitStack() as stack:
        clients = [stack.enter_context(tracking(server.socket_url)) for _ in range(3)]
        stop = time.monotonic() + 1.5
        counts = [0] * len(clients)

        def flood():
            with httpx.Client(base_url=server.url, timeout=30) as http:
                while time.monotonic() < stop:
                    http.post("v1/localize", content=encoded(photo()))

        def follow(number):
            while time.monotonic() < stop:
                answers(clients[number], [frame(counts[number] % 4, counts[number])])
                counts[number] += 1

        threads = [threading.Thread(target=flood) for _ in range(4)]
        threads += [threading.Thread(target=follow, args=(number,)) for number in range(3)]
        for one in threads:
            one.start()
        for one in threads:
            one.join()
    assert min(counts) > 0.5 * max(counts) > 0


def test_a_map_is_replaced_while_clients_track(tmp_path):
    path = tmp_path / "poster"
    write_map(poster_map(), path)
    limits = ServeLimits(reload_every_s=0.05)
    with served(path, limits=limits) as server, httpx.Client(base_url=server.url, timeout=30) as http:
        before = http.get("v1/maps/poster").json()["version"]
        with tracking(server.socket_url) as client:
            assert answers(client, [frame(0)])[0]["map_version"] == before
            write_map(keep_images(poster_map(), ["1.png", "3.png"]), path, overwrite=True)
            versions, until = [], time.monotonic() + 20
            while time.monotonic() < until and versions[-2:] in ([], [before], [before] * 2):
                (reply,) = answers(client, [frame(0)])
                asked = http.post("v1/localize", content=encoded(photo()))
                assert (reply["found"], asked.status_code, asked.json()["found"]) == (True, 200, True)
                versions.append(reply["map_version"])
            assert versions[-1] != before
            (path / "map.json").write_text("{")  # half-written by another program
            time.sleep(0.3)
            assert answers(client, [frame(0)])[0]["map_version"] == versions[-1]
            shutil.rmtree(path)
            time.sleep(0.3)
            assert answers(client, [frame(0)])[0]["map_version"] == versions[-1]
    assert all(one in (two, before) for one, two in pairwise(versions))


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT], ids=["SIGTERM", "SIGINT"])
def test_a_signal_lets_the_server_finish_what_runs(poster, how):
    process = subprocess.Popen(
        [sys.executable, "-m", "slimsfm", "serve", poster, "--port", "0", "--workers", "1"],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        first = process.stdout.readline()
        assert first.endswith(" serves poster; Ctrl-C stops it\n")
        url = first.split()[0]
        got, large = [], encoded(cv2.resize(photo(), (800, 600)))

        def ask():
            got.append(httpx.post(f"{url}v1/localize", content=large, timeout=60).status_code)

        with tracking(f"{url.replace('http', 'ws')}v1/track") as client:
            askers = [threading.Thread(target=ask) for _ in range(3)]
            client.send(frame(0, 7))
            for one in askers:
                one.start()
            while "\nslimsfm_waiting 2\n" not in httpx.get(f"{url}metrics").text:
                pass
            process.send_signal(how)
            assert json.loads(client.recv(30))["sequence"] == 7
            with pytest.raises(ConnectionClosed) as closed:
                client.recv(30)
            assert closed.value.rcvd.code == 1001
        for one in askers:
            one.join()
        _, err = process.communicate(timeout=20)
    finally:
        process.kill()
    assert got == [200] * 3
    assert (process.returncode, err) == (0, "")
    with pytest.raises(OSError, match="refused"), connect(f"{url.replace('http', 'ws')}v1/track"):
        pass
