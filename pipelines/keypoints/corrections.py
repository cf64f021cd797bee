"""Corrections of keypoints: confidences become probabilities, and left and right are exchanged back.

In one camera an exchange makes two joints jump by their distance, and jump back when it ends. Each picture
has two hypotheses, exchanged or not, weighed by how well every joint continues its motion: Viterbi's shortest
path over the errors of prediction at constant velocity. First for the arms and for the legs, then for the
face, which goes with them where both were exchanged, then for hands, feet and each other pair of joints. The
majority decides which side is right: an exchange in most pictures cannot be detected here.

Exchanges often begin or end where legs cross in the picture. Nothing jumps there, and detectors place joints
that hide each other badly. Crossings are therefore no evidence: a jump at one end is needed, and the nearer
one of the crossings before and behind it is the other end.

Across cameras, at one time: if the viewing rays of a limb's joints do not meet, exchanging left and right in
one or two cameras can make them meet. All sets of one or two cameras are tried, first for each limb, then for
each pair of joints.
"""

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.compilation import cached
from pipelines.keypoints.bodies import meeting_points, rays_of
from pipelines.session.people import mirrored
from pipelines.session.records import Detections

Pair = tuple[int, int]

VISIBLE = 60.0
"""Squared left-right distance, in variances of a coordinate, above which an exchange is visible in noise."""

_LIMBS = {
    "face": ("eye", "ear", "mouth"),
    "arms": ("shoulder", "elbow", "wrist", "pinky", "index", "thumb"),
    "legs": ("hip", "knee", "ankle", "heel", "toe"),
}
_PARTS = {"hand": ("wrist", "pinky", "index", "thumb"), "foot": ("ankle", "heel", "toe")}
# A change between the hypotheses costs four standard deviations of one coordinate.
_CHANGE_COST = 16.0
# Detectors change most where joints cross, so a change costs less there.
_HIDDEN_CHANGE_COST = 4.0
# Each exchanged picture costs this, because the majority is right.
_EXCHANGED_COST = 2.0
# Each end of an exchange must save this against continuing unchanged.
_JUMP_GAIN = 45.0
# Limbs accelerate, so larger errors of prediction count by their logarithm.
_TAIL_VARIANCES = 16.0
# Keypoints err by this share of the body's size at least, 4 mm.
_MIN_NOISE_SHARE = 0.01
# Walkers' legs cross every half second, so an exchange with one visible end is shorter.
_MAX_EXCHANGE_S = 0.3
# Nothing is predicted over longer gaps: over 0.4 s legs that crossed were exchanged, sample 34 -> 52 mm.
_MAX_GAP_S = 0.2
# Pictures with a smaller share of the usual pairs are decided by the pictures beside them.
_MIN_PAIRS_SHARE = 0.6
# Left and right nearer to each other than this share of the body's size are crossing.
_CROSSING_SHARE = 0.3


def undo_swaps(
    t_s: Float, xy: Float, confidence: Float, joints: Sequence[str]
) -> tuple[Float, Float, dict[str, int]]:
    """Undo exchanges of left and right of one person's joints [T, J, 2] in one camera, NaN where not seen.

    Positions are pixels or normalised. Returns positions, confidences [T, J] and the number of pictures with
    an exchange: of the `arms`, the `legs`, the `face` apart from those, of a `hand` or a `foot`, and of a
    single pair as `knee`. Values without an exchange are the same to the last bit.
    """
    xy, confidence = xy.copy(), confidence.copy()
    pairs = {name.removeprefix("left_"): pair for name, pair in mirrored_pairs(joints).items()}
    limbs = limb_pairs(joints)
    size = _body_size(xy)
    counts: Counter[str] = Counter()

    def undo(name: str, group: Sequence[Pair]) -> Bool:
        exchanged = exchanged_pictures(t_s, xy, group, size=size)
        exchange(xy, exchanged, group)
        exchange(confidence, exchanged, group)
        counts[name] += int(exchanged.sum())
        return exchanged

    both = undo("arms", limbs["arms"]) & undo("legs", limbs["legs"])
    # Eyes and ears are too near each other for their jumps to be seen.
    exchange(xy, both, limbs["face"])
    exchange(confidence, both, limbs["face"])
    undo("face", limbs["face"])
    for name, group in _parts(pairs).items():
        undo(name, group)
    return xy, confidence, dict(+counts)


