"""Small pictures of every camera for the page's viewer, cut out around the person, with the joints in them.

The number of pictures follows from a budget of bytes, and their times are spread evenly over the flight.
"""

from __future__ import annotations

import base64
from typing import Literal

import numpy as np

from pipelines.geometry.arrays import Float, Int64, Picture
from pipelines.reporting.content import SessionContent, Strip
from pipelines.reporting.motion import Motion
from pipelines.reporting.overlays import FilmedCamera, ReadFrame, filmed_cameras, status_at, views_of
from pipelines.reporting.panels import Window, centred, cut_out
from pipelines.reporting.summary import Summary

Video = Literal["none", "small", "full"]
"""Choice of the pictures in the page: none, at most 3 MB, or at most 15 MB before base64."""

_BUDGET = {"small": (3_000_000, 320, 55), "full": (15_000_000, 640, 70)}  # bytes, px, quality of WebP
_MOST_HZ = 15.0
_MARGIN = 1.5  # side of a picture, relative to the body
_LEAST_PX = 96.0
_TRIED = 3  # pictures that are encoded to learn their size


def make_strips(
    content: SessionContent, summary: Summary, read_frame: ReadFrame | None, video: Video
) -> list[Strip]:
    """Make the pictures of every camera that has any; nothing without a skeleton.

    Args:
        content: as for `collect_moments`.
        read_frame: reads the pictures.
        video: the budget for all cameras together.
    """
    motion = summary.motion
    if video == "none" or read_frame is None or motion is None or not motion.measured.any():
        return []
    cameras = filmed_cameras(content)
    budget = _BUDGET[video][0] / max(len(cameras), 1)
    strips = [_strip(camera, motion, summary.origin_ns, read_frame, video, budget) for camera in cameras]
    return [strip for strip in strips if strip is not None]


def _strip(
    camera: FilmedCamera, motion: Motion, origin_ns: int, read_frame: ReadFrame, video: Video, budget: float
) -> Strip | None:
    inside = (camera.frame_t_ns >= motion.t_ns[0]) & (camera.frame_t_ns <= motion.t_ns[-1])
    rows = np.flatnonzero(inside)
    if not len(rows):
        return None
    tried = rows[np.linspace(0, len(rows) - 1, _TRIED + 2).astype(np.int64)[1:-1]]
    sizes = [len(each) for _, each, _ in _cut(camera, tried, motion, origin_ns, read_frame, video)]
    if not sizes:
        return None
    seconds = (camera.frame_t_ns[rows[-1]] - camera.frame_t_ns[rows[0]]) / 1e9
    most = int(min(0.75 * budget / max(sizes), _MOST_HZ * seconds + 1, len(rows)))
    chosen = rows[np.unique(np.linspace(0, len(rows) - 1, max(most, 1)).round().astype(np.int64))]
    cut = _cut(camera, chosen, motion, origin_ns, read_frame, video)
    while sum(len(each) for _, each, _ in cut) > 0.75 * budget and len(cut) > 1:  # base64 adds a third
        cut = cut[::2]
    return Strip(
        camera=camera.name,
        t_ns=np.array([camera.frame_t_ns[row] for row, _, _ in cut], dtype=np.int64),
        pictures=tuple(base64.b64encode(each).decode("ascii") for _, each, _ in cut),
        joints=np.stack([joints for *_, joints in cut]),
    )


def _cut(
    camera: FilmedCamera, rows: Int64, motion: Motion, origin_ns: int, read_frame: ReadFrame, video: Video
) -> list[tuple[int, bytes, Float]]:
    """Cut out and encode the pictures of frames that have any: row, WebP, joints."""
    size = (camera.intrinsics.width, camera.intrinsics.height)
    views = views_of(camera, rows, motion, status_at(motion, camera.frame_t_ns[rows]), origin_ns)
    bodies = [_inside(view.reprojected, size) for view in views]
    extents = [float(np.ptp(points, axis=0).max()) for points in bodies if len(points)]
    side = min(max(_MARGIN * float(np.percentile(extents, 90)) if extents else 0.0, _LEAST_PX), max(size))
    middle = np.array(size) / 2
    found = []
    for row, view, points in zip(rows.tolist(), views, bodies, strict=True):
        middle = (points.min(axis=0) + points.max(axis=0)) / 2 if len(points) else middle
        picture = read_frame(camera.name, view.frame)
        if picture is None:
            continue
        window = centred(middle, side, size)
        encoded = _encode(picture, size, window, video)
        joints = (view.reprojected - [window.left, window.top]) / window.width
        found.append((row, encoded, joints))
    return found


def _inside(points: Float, size: tuple[int, int]) -> Float:
    """Return the known points [N, 2] that lie in the picture."""
    flat = points.reshape(-1, 2)
    kept: Float = flat[(flat >= 0).all(axis=1) & (flat < size).all(axis=1)]  # False for NaN
    return kept


def _encode(picture: Picture, size: tuple[int, int], window: Window, video: Video) -> bytes:
    """Encode the window as a square WebP; beyond the picture it is black."""
    import cv2

    _, px, quality = _BUDGET[video]
    part, (left, right, bottom, top) = cut_out(picture, size, window)
    square = np.zeros((px, px, 3), np.uint8)
    edges = np.array([left - window.left, right - window.left, top - window.top, bottom - window.top])
    x0, x1, y0, y1 = np.clip(np.round(edges / window.width * px), 0, px).astype(int).tolist()
    if part.size and x1 > x0 and y1 > y0:
        square[y0:y1, x0:x1] = cv2.resize(part, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
    _, webp = cv2.imencode(".webp", square, [cv2.IMWRITE_WEBP_QUALITY, quality])
    return webp.tobytes()
