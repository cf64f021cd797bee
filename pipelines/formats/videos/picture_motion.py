"""How a camera turned from picture to picture, by what moves through the pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.videos.video import VideoReader
from pipelines.geometry.cameras import Intrinsics, rescaled, undistort
from pipelines.session.records import Float

_WIDTH_PX = 320  # pictures are made so wide: turning shows as well
_CORNERS = 200
_LEAST_CORNERS = 12
_CORNER_QUALITY, _CORNERS_APART_PX = 0.01, 8
_ROUNDS = 10
_LEAST_SCATTER = 1e-4  # of normalised coordinates: what following a corner errs by at the least


def turning_of_pictures(path: Path, intrinsics: Intrinsics, frames: int) -> Float:
    """The camera's rotation from each of the first pictures to the next, about its own axes.

    Corners are followed with pyramids (Lucas and Kanade 1981; Bouguet 2000); of their flow the part that a
    rotation makes is fitted, with little weight to what moves otherwise (the person, what is near).

    Args:
        path: the video.
        intrinsics: of its pictures.
        frames: how many pictures.

    Returns:
        [frames - 1, 3] rad; NaN where a picture is missing or shows too few corners.

    Raises:
        DataError: the video cannot be read.
    """
    turned = np.full((max(frames - 1, 0), 3), np.nan)
    with VideoReader(path) as reader:
        before: NDArray[np.uint8] | None = None
        last = -2
        small: Intrinsics | None = None
        for number, picture in reader.frames(0, frames):
            grey = _small_grey(picture)
            small = small or rescaled(intrinsics, grey.shape[1], grey.shape[0])
            if before is not None and number == last + 1:
                turned[last] = _rotation(before, grey, small)
            before, last = grey, number
    return turned


def _small_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    import cv2

    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    height, width = grey.shape
    if width > _WIDTH_PX:
        grey = cv2.resize(grey, (_WIDTH_PX, round(height * _WIDTH_PX / width)), interpolation=cv2.INTER_AREA)
    return np.asarray(grey, np.uint8)


def _rotation(before: NDArray[np.uint8], after: NDArray[np.uint8], lens: Intrinsics) -> Float:
    import cv2

    nothing = np.full(3, np.nan)
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _CORNER_QUALITY, _CORNERS_APART_PX)
    if corners is None or len(corners) < _LEAST_CORNERS:
        return nothing
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.zeros_like(corners))
    follows = found[:, 0] == 1
    begin = undistort(corners[follows, 0].astype(np.float64), lens)
    end = undistort(there[follows, 0].astype(np.float64), lens)
    known = np.isfinite(begin).all(axis=1) & np.isfinite(end).all(axis=1)
    if known.sum() < _LEAST_CORNERS:
        return nothing
    return rotation_of_flow(begin[known], end[known])


def rotation_of_flow(begin: Float, end: Float) -> Float:
    """The camera's rotation [3] rad that best moves points of the picture, most of them far away.

    Longuet-Higgins and Prazdny 1980, eq. 2.13 without translation, at the middle of each path: right to the
    second order of the angle. Weights are Cauchy's, on the scatter of the residuals.

    Args:
        begin: [P, 2] normalised coordinates.
        end: [P, 2] of the same points, one picture later.
    """
    x, y = ((begin + end) / 2).T
    one = np.ones_like(x)
    of_x = np.stack([x * y, -(one + x**2), y], axis=1)
    of_y = np.stack([one + y**2, -x * y, -x], axis=1)
    lines = np.stack([of_x, of_y], axis=1)  # [P, 2, 3]
    flow = end - begin
    weight = np.ones(len(x))
    rotation = np.zeros(3)
    for _ in range(_ROUNDS):
        normal = np.einsum("p,pij,pik->jk", weight, lines, lines)
        rotation = np.linalg.solve(normal, np.einsum("p,pij,pi->j", weight, lines, flow))
        residual = np.linalg.norm(flow - lines @ rotation, axis=1)
        scatter = max(float(np.median(residual)), _LEAST_SCATTER)
        weight = 1 / (1 + (residual / scatter) ** 2)
    return rotation
