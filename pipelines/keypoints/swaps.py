"""Left and right taken for each other, found by how joints move in one camera.

An exchange makes two joints jump by their distance, there and, when it ends, back. Two hypotheses at each
picture, exchanged or not, are weighed by how well every joint goes on as it moved: Viterbi's shortest path
over the errors of prediction at constant velocity. First for the arms and for the legs, then for the face,
which goes with them where both were exchanged, then for each pair of joints. Which of
the two sides is the right one is the majority's word: an exchange in most pictures cannot be seen here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.compilation import cached
from pipelines.session.records import Detections, Float, Int64
from pipelines.session.skeletons import mirrored

Bools = NDArray[np.bool_]
Pair = tuple[int, int]

VISIBLE = 60.0
"""Squared distances of left and right, in variances of a coordinate, whose exchange stands out from noise."""

_LIMBS = {
    "face": ("eye", "ear", "mouth"),
    "arms": ("shoulder", "elbow", "wrist", "pinky", "index", "thumb"),
    "legs": ("hip", "knee", "ankle", "heel", "toe"),
}
_CHANGE = 16.0  # what a change between the hypotheses costs: four standard deviations of one coordinate
_EXCHANGED = 2.0  # what each picture costs in which left and right are exchanged: the majority is right
_JUMP = 45.0  # what each end of an exchange must save against going on unchanged
_CAP = 25.0  # an error of prediction counts up to five standard deviations
_LEAST_NOISE = 0.01  # of the body's size (median distance of joints from their middle), 4 mm
_GAP_S = 0.5  # nothing is predicted over more


def undo_swaps(
    t_s: Float, xy: Float, confidence: Float, joints: Sequence[str]
) -> tuple[Float, Float, dict[str, int]]:
    """Give joints back to the side they belong to.

    Args:
        t_s: [T] seconds, strictly increasing.
        xy: [T, J, 2] one person's joints in one camera, in pixels or normalised; NaN where not seen.
        confidence: [T, J].
        joints: the names of the J joints.

    Returns:
        Positions and confidences with the exchanges undone, and the number of pictures in which there was
        one: of the `arms`, the `legs`, the `face` apart from those, and of a single pair as `knee`.
        What had none is the same to the last bit.
    """
    xy, confidence = xy.copy(), confidence.copy()
    pairs = {name.removeprefix("left_"): pair for name, pair in mirrored_pairs(joints).items()}
    limbs = limb_pairs(joints)
    least_noise = _LEAST_NOISE * _body_size(xy)
    counts: Counter[str] = Counter()

    def undo(name: str, group: Sequence[Pair]) -> Bools:
        exchanged = exchanged_pictures(t_s, xy, group, least_noise=least_noise)
        exchange(xy, exchanged, group)
        exchange(confidence, exchanged, group)
        counts[name] += int(exchanged.sum())
        return exchanged

    both = undo("arms", limbs["arms"]) & undo("legs", limbs["legs"])
    # Eyes and ears are too near each other for their jumps to be seen.
    exchange(xy, both, limbs["face"])
    exchange(confidence, both, limbs["face"])
    undo("face", limbs["face"])
    for name, pair in pairs.items():
        undo(name, [pair])
    return xy, confidence, dict(+counts)


def undo_swaps_of_tracks(found: Detections, frame_t_ns: Int64) -> tuple[Detections, dict[str, int]]:
    """The same for everybody whom one camera followed: detections with one number are one person.

    Args:
        found: of one camera, sorted by frame.
        frame_t_ns: [F] when each of its frames was taken.

    Returns:
        The detections, and the pictures with an exchange by limb, summed over the people.
    """
    xy, confidence = found.xy.copy(), found.confidence.copy()
    total: Counter[str] = Counter()
    for person in np.unique(found.person):
        (rows,) = np.nonzero(found.person == person)
        t_s = (frame_t_ns[found.frame[rows]] - frame_t_ns[0]) / 1e9
        xy[rows], confidence[rows], counts = undo_swaps(t_s, xy[rows], confidence[rows], found.joints)
        total.update(counts)
    return replace(found, xy=xy, confidence=confidence), dict(sorted(total.items()))


def mirrored_pairs(joints: Sequence[str]) -> dict[str, Pair]:
    """The columns of a left joint and of its mirror, by the left one's name."""
    column = {joint: index for index, joint in enumerate(joints)}
    return {
        joint: (index, column[mirrored(joint)])
        for joint, index in column.items()
        if joint.startswith("left_") and mirrored(joint) in column
    }


def limb_pairs(joints: Sequence[str]) -> dict[str, list[Pair]]:
    """The mirrored pairs of the face, the arms and the legs; empty where there are none."""
    pairs = mirrored_pairs(joints)
    return {
        limb: [pair for name, pair in pairs.items() if any(part in name for part in parts)]
        for limb, parts in _LIMBS.items()
    }


def exchange(values: Float, where: Bools, pairs: Sequence[Pair]) -> None:
    """Exchange, in place, the two columns of each pair in some rows of values [T, J, ...]."""
    for left, right in pairs:
        values[where, left], values[where, right] = values[where, right], values[where, left]


def exchanged_pictures(t_s: Float, xy: Float, pairs: Sequence[Pair], *, least_noise: float) -> Bools:
    """In which pictures [T] some pairs of joints, all together, are more likely exchanged than not."""
    left, right = (xy[:, [pair[side] for pair in pairs]] for side in (0, 1))
    (rows,) = np.nonzero(np.isfinite(left).all(-1).any(-1) | np.isfinite(right).all(-1).any(-1))
    exchanged = np.zeros(len(t_s), dtype=np.bool_)
    if len(rows) < 3:
        return exchanged
    cost, linked, noise = _costs(t_s[rows], left[rows], right[rows], least_noise)
    path = _shortest_path(cost, linked, _CHANGE, _EXCHANGED)
    apart2 = np.nansum(((left - right)[rows] ** 2).sum(-1), axis=-1)
    exchanged[rows] = _with_visible_ends(path, linked, apart2 > VISIBLE * noise**2, cost)
    return exchanged


