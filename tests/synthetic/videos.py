"""Small videos whose frames show their own number: a bar code of 16 blocks, white for a set bit."""

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from pipelines.geometry.arrays import Picture

_BLOCK = 20
SIZE = (16 * _BLOCK, 96)  # width, height of the pictures, as coded
TICK_S = Fraction(1, 90_000)


def even_ticks(count: int, step: int = 3000, first: int = 0) -> list[int]:
    """List stamps at a constant rate; 3000 ticks of TICK_S are 30 frames a second."""
    return [first + step * k for k in range(count)]


def uneven_ticks(count: int, seed: int = 0) -> list[int]:
    """Draw stamps with a rate between 15 and 60 Hz, and a pause of a second in the middle."""
    steps = np.random.default_rng(seed).integers(1500, 6000, count - 1)
    steps[count // 2] = 90_000
    return [0, *np.cumsum(steps).tolist()]


def bar_code(number: int) -> Picture:
    """Draw the picture of a frame: its bar code above a grey ramp that moves."""
    width, height = SIZE
    picture = np.empty((height, width, 3), dtype=np.uint8)
    picture[:] = ((np.arange(width) + 3 * number) % 128)[:, None]
    bits = np.repeat([255 * (number >> bit & 1) for bit in range(16)], _BLOCK)
    picture[: height // 2] = bits[:, None]
    return picture


def read_bar_code(picture: Picture) -> int:
    """Read the number in a picture; the threshold is halfway between black and white, safe for all codecs."""
    row = picture[SIZE[1] // 4, _BLOCK // 2 :: _BLOCK].mean(axis=-1)
    return sum(1 << bit for bit, value in enumerate(row) if value > 128)


def write_video(
    path: Path,
    ticks: Sequence[int],
    *,
    codec: str = "libx264",
    key_every: int = 12,
    b_frames: int = 2,
    turned_deg: int = 0,
    draw: Callable[[int], Picture] = bar_code,
    container_format: str | None = None,
) -> Path:
    """Write one frame for each of strictly increasing stamps, in TICK_S; the suffix is the container.

    MP4 has its table in front. `codec` and `container_format` are FFmpeg's names, `b_frames` frames in a row
    refer to later ones, and `turned_deg` counts counter-clockwise. `draw` makes pictures of one size.
    """
    mp4 = path.suffix in {".mp4", ".mov"}
    with av.open(
        str(path), "w", format=container_format, options={"movflags": "faststart"} if mp4 else {}
    ) as container:
        stream = container.add_stream(codec, rate=30)
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = draw(0).shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.time_base = stream.codec_context.time_base = TICK_S
        options = {"g": str(key_every), "bf": str(b_frames)}
        if codec == "libx264":
            options |= {"preset": "ultrafast", "sc_threshold": "0", "qp": "23"}
        stream.codec_context.options = options if codec != "mjpeg" else {}
        if turned_deg:
            stream.set_display_rotation(turned_deg)
        container.start_encoding()  # also without a frame
        for number, pts in enumerate(ticks):
            frame = av.VideoFrame.from_ndarray(draw(number), format="bgr24")
            frame.pts, frame.time_base = pts, TICK_S
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
