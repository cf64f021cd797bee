"""Points of the background followed through the pictures of one camera, and pictures of it.

Corners (Shi & Tomasi 1994) are followed by pyramidal Lucas-Kanade, forwards and back again. Points that do
not return to their start are dropped. Everything is followed, people too, so that tracks depend on the
pictures alone; sightings on people are dropped when tracks are loaded.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bytes, Float, Int64, Intrinsics
from pipelines.geometry.cameras import row_delay_s, undistort
from pipelines.geometry.poses import velocities
from pipelines.reconstruction.observations import Camera
from pipelines.session.errors import DataError
from pipelines.session.tables import TRACKS, table_parts

_MOST, _FEWEST = 300, 200  # points in a picture; new ones are looked for when fewer are left
_APART_PX, _EDGE_PX = 20, 8
# Corners weaker than this share of the best one drift along edges.
_QUALITY = 0.005
# A point that is followed back to another place than it came from was lost.
_RETURN_PX = 0.3
_WINDOW_PX, _LEVELS = 21, 3
_AROUND, _AROUND_PX = 0.03, 10.0  # of a person's box on each side, and px: arms beyond joints
# More pictures a second show the same motion and take more time.
_MOST_HZ = 60.0


@dataclass(frozen=True)
class Tracks:
    """Sightings of background points: K of them, sorted by picture."""

    picture: Int64  # [K] row of the pictures
    point: Int64  # [K] number of the point
    xy: Float  # [K, 2] px


def rays_at_stamps(tracks: Tracks, intrinsics: Intrinsics, t_ns: Int64) -> Float:
    """Compute the rays [K, 2] of points at stamps [T]; those of a rolling shutter go on till then."""
    rays = undistort(tracks.xy, intrinsics)
    if not intrinsics.readout_s:
        return rays
    delay_s = row_delay_s(tracks.xy[:, 1], intrinsics)
    order = np.lexsort((tracks.picture, tracks.point))
    point, picture = tracks.point[order], tracks.picture[order]
    follows = (np.diff(point) == 0) & (np.diff(picture) == 1)
    t_s = (t_ns[picture] - t_ns[0]) / 1e9 + delay_s[order]
    before, after = velocities(t_s, rays[order], follows)
    sides = np.stack([np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)])
    motion = np.empty_like(rays)
    motion[order] = sides.mean(axis=0) * delay_s[order, None]
    # A point that was seen once has no velocity, and is used for nothing.
    return rays - np.nan_to_num(motion)


@dataclass(frozen=True)
class Followed:
    """Background of one camera, loaded in parts, each from the last picture of the part before on."""

    rows: Int64  # [T] of its frames
    begins: Int64  # [N] first picture of each part; pictures count these rows
    parts: Sequence[Callable[[], Tracks]]  # N of them

    def between(self, first: int, stop: int) -> Iterator[Tracks]:
        """Load the parts with pictures from `first` to before `stop`, one at a time."""
        begin, end = np.searchsorted(self.begins, (first, stop)).tolist()
        for part in self.parts[max(begin - 1, 0) : end]:
            yield part()


@dataclass(frozen=True)
class Stills:
    """Some grey pictures of one camera."""

    rows: Int64  # [S] of its frames
    picture: Callable[[int], Bytes]  # decodes one of them


def tracks_path(folder: Path) -> Path:
    """Return the file of a camera's tracks in its folder of the stage `background`."""
    return folder / "tracks.parquet"


def still_name(number: int) -> str:
    """Return the name of the file of a still by its frame's number."""
    return f"{number:09d}.jpg"


def rows_to_follow(t_ns: Int64) -> Int64:
    """Choose the frames, of times [F], in which a camera's background is followed."""
    if len(t_ns) < 2:
        return np.arange(len(t_ns))
    period_s = float(np.median(np.diff(t_ns))) / 1e9
    return np.arange(0, len(t_ns), max(1, round(1 / (_MOST_HZ * max(period_s, 1e-9)))))


def load_tracks(session: Path, camera: Camera) -> Followed | None:
    """Open the background of a camera, without sightings on people; None if it was not followed.

    A track ends where it meets the box of a person. DataError: the file cannot be read.
    """
    path = tracks_path(session / "background" / camera.name)
    if not path.is_file():
        return None
    rows = rows_to_follow(camera.frame_t_ns)
    numbers, boxes = camera.frame_number[rows], people_boxes(camera)[rows]

    def load(read: Callable[[], pd.DataFrame]) -> Tracks:
        part = read()
        frame, point = (part[name].to_numpy(np.int64) for name in ("frame", "point"))
        xy = part[["x", "y"]].to_numpy(np.float64)
        picture = np.searchsorted(numbers, frame)
        known = picture < len(rows)
        known[known] = numbers[picture[known]] == frame[known]
        return off_people(Tracks(picture[known], point[known], xy[known]), boxes)

    parts = table_parts(path, TRACKS)
    firsts = np.array([first for first, _ in parts], dtype=np.int64)
    if len(numbers):  # of a camera of which only a stretch was loaded: no parts before or after it
        there = slice(*np.searchsorted(firsts, (numbers[0], numbers[-1] + 1)))
        there = slice(max(there.start - 1, 0), there.stop)
        parts, firsts = parts[there], firsts[there]
    begins = np.searchsorted(numbers, firsts)
    return Followed(rows, begins, [partial(load, read) for _, read in parts])


