"""How fast `slimsfm serve` answers, how fairly, and how steadily under load; clients run on the same machine.

    python benchmarks/serving.py -o /tmp/serving
    python benchmarks/serving.py -o /tmp/serving --load 600

Renders an object and a film of it, maps and reduces it (once), and serves the reduced map in a process of its
own. Frames and queries are JPEG of 640x480 pixels. Glass to pose is the time from a decoded picture through
encoding it as JPEG to the pose at the client.
"""

import argparse
import asyncio
import json
import random
import re
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

import cv2
import httpx
import numpy as np
from websockets.asyncio.client import connect

from benchmark_scenes import rendered
from film import film
from slimsfm.arrays import Image
from slimsfm.cli import run
from slimsfm.image_files import list_images
from slimsfm.photos import read_image

NAME, WIDTH, HEIGHT = "printed_box", 640, 480
WANTED_FPS, WANTED_MS, WANTED_QUERIES, WANTED_FLAT_MB = 15, 100, 20, 50


@dataclass(frozen=True, kw_only=True)
class Server:
    """A server that runs."""

    url: str
    process: subprocess.Popen


@dataclass(kw_only=True)
class Rides:
    """What a tracked client saw."""

    ms: list[float] = field(default_factory=list)
    states: Counter = field(default_factory=Counter)


@dataclass(kw_only=True)
class Load:
    """What happened under mixed traffic."""

    statuses: Counter = field(default_factory=Counter)
    ms: list[float] = field(default_factory=list)
    without_retry_after: int = 0


