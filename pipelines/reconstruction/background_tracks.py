"""Points of the background followed through the pictures of one camera, people left out.

Corners (Shi & Tomasi 1994) are followed by pyramidal Lucas-Kanade, forwards and back again. Points that do
not return to their start are dropped. Everything inside the boxes of detected people is left out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.reconstruction.observations import Camera

UInt8 = NDArray[np.uint8]

_MOST, _FEWEST = 400, 250  # points in a picture; new ones are looked for when fewer are left
_APART_PX, _EDGE_PX = 20, 8
_QUALITY = 0.005  # of the best corner
_RETURN_PX = 0.3
_WINDOW_PX, _LEVELS = 21, 3
_AROUND = 0.25  # of a person's box on each side: arms beyond joints, and 20 px of shadow
_AROUND_PX = 20.0


@dataclass(frozen=True)
class Tracks:
    """Sightings of background points: K of them."""

    picture: Int64  # [K] row of the pictures
    point: Int64  # [K] number of the point
    xy: Float  # [K, 2] px


def people_boxes(camera: Camera) -> Float:
    """Compute boxes around all people in each frame [F, D, 4] (left, top, right, bottom) px; NaN for none.

    A frame without people has the boxes of the last frame with people before it, or else of the first one.
    """
    found = camera.detections
    frames = len(camera.frame_t_ns)
    rank = np.arange(len(found.frame)) - np.searchsorted(found.frame, found.frame, side="left")
    boxes = np.full((frames, int(rank.max(initial=0)) + 1, 4), np.nan)
    seen = np.isfinite(found.xy[..., 0]).any(axis=1)
    xy = found.xy[seen]
    low, high = np.nanmin(xy, axis=1), np.nanmax(xy, axis=1)
    margin = _AROUND * (high - low).max(axis=1, keepdims=True) + _AROUND_PX
    boxes[found.frame[seen], rank[seen]] = np.concatenate([low - margin, high + margin], axis=1)
    known = np.flatnonzero(np.isfinite(boxes[..., 0]).any(axis=1))
    if not len(known):
        return boxes
    last = np.clip(np.searchsorted(known, np.arange(frames), side="right") - 1, 0, None)
    filled: Float = boxes[known[last]]
    return filled


def follow(pictures: Iterable[UInt8 | None], boxes: Float) -> Tracks:
    """Follow points through pictures.

    Args:
        pictures: in the order of time, each grey [H, W]; None for one that cannot be decoded. No point is
            followed across it.
        boxes: [F, D, 4] px of each picture, areas to leave out; NaN for none.
    """
    import cv2

    rows, numbers, places = [], [], []
    before: UInt8 | None = None
    points, number, count = np.empty((0, 2), np.float32), np.empty(0, np.int64), 0
    for row, picture in enumerate(pictures):
        if picture is None or before is None:
            points, number = points[:0], number[:0]
        elif len(points):
            ahead, found = _flow(before, picture, points[:, None])
            back, again = _flow(picture, before, ahead)
            good = (found[:, 0] > 0) & (again[:, 0] > 0)
            good &= np.linalg.norm(back[:, 0] - points, axis=1) < _RETURN_PX
            good &= _free(ahead[:, 0], boxes[row], picture.shape)
            points, number = ahead[good, 0], number[good]
        if picture is not None and len(points) < _FEWEST:
            corners = cv2.goodFeaturesToTrack(
                picture, _MOST - len(points), _QUALITY, _APART_PX, mask=_mask(picture, points, boxes[row])
            )
            if corners is not None:
                fresh = corners[:, 0][_free(corners[:, 0], boxes[row], picture.shape)]
                points = np.concatenate([points, fresh])
                number = np.concatenate([number, count + np.arange(len(fresh))])
                count += len(fresh)
        if picture is not None:
            rows.append(np.full(len(points), row))
            numbers.append(number)
            places.append(points.astype(np.float64))
        before = picture
    if not rows:
        return Tracks(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
    return Tracks(np.concatenate(rows), np.concatenate(numbers), np.concatenate(places))


def _flow(before: UInt8, after: UInt8, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Find points [N, 1, 2] of one picture in the other; also return found [N, 1], 0 or 1."""
    import cv2

    window = (_WINDOW_PX, _WINDOW_PX)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, np.empty_like(points), winSize=window, maxLevel=_LEVELS
    )
    return np.asarray(there), np.asarray(found)


def _free(xy: NDArray[np.float32], boxes: Float, shape: tuple[int, ...]) -> Bool:
    """Mark the points [N] that are inside the picture and on no person."""
    size = np.array([shape[1], shape[0]])
    free = ((xy > _EDGE_PX) & (xy < size - _EDGE_PX)).all(axis=1)
    for box in boxes[np.isfinite(boxes[:, 0])]:
        free &= ~((xy > box[:2]) & (xy < box[2:])).all(axis=1)
    return np.asarray(free, dtype=np.bool_)


def _mask(picture: UInt8, points: NDArray[np.float32], boxes: Float) -> UInt8:
    """Build the mask for new corners: away from old points and from people."""
    import cv2

    mask = np.full(picture.shape, 255, np.uint8)
    for x, y in np.round(points).astype(int).tolist():
        cv2.circle(mask, (x, y), _APART_PX, 0, -1)
    height, width = picture.shape
    for box in boxes[np.isfinite(boxes[:, 0])]:
        left, top, right, bottom = np.clip(np.round(box), 0, [width, height, width, height]).astype(int)
        mask[top:bottom, left:right] = 0
    return mask
