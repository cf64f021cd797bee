"""Points that are tracked through the pictures of a video, as a measure of its camera's motion."""

from pathlib import Path

import numpy as np

from pipelines.formats.videos.picture_folder import FolderPictures
from pipelines.formats.videos.video import VideoReader
from pipelines.geometry.arrays import Float, Float32, Int64, Picture
from pipelines.geometry.cameras import Intrinsics, rescaled, undistort
from pipelines.geometry.clocks import Followed

_WIDTH_PX = 320  # width to which pictures are reduced: motion is still visible
_STRETCH_NS = 200_000_000
_CORNERS = 100
_LEAST_CORNERS = 12
_CORNER_QUALITY, _CORNERS_APART_PX = 0.01, 8

_Grey = Picture
_Pixels = Float32  # [C, 1, 2], OpenCV's layout


def followed_points(path: Path, intrinsics: Intrinsics, pts_ns: Int64) -> Followed:
    """Find corners in the first pictures, and track each for a fifth of a second.

    Tracking is from picture to picture, with pyramids (Lucas and Kanade 1981; Bouguet 2000). A stretch that
    misses a picture, or loses all but a few corners, is dropped. `pts_ns` [F] are the strictly increasing
    stamps of the pictures to use, from the first on.
    """
    begins: list[Float] = []
    ends: list[Float] = []
    spans: list[tuple[int, int]] = []
    with FolderPictures(path) if path.is_dir() else VideoReader(path) as reader:
        before: _Grey | None = None
        first = last = 0
        begin = end = np.zeros((0, 1, 2), np.float32)
        for number, picture in reader.frames(0, len(pts_ns)):
            grey = _small_grey(picture)
            if before is not None and number == last + 1:
                begin, end = _followed(before, grey, begin, end)
            else:
                begin, end = begin[:0], end[:0]
            if len(end) < _LEAST_CORNERS or pts_ns[number] - pts_ns[first] >= _STRETCH_NS:
                if len(end) >= _LEAST_CORNERS:
                    small = rescaled(intrinsics, grey.shape[1], grey.shape[0])
                    begins.append(undistort(begin[:, 0].astype(np.float64), small))
                    ends.append(undistort(end[:, 0].astype(np.float64), small))
                    spans.append((first, number))
                first, begin = number, _corners(grey)
                end = begin
            before, last = grey, number
    return _joined(pts_ns, spans, begins, ends)


def _small_grey(picture: _Grey) -> _Grey:
    import cv2

    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    height, width = grey.shape
    if width > _WIDTH_PX:
        grey = cv2.resize(grey, (_WIDTH_PX, round(height * _WIDTH_PX / width)), interpolation=cv2.INTER_AREA)
    return np.asarray(grey, np.uint8)


def _corners(grey: _Grey) -> _Pixels:
    import cv2

    found = cv2.goodFeaturesToTrack(grey, _CORNERS, _CORNER_QUALITY, _CORNERS_APART_PX)
    return np.zeros((0, 1, 2), np.float32) if found is None else np.asarray(found, np.float32)


def _followed(before: _Grey, after: _Grey, begin: _Pixels, here: _Pixels) -> tuple[_Pixels, _Pixels]:
    """Return the first positions of corners and those one picture later, without the lost ones."""
    import cv2

    if not len(here):
        return begin, here
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, here, np.zeros_like(here))
    follows = found[:, 0] == 1
    return begin[follows], np.asarray(there[follows], np.float32)


def _joined(pts_ns: Int64, spans: list[tuple[int, int]], begins: list[Float], ends: list[Float]) -> Followed:
    nothing = np.zeros((0, 2))
    begin, end = np.concatenate([nothing, *begins]), np.concatenate([nothing, *ends])
    stretch = np.repeat(np.arange(len(begins)), [len(points) for points in begins])
    known = np.isfinite(begin).all(axis=1) & np.isfinite(end).all(axis=1)  # a lens may not cover all pixels
    pictures = np.array(spans, np.int64).reshape(-1, 2)
    return Followed(pts_ns[pictures[:, 0]], pts_ns[pictures[:, 1]], stretch[known], begin[known], end[known])