def undo_swaps_of_tracks(found: Detections, frame_t_ns: Int64) -> tuple[Detections, dict[str, int]]:
    """Undo exchanges for all whom one camera followed; return detections, and pictures by exchanged limb."""
    xy, confidence = found.xy.copy(), found.confidence.copy()
    total: Counter[str] = Counter()
    for person in np.unique(found.person):
        (rows,) = np.nonzero(found.person == person)
        t_s = (frame_t_ns[found.frame[rows]] - frame_t_ns[0]) / 1e9
        xy[rows], confidence[rows], counts = undo_swaps(t_s, xy[rows], confidence[rows], found.joints)
        total.update(counts)
    return replace(found, xy=xy, confidence=confidence), dict(sorted(total.items()))


def mirrored_pairs(joints: Sequence[str]) -> dict[str, Pair]:
    """Return the columns of each left joint and of its mirror, by the left one's name."""
    column = {joint: index for index, joint in enumerate(joints)}
    return {
        joint: (index, column[mirrored(joint)])
        for joint, index in column.items()
        if joint.startswith("left_") and mirrored(joint) in column
    }


def limb_pairs(joints: Sequence[str]) -> dict[str, list[Pair]]:
    """Return the mirrored pairs of the face, the arms and the legs; empty lists where there are none."""
    pairs = mirrored_pairs(joints)
    return {
        limb: [pair for name, pair in pairs.items() if any(part in name for part in parts)]
        for limb, parts in _LIMBS.items()
    }


def _parts(pairs: Mapping[str, Pair]) -> dict[str, list[Pair]]:
    """Group the pairs that detectors exchange together within a limb; every other pair stands alone."""
    groups = {
        part: [name for name in pairs if any(own in name for own in names)] for part, names in _PARTS.items()
    }
    grouped = {part: names for part, names in groups.items() if len(names) > 1}
    alone = [name for name in pairs if not any(name in names for names in grouped.values())]
    return {name: [pairs[name]] for name in alone} | {
        part: [pairs[name] for name in names] for part, names in grouped.items()
    }


def exchange(values: Float, where: Bool, pairs: Sequence[Pair]) -> None:
    """Exchange, in place, the two columns of each pair in some rows of values [T, J, ...]."""
    for left, right in pairs:
        values[where, left], values[where, right] = values[where, right], values[where, left]


def exchanged_pictures(t_s: Float, xy: Float, pairs: Sequence[Pair], *, size: float) -> Bool:
    """Find the pictures [T] in which pairs of joints, all together, are more likely exchanged than not."""
    left, right = (xy[:, [pair[side] for pair in pairs]] for side in (0, 1))
    seen = (np.isfinite(left) & np.isfinite(right)).all(-1).sum(-1)
    # In a picture with few of the joints the others would jump unseen: nothing predicts them in the next one.
    usual = np.median(seen[seen > 0]) if seen.any() else 0.0
    (rows,) = np.nonzero((seen > 0) & (seen >= _MIN_PAIRS_SHARE * usual))
    exchanged = np.zeros(len(t_s), dtype=np.bool_)
    if len(rows) < 3:
        return exchanged
    t_s, left, right = t_s[rows], left[rows], right[rows]
    cost, linked, noise = _costs(t_s, left, right, _MIN_NOISE_SHARE * size)
    distance2 = ((left - right) ** 2).sum(-1)
    least2 = (_CROSSING_SHARE * size) ** 2
    # Neither hypothesis may gain by a prediction from or of a pair that is crossing.
    apart = distance2 > least2
    predictable = apart & np.roll(apart, 1, axis=0) & np.roll(apart, 2, axis=0)
    undecided = cost.min(axis=(1, 2, 3), keepdims=True)
    total = np.where(predictable[:, None, None, None], cost, undecided).sum(-1)
    together2 = np.nansum(distance2, axis=-1)
    visible = together2 > np.maximum(least2 * np.isfinite(distance2).sum(-1), VISIBLE * noise**2)
    crossing = ~(visible & np.roll(visible, 1))
    change = np.where(linked, np.where(crossing, _HIDDEN_CHANGE_COST, _CHANGE_COST), 0.0)
    path = _shortest_path(total, change, _EXCHANGED_COST)
    kept = _with_visible_ends(t_s, path, linked, crossing, total)
    exchanged[rows] = kept
    for first, stop, both in zip(rows[:-1], rows[1:], kept[:-1] & kept[1:] & linked[1:], strict=True):
        exchanged[first:stop] |= both
    return exchanged


