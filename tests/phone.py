"""Videos as phones write them: stored sideways with a display matrix, with a frame rate that varies."""

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np


def write_phone_video(path: Path, images: Sequence[np.ndarray], times_ms: Sequence[int]) -> None:
    """Write upright images so that a player has to turn them by a quarter, each shown from its time on."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", 30)
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "12", "preset": "veryfast"}
        stream.height, stream.width = images[0].shape[1], images[0].shape[0]
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for image, time_ms in zip(images, times_ms, strict=True):
            stored = np.ascontiguousarray(np.rot90(image))
            frame = av.VideoFrame.from_ndarray(stored, format="rgb24")
            frame.time_base, frame.pts = Fraction(1, 1000), time_ms
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 44
    numbers = [0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30]  # right is down, down is left
    data[start : start + 36] = struct.pack(">9i", *numbers)
    path.write_bytes(data)


def cut_off(path: Path, share: float) -> None:
    """Leave only the first part of the film of a video, as a full disk does; its index stays whole."""
    data = path.read_bytes()
    start, end = data.index(b"mdat") + 4, data.rindex(b"moov") - 4
    keep = start + round(share * (end - start))
    path.write_bytes(data[:keep] + bytes(end - keep) + data[end:])
