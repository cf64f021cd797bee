"""Flights with videos of a person made of three bright spots, and ONNX models that find them."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.geometry.poses import look_at
from pipelines.simulation.detector_errors import see
from pipelines.simulation.flight_files import write_tum
from tests.keypoints.onnx_graphs import constant_model, heatmap_model, spots

START_S, FPS = 1_700_000_000, 30
LENS = Intrinsics(320, 240, 300.0, 300.0, 159.5, 119.5, "none", ())
CAMERAS = {"left": (-3.0, -5.0, 1.5), "right": (3.0, -5.0, 1.5)}
_SPOT_PX = 3.0


def person_at(t_s: Float) -> Float:
    """Compute the three spots [T, 3, 3] m, top first, of a person who sways along x.

    Joint j of 17 is spot j % 3.
    """
    middle = np.stack([0.5 * np.sin(t_s), np.zeros_like(t_s)], axis=-1)
    return np.stack(
        [np.column_stack([middle, np.full(len(t_s), height)]) for height in (1.6, 1.0, 0.4)], axis=1
    )


def write_spotted_flight(folder: Path, frames: int) -> Path:
    """Write a flight of two cameras with videos of 320x240, without keypoints; return its flight.yaml."""
    t_s = np.arange(frames) / FPS
    stamps = START_S * 10**9 + np.round(t_s * 1e9).astype(np.int64)
    lines = ["schema: 1", "name: Spots", "world: {frame: enu}", "cameras:"]
    for name, place in CAMERAS.items():
        position = np.tile(place, (frames, 1))
        quaternion = look_at(position, np.tile([0.0, 0.0, 1.0], (frames, 1)))
        write_tum(folder / f"{name}.tum", stamps, position, quaternion)
        pixels = see(person_at(t_s), position, quaternion, LENS)
        pictures = (spots(LENS.width, LENS.height, places, _SPOT_PX) for places in pixels.tolist())
        write_pictures(folder / f"{name}.mp4", pictures)
        numbers = ("width", "height", "fx", "fy", "cx", "cy")
        stated = ", ".join(f"{number}: {getattr(LENS, number):g}" for number in numbers)
        lines.append(
            f"  {name}: {{video: {name}.mp4, frame_times: {{start: {START_S}}}, pose: {{file: {name}.tum}},"
            f" intrinsics: {{{stated}}}, clock: {{offset_s: 0, sigma_s: 0}}}}"
        )
    path = folder / "flight.yaml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def spot_detector(folder: Path) -> str:
    """Return the value of `--detector`: models that find the spots, and a person in every picture."""
    pose = heatmap_model(folder / "pose.onnx", bands=3)
    box = np.array([[(100.0, 60.0, 220.0, 180.0, 0.9)]], np.float32)
    people = constant_model(folder / "people.onnx", (320, 320), {"dets": box})
    return f"onnx:{pose},people={people},mean=0/0/0,std=255/255/255,provider=cpu"


def write_pictures(path: Path, pictures: Iterable[NDArray[np.uint8]]) -> None:
    """Write an H.264 video of BGR pictures at 30 Hz."""
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = None
        for number, picture in enumerate(pictures):
            if stream is None:
                stream = container.add_stream("libx264", rate=FPS)
                assert isinstance(stream, av.VideoStream)
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.time_base = stream.codec_context.time_base = Fraction(1, FPS)
                stream.codec_context.options = {"preset": "ultrafast", "crf": "18", "g": "30"}
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            frame.pts, frame.time_base = number, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        assert stream is not None
        container.mux(stream.encode(None))