def _with_visible_ends(t_s: Float, path: Bool, linked: Bool, crossing: Bool, cost: Float) -> Bool:
    """Keep the runs of a path [R] that begin and end with a jump, and short ones with one visible end."""
    kept = path.copy()
    edges = np.flatnonzero(np.diff(path, prepend=False, append=False))
    for first, stop in edges.reshape(-1, 2):
        ends = (first, stop)
        visible = [0 < end < len(path) and linked[end] and not crossing[end] for end in ends]
        jumps = [seen and _jumps(end, path, linked, cost) for end, seen in zip(ends, visible, strict=True)]
        short = t_s[stop - 1] - t_s[first] < _MAX_EXCHANGE_S
        if not (all(jumps) or (any(jumps) and jumps == visible and short)):
            kept[first:stop] = False
    return kept


def _jumps(end: int, path: Bool, linked: Bool, cost: Float) -> bool:
    """Test if the change before row `end`, where it is visible, is a jump."""
    before, now = int(path[end - 1]), int(path[end])
    changed, kept = cost[end, before, before, now], cost[end, before, before, before]
    if end + 1 < len(path) and linked[end + 1]:
        changed += cost[end + 1, before, now, int(path[end + 1])]
        kept += cost[end + 1, before, before, before]
    return bool(kept - changed > _JUMP_GAIN)


def _body_size(xy: Float) -> float:
    """Compute the median distance of joints from their mean in each picture."""
    seen = xy[np.isfinite(xy).all(-1).sum(-1) >= 2]
    if not len(seen):
        return 0.0
    distance = np.linalg.norm(seen - np.nanmean(seen, axis=1, keepdims=True), axis=-1)
    return float(np.nanmedian(distance))


def _costs(t_s: Float, left: Float, right: Float, least_noise: float) -> tuple[Float, Bool, float]:
    """Compute the cost that each row adds to the length of a path."""
    step = np.diff(t_s)
    ratio = step[1:] / step[:-1]
    linked = np.concatenate([[False], step <= _MAX_GAP_S])
    predicted = linked & np.concatenate([[False], linked[:-1]])
    # x(t) - x(t-1) - r (x(t-1) - x(t-2)) of positions of equal noise.
    variance = 1.0 + (1.0 + ratio) ** 2 + ratio**2
    sides = np.stack([left, right], axis=1)  # [R, side, K, 2]

    def errors(states: Sequence[int]) -> Float:
        found = np.full((len(t_s), 2, left.shape[1]), np.nan)  # [R, side, K]
        for side in (0, 1):
            oldest, old, now = (sides[i : len(sides) - 2 + i, side ^ state] for i, state in enumerate(states))
            jump = now - old - ratio[:, None, None] * (old - oldest)
            found[2:, side] = (jump**2).sum(-1) / variance[:, None]
        found[~predicted] = np.nan
        return found

    usual = errors((0, 0, 0))
    usual = usual[np.isfinite(usual)]
    # The median of a chi-squared of two degrees of freedom is 2 ln 2.
    noise2 = max(float(np.median(usual)) / (2 * np.log(2)) if usual.size else 0.0, least_noise**2)
    tail = _TAIL_VARIANCES * max(noise2, np.finfo(float).tiny)
    cost = np.empty((len(t_s), 2, 2, 2, left.shape[1]))  # [R, before last, last, now, K]
    for states in np.ndindex(2, 2, 2):
        cost[(slice(None), *states)] = np.nansum(_TAIL_VARIANCES * np.log1p(errors(states) / tail), axis=1)
    return cost, linked, float(np.sqrt(noise2))


@cached
def _shortest_path(cost: Float, change: Float, exchanged: float) -> Bool:
    """Find the hypotheses [R] of the shortest path through costs [R, 2, 2, 2] (Viterbi)."""
    rows = len(cost)
    length = np.empty((2, 2))  # by the hypotheses of the last row and of this one
    came = np.zeros((rows, 2, 2), np.int8)
    for last in range(2):
        for now in range(2):
            length[last, now] = exchanged * (last + now)
            if last != now:
                length[last, now] += change[1]
    for row in range(2, rows):
        longer = np.empty((2, 2))
        for last in range(2):
            for now in range(2):
                price = exchanged * now
                if last != now:
                    price += change[row]
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


# At most this many cameras are tried as wrong at once.
_MAX_WRONG_CAMERAS = 2
# An exchange must save this many variances of squared misses.
_MIN_GAIN = 16.0
_BAD, _GOOD = 5.0, 4.0  # mean squared miss of the rays of one camera before and after it; 2 is expected
# The rays of this many times are in memory together.
_BLOCK = 4096
# A single ray counts up to five standard deviations.
_MAX_MISS = 25.0