def load_stills(session: Path, camera: Camera) -> Stills | None:
    """Load the stills of a camera; None if there are none."""
    paths = sorted((session / "background" / camera.name / "stills").glob("*.jpg"))
    numbers = np.array([int(path.stem) for path in paths], dtype=np.int64)
    row = np.searchsorted(camera.frame_number, numbers)
    known = row < len(camera.frame_number)
    known[known] = camera.frame_number[row[known]] == numbers[known]
    if not known.any():
        return None
    shown = [paths[k] for k in np.flatnonzero(known)]
    return Stills(row[known], lambda k: _decoded(shown[k]))


def _decoded(path: Path) -> Bytes:
    picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise DataError(path, "cannot be decoded", "run `mocap reconstruct --force`", code="damaged")
    return np.asarray(picture, dtype=np.uint8)


def off_people(tracks: Tracks, boxes: Float) -> Tracks:
    """Drop sightings in people's boxes [T, D, 4] of the pictures, and the rest of their tracks."""
    at, xy = boxes[tracks.picture], tracks.xy[:, None]
    inside = np.asarray(((xy > at[..., :2]) & (xy < at[..., 2:])).all(axis=2)).any(axis=1)
    names, number = np.unique(tracks.point, return_inverse=True)
    ended = np.full(len(names), np.iinfo(np.int64).max)
    np.minimum.at(ended, number[inside], tracks.picture[inside])
    kept = tracks.picture < ended[number]
    return Tracks(tracks.picture[kept], tracks.point[kept], tracks.xy[kept])


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
    return boxes[known[last]]


class Follower:
    """Tracker of points through the pictures of one camera."""

    def __init__(self) -> None:
        self._before: Bytes | None = None
        self._points = np.empty((0, 2), np.float32)
        self._number = np.empty(0, np.int64)
        self._count = 0
        self._found: list[tuple[int, Int64, NDArray[np.float32]]] = []

    def step(self, row: int, picture: Bytes | None) -> None:
        """Follow the points into the next grey picture [H, W] of number `row`; across None nothing is."""
        if picture is None or self._before is None:
            self._points, self._number = self._points[:0], self._number[:0]
        elif len(self._points):
            ahead, found = _flow(self._before, picture, self._points[:, None])
            back, again = _flow(picture, self._before, ahead)
            good = (found[:, 0] > 0) & (again[:, 0] > 0)
            good &= np.linalg.norm(back[:, 0] - self._points, axis=1) < _RETURN_PX
            size = np.array([picture.shape[1], picture.shape[0]])
            good &= ((ahead[:, 0] > _EDGE_PX) & (ahead[:, 0] < size - _EDGE_PX)).all(axis=1)
            self._points, self._number = ahead[good, 0], self._number[good]
        if picture is not None and len(self._points) < _FEWEST:
            mask = np.zeros(picture.shape, np.uint8)
            mask[_EDGE_PX:-_EDGE_PX, _EDGE_PX:-_EDGE_PX] = 255
            for x, y in np.round(self._points).astype(int).tolist():
                cv2.circle(mask, (x, y), _APART_PX, 0, -1)
            corners = cv2.goodFeaturesToTrack(
                picture, _MOST - len(self._points), _QUALITY, _APART_PX, mask=mask
            )
            if corners is not None:
                fresh = np.asarray(corners[:, 0], np.float32)
                self._points = np.concatenate([self._points, fresh])
                self._number = np.concatenate([self._number, self._count + np.arange(len(fresh))])
                self._count += len(fresh)
        if picture is not None:
            self._found.append((row, self._number, self._points))
        self._before = picture

    def tracks(self) -> Tracks:
        """Return all sightings so far; their pictures are the rows."""
        if not self._found:
            return Tracks(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
        rows, numbers, places = zip(*self._found, strict=True)
        return Tracks(
            np.repeat(np.array(rows, np.int64), [len(own) for own in numbers]),
            np.concatenate(numbers),
            np.concatenate(places).astype(np.float64),
        )


def follow(pictures: Iterable[Bytes | None]) -> Tracks:
    """Follow points through all pictures of one camera; see `Follower.step`."""
    follower = Follower()
    for row, picture in enumerate(pictures):
        follower.step(row, picture)
    return follower.tracks()


def _flow(before: Bytes, after: Bytes, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Find points [N, 1, 2] of one picture in the other; also return found [N, 1], 0 or 1."""
    window = (_WINDOW_PX, _WINDOW_PX)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, np.empty_like(points), winSize=window, maxLevel=_LEVELS
    )
    return np.asarray(there), np.asarray(found)
