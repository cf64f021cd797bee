"""Checks of keypoints that came with the flight: what cannot be pixels of this picture, or of its time."""

import re
from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Intrinsics
from pipelines.session.errors import DataError
from pipelines.session.records import Detections
from pipelines.sources.parts import CameraFrames

# A share of a picture's sides. Detectors search the box of a person; most of them pad it to 1.25 of its size.
# If the box is as large as the picture, it then reaches an eighth beyond it: no detector looked further.
_MAX_EXTRAPOLATION = 1 / 8
# Coordinates in shares of the picture stay below this; a person in pixels is larger in every picture.
_MAX_SHARE = 2.0
# Beyond a few extrapolated joints, negative shares mean that 0 is the middle of the picture.
_MAX_NEGATIVE_SHARE = 0.05
# People do not stand still to the last digit of 3 joints for this long, so the detector repeats itself.
_MAX_REPEAT_S = 0.3
# Where nearly all detections repeat, nothing in the file moves: they may be right, and are kept.
_MAX_REPEATED_SHARE = 0.9


def without_zeros(detections: Detections) -> Detections:
    """Take joints at exactly (0, 0) or (-1, -1) as missing, as many programs write them; count them."""
    for number in (0, -1):
        same: Bool = np.asarray((detections.xy == number).all(axis=-1))
        if same.any():
            lost = {f"joints at exactly {number}, {number}, taken as missing": int(same.sum())}
            detections = _without(same, detections, lost)
    return detections


def in_pixels(detections: Detections, intrinsics: Intrinsics, source: str) -> Detections:
    """Turn shares of the picture (0 to 1) into pixels, adjusted; DataError: from the picture's middle."""
    known = detections.xy[np.isfinite(detections.xy)]
    if not len(known) or np.abs(known).max() > _MAX_SHARE:
        return detections
    if (known < 0).mean() > _MAX_NEGATIVE_SHARE:
        problem = (
            f"has keypoints from {known.min():.3g} to {known.max():.3g}, which are no pixels: they seem to"
            " count from the middle of the picture, in halves of its sides or of its width"
        )
        remedy = "write them in pixels from the top left"
        raise DataError(source, problem, remedy, code="keypoints-normalised")
    xy = detections.xy * [intrinsics.width, intrinsics.height] - 0.5
    number = int(np.isfinite(xy[..., 0]).sum())
    adjusted = {"keypoints from shares of the picture (0 to 1) to pixels": number}
    return replace(detections, xy=xy, adjusted=detections.adjusted | adjusted)


def without_repeats(detections: Detections, frames: CameraFrames) -> tuple[Detections, list[str]]:
    """Drop detections of three joints or more that a tracker holds for over 0.3 s; note each stretch."""
    order = np.lexsort((detections.frame, detections.person))
    xy, person = detections.xy[order], detections.person[order]
    t_ns = frames.t_ns[np.searchsorted(frames.frame, detections.frame[order])]
    same = ((xy[1:] == xy[:-1]) | np.isnan(xy[1:]) & np.isnan(xy[:-1])).all(axis=(1, 2))
    same &= (person[1:] == person[:-1]) & (np.isfinite(xy[1:]).all(axis=-1).sum(axis=-1) >= 3)
    edges = np.flatnonzero(np.diff(same, prepend=False, append=False))
    held = np.zeros(len(order), np.bool_)
    stretches = []
    for first, end in edges.reshape(-1, 2):  # rows first + 1 to end repeat row first
        if t_ns[end] - t_ns[first] > _MAX_REPEAT_S * 1e9:
            held[first + 1 : end + 1] = True
            stretches.append((int(detections.frame[order[first]]), int(detections.frame[order[end]])))
    if not held.any() or held.mean() > _MAX_REPEATED_SHARE:
        return detections, []
    notes = [f"repeats its keypoints in pictures {first} to {last}" for first, last in sorted(stretches)]
    rows = np.sort(order[~held])
    lost = {"repeated detections": int(held.sum())}
    return _chosen(rows, detections, lost), notes


def doubt_numbers(detections: Detections, frames: CameraFrames, *, from_video: bool) -> str | None:
    """Return a doubt if keypoints seem to be numbered from 1; None without one."""
    first, last = int(detections.frames_listed[0]), int(detections.frames_listed[-1])
    if from_video and first >= 1 and last == int(frames.frame[-1]) + 1:
        return (
            f"its keypoints are numbered up to {last}, its pictures up to {frames.frame[-1]}: the"
            " keypoints count from 1, so write `first_frame: 1` in `keypoints`"
        )
    if first == 1:
        return (
            "its keypoints begin with 1: if this is the first picture, write `first_frame: 1` in `keypoints`"
        )
    return None


def unmirrored(detections: Detections, mirrored: bool | str, intrinsics: Intrinsics) -> Detections:
    """Undo mirrored pictures: True; "x" alone counts from the right, "y" from below; "names" swap."""
    xy, confidence, joints = detections.xy.copy(), detections.confidence, detections.joints
    if mirrored in (True, "x"):
        xy[..., 0] = intrinsics.width - 1 - xy[..., 0]
    if mirrored == "y":
        xy[..., 1] = intrinsics.height - 1 - xy[..., 1]
    if mirrored in (True, "names"):
        sides = {"left_": "right_", "right_": "left_"}
        others = [re.sub("^(left|right)_", lambda side: sides[side[0]], name) for name in joints]
        order = [joints.index(other) if other in joints else k for k, other in enumerate(others)]
        xy, confidence = xy[:, order], confidence[:, order]
    return replace(detections, xy=xy, confidence=confidence)


def near_picture(detections: Detections, intrinsics: Intrinsics) -> Detections:
    """Drop and count keypoints further outside the picture than a detector may extrapolate."""
    size = np.array([intrinsics.width, intrinsics.height])
    margin = _MAX_EXTRAPOLATION * size
    with np.errstate(invalid="ignore"):
        beyond = (detections.xy < -0.5 - margin) | (detections.xy > size - 0.5 + margin)
    far: Bool = np.asarray(beyond.any(axis=-1))
    if not far.any():
        return detections
    return _without(far, detections, {"keypoints far outside the picture": int(far.sum())})


def within(detections: Detections, frames: CameraFrames) -> Detections:
    """Keep the detections in frames that have a time; count the others."""
    known = np.isin(detections.frame, frames.frame)
    if known.all():
        return detections
    lost = {"detections in frames without a time": int((~known).sum())}
    return _chosen(np.flatnonzero(known), detections, lost)


def _without(joints: Bool, detections: Detections, lost: dict[str, int]) -> Detections:
    """Take joints [M, J] as not found, and drop people of whom nothing is left."""
    xy = np.where(joints[..., None], np.nan, detections.xy)
    confidence = np.where(joints, 0.0, detections.confidence)
    seen = np.isfinite(xy).any(axis=(1, 2))
    if not seen.all():
        lost = lost | {"people without a joint that is left": int((~seen).sum())}
    return _chosen(np.flatnonzero(seen), replace(detections, xy=xy, confidence=confidence), lost)


def _chosen(rows: NDArray[np.intp], detections: Detections, lost: dict[str, int]) -> Detections:
    return replace(
        detections,
        frame=detections.frame[rows],
        person=detections.person[rows],
        xy=detections.xy[rows],
        confidence=detections.confidence[rows],
        dropped=dict(Counter(detections.dropped) + Counter(lost)),
    )