def swaps_across_views(
    xy: Float, position: Float, rotation: Float, sigma: Float, joints: Sequence[str]
) -> tuple[Int64, dict[str, int]]:
    """Find the side of each joint where the rays of the other cameras meet.

    If an exchange in exactly half of the cameras (one of two) mends it, the right half is unknown: the limb
    is dropped from all cameras at that time. `xy` [T, J, C, 2] are one person's joints, undistorted and
    normalised, NaN not seen; poses are world_from_camera [T, C, 3] m, NaN without one, and [T, C, 3, 3];
    `sigma` [T, C] rad is the deviation of a ray on each axis, of pixels and poses together.

    Returns the joint [T, J, C] whose view belongs to each joint: its own number, its mirror's if the two are
    exchanged, -1 if it is dropped; and the numbers of joint views `undone` and `dropped`.
    """
    xy, sides = xy.copy(), np.tile(np.arange(xy.shape[1])[:, None], (len(xy), 1, xy.shape[2]))
    counts: Counter[str] = Counter()
    limbs = [pairs for pairs in limb_pairs(joints).values() if len(pairs) > 1]
    for group in [*limbs, *([pair] for pair in mirrored_pairs(joints).values())]:
        parts = [
            _wrong_views(
                xy[rows][:, np.ravel(group)], position[rows], rotation[rows], sigma[rows], len(group)
            )
            for rows in (slice(k, k + _BLOCK) for k in range(0, max(len(xy), 1), _BLOCK))
        ]
        flipped, undecided = (np.concatenate(each) for each in zip(*parts, strict=True))
        for left, right in group:
            for values in (xy, sides):
                a, b = values[:, left], values[:, right]
                a[flipped], b[flipped] = b[flipped], a[flipped]
            for side in (left, right):
                counts["undone"] += int((flipped & np.isfinite(xy[:, side, :, 0])).sum())
                counts["dropped"] += int((undecided[:, None] & np.isfinite(xy[:, side, :, 0])).sum())
                xy[undecided, side] = np.nan
                sides[undecided, side] = -1
    return sides, dict(+counts)


def _wrong_views(xy: Float, position: Float, rotation: Float, sigma: Float, pairs: int) -> tuple[Bool, Bool]:
    """Find in which views a limb [T, 2 K, C, 2] (left, right, ...) is exchanged [T, C], or undecided [T]."""
    times, _, cameras, _ = xy.shape
    flipped, undecided = np.zeros((times, cameras), np.bool_), np.zeros(times, np.bool_)
    rays = np.moveaxis(rays_of(np.moveaxis(xy, 2, 1), rotation), 1, 2).reshape(times, pairs, 2, cameras, 3)
    posed = np.asarray(np.isfinite(position).all(-1))[:, None, None]
    seen: Bool = np.asarray(np.isfinite(rays).all(-1)) & posed
    both = np.asarray(np.all(seen, axis=2))
    whole = np.asarray(np.any(both, axis=1))  # [T, C] cameras that see both sides of some pair
    misses = _misses(rays, seen, position, sigma)
    worst = np.max([_mean(misses[..., camera]) for camera in range(cameras)], axis=0)
    (rows,) = np.nonzero((np.sum(whole, axis=1) >= 2) & (worst > _BAD))
    if not len(rows):
        return flipped, undecided
    rays, seen, whole = rays[rows], seen[rows], whole[rows]
    position, sigma = position[rows], sigma[rows]
    views = np.sum(whole, axis=1)
    apart2 = np.nansum((xy[rows, ::2] - xy[rows, 1::2]) ** 2, axis=(1, 3)) / sigma**2
    whole &= apart2 > VISIBLE
    before = _capped(misses[rows])
    least = before - _MIN_GAIN
    best = np.zeros((len(rows), cameras), np.bool_)
    for count in range(1, _MAX_WRONG_CAMERAS + 1):
        for chosen in combinations(range(cameras), count):
            own = list(chosen)
            allowed = whole[:, own].all(1) & (2 * count <= views)
            other, there = rays.copy(), seen.copy()
            other[..., own, :] = rays[:, :, ::-1, own]
            there[..., own] = seen[:, :, ::-1, own]
            tried = _misses(other, there, position, sigma)
            after = _capped(tried) + _MIN_GAIN * (count - 1)
            better = allowed & (after < least) & (_mean(tried[..., own]) < _GOOD)
            least = np.where(better, after, least)
            best[better] = np.isin(np.arange(cameras), own)
    half = 2 * best.sum(1) == views
    flipped[rows] = best & ~half[:, None]
    undecided[rows] = half & best.any(1)
    return flipped, undecided