def _with_visible_ends(path: Bools, linked: Bools, visible: Bools, cost: Float) -> Bools:
    """The runs of a path [R] at whose ends something jumps.

    Where legs cross, either hypothesis may go on: a run is taken for an exchange only where both of its ends
    were seen, the joints far enough apart, and each costs much less than not to change there.
    """
    kept = path.copy()
    edges = np.flatnonzero(np.diff(path, prepend=False, append=False))
    for first, stop in edges.reshape(-1, 2):
        if not all(_jumps(end, path, linked, visible, cost) for end in (first, stop)):
            kept[first:stop] = False
    return kept


def _jumps(end: int, path: Bools, linked: Bools, visible: Bools, cost: Float) -> bool:
    """Whether the change before row `end` was seen as a jump; at the ends of what was seen none was."""
    if not 0 < end < len(path) or not linked[end]:
        return False
    before, now = int(path[end - 1]), int(path[end])
    changed, kept = cost[end, before, before, now], cost[end, before, before, before]
    if end + 1 < len(path) and linked[end + 1]:
        changed += cost[end + 1, before, now, int(path[end + 1])]
        kept += cost[end + 1, before, before, before]
    return bool(visible[end - 1 : end + 1].all() and kept - changed > _JUMP)


def _body_size(xy: Float) -> float:
    """Median distance of joints from the middle of their picture."""
    seen = xy[np.isfinite(xy).all(-1).sum(-1) >= 2]
    if not len(seen):
        return 0.0
    distance = np.linalg.norm(seen - np.nanmean(seen, axis=1, keepdims=True), axis=-1)
    return float(np.nanmedian(distance))


def _costs(t_s: Float, left: Float, right: Float, least_noise: float) -> tuple[Float, Bools, float]:
    """What each row adds to the length of a path.

    Args:
        t_s: [R] seconds.
        left: [R, K, 2] joints that are called left.
        right: [R, K, 2] and those called right.
        least_noise: that positions have at least, in their unit.

    Returns:
        Costs [R, 2, 2, 2] for the hypotheses two rows before, one before, and now: the squared errors of
        prediction in units of their variance, summed over the joints; 0 in the first two rows and behind
        a gap. Then [R] whether a row follows the one before, so that a change of hypothesis has its price;
        and the noise of a coordinate.
    """
    step = np.diff(t_s)
    ratio = step[1:] / step[:-1]
    linked = np.concatenate([[False], step <= _GAP_S])
    predicted = linked & np.concatenate([[False], linked[:-1]])
    # x(t) - x(t-1) - r (x(t-1) - x(t-2)) of positions of equal noise.
    variance = 1.0 + (1.0 + ratio) ** 2 + ratio**2
    sides = np.stack([left, right], axis=1)  # [R, side, K, 2]
    error = np.full((len(t_s), 2, 2, 2, 2, left.shape[1]), np.nan)  # [R, before last, last, now, side, K]
    for states in np.ndindex(2, 2, 2):
        for side in (0, 1):
            oldest, old, now = (sides[i : len(sides) - 2 + i, side ^ state] for i, state in enumerate(states))
            jump = now - old - ratio[:, None, None] * (old - oldest)
            error[(slice(2, None), *states, side)] = (jump**2).sum(-1) / variance[:, None]
    error[~predicted] = np.nan
    usual = error[:, 0, 0, 0]
    usual = usual[np.isfinite(usual)]
    # The median of a chi-squared of two degrees of freedom is 2 ln 2.
    noise2 = max(float(np.median(usual)) / (2 * np.log(2)) if usual.size else 0.0, least_noise**2)
    squares = np.minimum(error / max(noise2, np.finfo(float).tiny), _CAP)
    return np.nansum(squares, axis=(-2, -1)), linked, float(np.sqrt(noise2))


@cached
def _shortest_path(cost: Float, linked: Bools, change: float, exchanged: float) -> Bools:
    """The hypotheses [R] of the shortest path through costs [R, 2, 2, 2] (Viterbi over pairs of rows).

    Of equally short ones that which is longer not exchanged.
    """
    rows = len(cost)
    length = np.empty((2, 2))  # by the hypotheses of the last row and of this one
    came = np.zeros((rows, 2, 2), np.int8)
    for last in range(2):
        for now in range(2):
            length[last, now] = exchanged * (last + now)
            if linked[1] and last != now:
                length[last, now] += change
    for row in range(2, rows):
        longer = np.empty((2, 2))
        for last in range(2):
            for now in range(2):
                price = exchanged * now
                if linked[row] and last != now:
                    price += change
                first = length[0, last] + cost[row, 0, last, now]
                second = length[1, last] + cost[row, 1, last, now]
                came[row, last, now] = 1 if second < first else 0
                longer[last, now] = min(first, second) + price
        length = longer
    best_last, best_now = 0, 0
    for last in range(2):
        for now in range(2):
            if length[last, now] < length[best_last, best_now]:
                best_last, best_now = last, now
    path = np.zeros(rows, np.bool_)
    path[rows - 1] = best_now == 1
    path[rows - 2] = best_last == 1
    for row in range(rows - 1, 1, -1):
        before = came[row, best_last, best_now]
        path[row - 2] = before == 1
        best_now = best_last
        best_last = before
    return path