def main() -> None:
    """Prepare, serve, measure and print."""
    arguments = parsed()
    map_path = arguments.map or slim_map(arguments.output)
    frames = [read_image(path) for path in frame_paths(arguments.frames or arguments.output / "frames")]
    with serving(map_path) as server:
        print("| what | measured | wanted |\n|---|---|---|")
        (one,) = asyncio.run(ride_together(server.url, frames, 1, arguments.seconds))
        rate, median = len(one.ms) / arguments.seconds, np.median(one.ms)
        tracked = one.states["tracked"] / max(1, len(one.ms))
        print(f"| frames per second, one client | {rate:.1f} ({tracked:.0%} tracked) | {WANTED_FPS} |")
        late = np.percentile(one.ms, 95)
        print(f"| glass to pose, median | {median:.0f} ms (95 % within {late:.0f}) | {WANTED_MS} ms |")
        many = asyncio.run(ride_together(server.url, frames, 8, arguments.seconds))
        rates = [len(ride.ms) / arguments.seconds for ride in many]
        print(f"| frames per second, each of 8 clients | {min(rates):.1f} to {max(rates):.1f} | fair |")
        queries = [encoded(frame) for frame in frames[:: max(1, len(frames) // 20)]]
        for label, params in (("", {}), (", focal length unknown", {"focal": "unknown"})):
            rate, found = asyncio.run(ask_together(server.url, queries, params, arguments.seconds))
            print(f"| single queries per second{label} | {rate:.1f} ({found:.0%} found) | {WANTED_QUERIES} |")
        if arguments.load:
            asyncio.run(under_load(server, queries, arguments.load))


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path, help="folder of what is rendered")
    parser.add_argument("--map", type=Path, help="map to serve instead")
    parser.add_argument("--frames", type=Path, help="folder of frames to send instead")
    parser.add_argument("--seconds", type=float, default=10.0, help="time of each measurement")
    parser.add_argument("--load", type=float, default=0.0, help="seconds of mixed traffic")
    return parser.parse_args()


def slim_map(output: Path) -> Path:
    """A rendered object's map, reduced with the defaults of `slimsfm reduce`."""
    path = output / f"{NAME}-slim"
    if not path.exists():
        full = output / f"{NAME}-map"
        if not full.exists():
            rendered(NAME, output)
        if run(["reduce", str(full), "-o", str(path)]):
            raise SystemExit(1)
    return path


def frame_paths(folder: Path) -> list[Path]:
    """The frames of a folder; those before the film's cut are rendered if there is none."""
    if not folder.exists():
        made = film(NAME, 200, WIDTH, HEIGHT)
        folder.mkdir(parents=True)
        for index in range(made.cut):
            bgr = cv2.cvtColor(made.frame(index), cv2.COLOR_RGB2BGR)
            cv2.imwrite(str(folder / f"{index:03d}.png"), bgr)
    return [folder / name for name in list_images(folder)]


@contextmanager
def serving(map_path: Path) -> Iterator[Server]:
    """The command itself, in a process of its own."""
    command = [sys.executable, "-m", "slimsfm", "serve", str(map_path), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout
        yield Server(url=process.stdout.readline().split()[0], process=process)
    finally:
        process.terminate()
        process.wait(30)


def encoded(image: Image) -> bytes:
    """A picture as a client sends it."""
    small = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()


async def ride_together(url: str, frames: Sequence[Image], clients: int, seconds: float) -> list[Rides]:
    """Track several clients for some time; each starts elsewhere in the film, which goes forth and back."""
    there_and_back = [*frames, *frames[-2:0:-1]]
    steps = len(there_and_back) // clients
    tasks = [
        ride(url, there_and_back[k * steps :] + there_and_back[: k * steps], seconds) for k in range(clients)
    ]
    return list(await asyncio.gather(*tasks))


async def ride(url: str, frames: Sequence[Image], seconds: float) -> Rides:
    """Send one frame after the other for some time, each after the answer to the one before."""
    found, index = Rides(), 0
    async with connect(f"{url.replace('http', 'ws')}v1/track", max_size=None) as socket:
        hello = {"type": "hello", "version": 1, "maps": [], "width": WIDTH, "height": HEIGHT, "camera": "map"}
        await socket.send(json.dumps(hello))
        await socket.recv()
        await send_frame(socket, frames[0], 0)  # the first pose takes a search
        until = perf_counter() + seconds
        while perf_counter() < until:
            index += 1
            start = perf_counter()
            reply = await send_frame(socket, frames[index % len(frames)], index)
            found.ms.append(1e3 * (perf_counter() - start))
            found.states[reply["state"]] += 1
    return found


async def send_frame(socket, image: Image, index: int) -> dict:
    """Send a frame and wait for its pose."""
    await socket.send(struct.pack("<BBHId", 1, 1, 0, index, 0.0) + encoded(image))
    return json.loads(await socket.recv())


async def ask_together(
    url: str, queries: Sequence[bytes], params: dict, seconds: float
) -> tuple[float, float]:
    """Queries per second by two connections, and the share that was localized."""
    found: list[bool] = []
    until = perf_counter() + seconds

    async def ask(offset: int) -> None:
        async with httpx.AsyncClient(base_url=url, timeout=60) as client:
            index = offset
            while perf_counter() < until:
                data = queries[index % len(queries)]
                found.append((await client.post("v1/localize", content=data, params=params)).json()["found"])
                index += 2

    start = perf_counter()
    await asyncio.gather(ask(0), ask(1))
    return len(found) / (perf_counter() - start), float(np.mean(found))


async def under_load(server: Server, queries: Sequence[bytes], seconds: float) -> None:
    """Valid, invalid, slow and aborted requests together, and what became of them."""
    load, until = Load(), perf_counter() + seconds
    before = await memory_mb(server.url)
    tasks = [mixed(server.url, queries, load, until, seed) for seed in range(8)]
    watch = asyncio.ensure_future(watched(server.url, until))
    await asyncio.gather(*tasks)
    memory = await watch
    failed = sum(count for code, count in load.statuses.items() if code >= 500 and code != 503)
    median, late = np.percentile(load.ms, [50, 99])
    print(f"| requests in {seconds:.0f} s of mixed traffic | {sum(load.statuses.values())} | |")
    print(f"| answers by status (0: aborted, 101: frames) | {dict(sorted(load.statuses.items()))} | |")
    print(f"| errors of the server | {failed} | 0 |")
    print(f"| refusals without Retry-After | {load.without_retry_after} | 0 |")
    print(f"| valid requests, 99 % within | {late:.0f} ms (median {median:.0f}) | |")
    settled = memory[len(memory) // 5] if memory else before
    print(f"| memory: start, after a fifth, most | {before:.0f}, {settled:.0f}, {max(memory):.0f} MB | |")
    print(f"| growth after a fifth | {max(memory) - settled:.0f} MB | {WANTED_FLAT_MB} MB |")


async def mixed(url: str, queries: Sequence[bytes], load: Load, until: float, seed: int) -> None:
    """One client's share of the traffic."""
    rng = random.Random(seed)
    kinds = [valid, valid, valid, valid, invalid, invalid, slow, aborted, tracked_for_a_while]
    async with httpx.AsyncClient(base_url=url, timeout=60) as client:
        while perf_counter() < until:
            await rng.choice(kinds)(client, rng, queries, load)


def noted(load: Load, answer: httpx.Response) -> None:
    """Count an answer."""
    load.statuses[answer.status_code] += 1
    if answer.status_code == 503 and "retry-after" not in answer.headers:
        load.without_retry_after += 1


async def valid(client: httpx.AsyncClient, rng: random.Random, queries: Sequence[bytes], load: Load) -> None:
    """Localize an image, or ask for maps and points."""
    start = perf_counter()
    if rng.random() < 0.6:
        noted(load, await client.post("v1/localize", content=rng.choice(queries)))
    else:
        noted(load, await client.get(rng.choice(["v1/maps", "healthz", "metrics"])))
    load.ms.append(1e3 * (perf_counter() - start))


async def invalid(
    client: httpx.AsyncClient, rng: random.Random, queries: Sequence[bytes], load: Load
) -> None:
    """Damaged images, wrong parameters, wrong paths."""
    data = bytearray(rng.choice(queries))
    for _ in range(20):
        data[rng.randrange(len(data))] = rng.randrange(256)
    bodies = [b"", b"text", bytes(data), bytes(data[: len(data) // 2]), b"\xff\xd8\xff" + rng.randbytes(3000)]
    query = rng.choice(["", "?fx=nan", "?map=../x", "?prior=1,2"])
    noted(load, await client.post(f"v1/localize{query}", content=rng.choice(bodies)))


async def slow(client: httpx.AsyncClient, rng: random.Random, queries: Sequence[bytes], load: Load) -> None:
    """A body that comes in small parts."""
    data = rng.choice(queries)

    async def parts():
        for start in range(0, len(data), len(data) // 10 + 1):
            yield data[start : start + len(data) // 10 + 1]
            await asyncio.sleep(0.02)

    noted(load, await client.post("v1/localize", content=parts()))


async def aborted(
    client: httpx.AsyncClient, rng: random.Random, queries: Sequence[bytes], load: Load
) -> None:
    """A client that leaves in the middle of its request, or before the answer."""
    address = client.base_url
    _, writer = await asyncio.open_connection(address.host, address.port)
    data = rng.choice(queries)
    head = f"POST /v1/localize HTTP/1.1\r\nHost: {address.host}\r\nContent-Length: {len(data)}\r\n\r\n"
    writer.write(head.encode() + data[: rng.choice([0, len(data) // 2, len(data)])])
    await writer.drain()
    await asyncio.sleep(rng.random() * 0.05)
    writer.close()
    load.statuses[0] += 1


async def tracked_for_a_while(
    client: httpx.AsyncClient, rng: random.Random, queries: Sequence[bytes], load: Load
) -> None:
    """A session of some frames."""
    async with connect(f"{str(client.base_url).replace('http', 'ws')}v1/track", max_size=None) as socket:
        hello = {"type": "hello", "version": 1, "maps": [], "width": WIDTH, "height": HEIGHT, "camera": "map"}
        await socket.send(json.dumps(hello))
        await socket.recv()
        for index in range(rng.randrange(1, 8)):
            await socket.send(struct.pack("<BBHId", 1, 1, 0, index, 0.0) + rng.choice(queries))
            await socket.recv()
            load.statuses[101] += 1


async def watched(url: str, until: float) -> list[float]:
    """Memory of the server, every second."""
    found = []
    while perf_counter() < until:
        found.append(await memory_mb(url))
        await asyncio.sleep(1.0)
    return found


async def memory_mb(url: str) -> float:
    """Memory of the server."""
    async with httpx.AsyncClient(base_url=url, timeout=60) as client:
        text = (await client.get("metrics")).text
    found = re.search(r"^slimsfm_resident_memory_bytes (\S+)", text, re.MULTILINE)
    return float(found[1]) / 1e6 if found else np.nan


if __name__ == "__main__":
    main()