def _misses(rays: Float, seen: Bool, position: Float, sigma: Float) -> Float:
    """Compute squared distances [T, K, 2, C] of rays from their common point, in variances; NaN if unseen."""
    weight = np.where(seen, 1 / sigma[:, None, None] ** 2, 0.0)
    rays = np.where(seen[..., None], rays, 0.0)
    origin = np.broadcast_to(np.nan_to_num(position)[:, None, None], rays.shape)
    points, _ = meeting_points(rays, origin, weight)
    sight = points[..., None, :] - origin
    depth = (rays * sight).sum(axis=-1)
    offset2 = ((sight - depth[..., None] * rays) ** 2).sum(axis=-1)
    variance = (np.maximum(depth, 1e-6) * sigma[:, None, None]) ** 2
    return np.where(seen & np.isfinite(points[..., :1]), offset2 / variance, np.nan)


def _mean(misses: Float) -> Float:
    """Compute the mean [T] of the finite values; 0 if there are none."""
    axes = tuple(range(1, misses.ndim))
    count = np.isfinite(misses).sum(axis=axes)
    mean: Float = np.nansum(misses, axis=axes) / np.maximum(count, 1)
    return mean


def _capped(misses: Float) -> Float:
    total: Float = np.nansum(np.minimum(misses, _MAX_MISS), axis=(1, 2, 3))
    return total


# --- confidences -----------------------------------------------------------------------------------------

_MEASURED = Path(__file__).parent / "data"
COLUMNS = ("joints", "confidence", "probability", "count")
ANY_JOINT = "*"


@dataclass(frozen=True)
class Calibration:
    """Maps from confidence to probability, by group of joints.

    Each was fitted on keypoints whose error is known (rendered flights) by isotonic regression (Zadrozny and
    Elkan, "Transforming Classifier Scores into Accurate Multiclass Probability Estimates", 2002);
    `tools/detector_errors.py` measures it; the table begins with its command and what a good joint is.
    `knots` are, for each group, [K, 3] confidence (rising), probability (not falling) and count of keypoints.
    A group is a part of joints' names (`wrist`); `*` is for those of no group.
    """

    knots: Mapping[str, Float]

    def probability(self, confidence: Float, joints: Sequence[str]) -> Float:
        """Map confidences [..., J] to probabilities, linear between knots; NaN and 0 stay."""
        calibrated = np.empty(confidence.shape)
        for column, joint in enumerate(joints):
            knots = self.knots[group_of(joint, self.knots)]
            values = np.interp(confidence[..., column], knots[:, 0], knots[:, 1])
            calibrated[..., column] = np.where(confidence[..., column] == 0, 0.0, values)
        return np.where(np.isnan(confidence), np.nan, calibrated)

    def probabilities(self, confidence: Float, joint: NDArray[np.str_]) -> Float:
        """Map confidences of keypoints [N] in any order, each with the name of its joint."""
        calibrated = np.empty(len(confidence))
        for name in np.unique(joint):
            rows = joint == name
            calibrated[rows] = self.probability(confidence[rows, None], [str(name)])[:, 0]
        return calibrated


def measured_for(detector: str) -> Path | None:
    """Return the path of a detector's calibration, None if its confidences were not measured."""
    path = file_of(detector)
    return path if path.is_file() else None


def file_of(detector: str) -> Path:
    """Return the path at which a detector's calibration is stored."""
    return _MEASURED / f"{detector}_confidence.csv"


def group_of(joint: str, groups: Mapping[str, object]) -> str:
    """Return the group of a joint: the longest group name that its name contains, else `*`."""
    return max((group for group in groups if group in joint), key=len, default=ANY_JOINT)


def read_calibration(path: Path) -> Calibration:
    """Read a table of this package."""
    _, _, _, *lines = path.read_text(encoding="utf-8").splitlines()
    table: dict[str, list[list[float]]] = {}
    for group, *numbers in csv.reader(lines):
        table.setdefault(group, []).append([float(number) for number in numbers])
    knots = {group: np.array(own) for group, own in table.items()}
    return Calibration(knots)
