"""Segments of a long flight: each is reconstructed on its own, and joined with its neighbours without a seam.

Neighbours overlap. About the middle of the overlap a result goes over from the estimate of the one to that of
the other by a polynomial whose first two derivatives are continuous, so that speeds and accelerations are.
The covariance of such a mean a X + (1 - a) Y, however X and Y are correlated, is a Cov X + (1 - a) Cov Y
less a (1 - a) Cov(X - Y). The last term is not subtracted: it is not known, and small beside the others where
both rest on the same pictures.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.joint_angles import ANGLE_STATUS, ANGLES, joint_angles
from pipelines.geometry.triangulation import STATUS
from pipelines.session.description import Doubt
from pipelines.session.records import POINT_COVARIANCE_COLUMNS
from pipelines.session.tables import Span

if TYPE_CHECKING:
    import pandas as pd

LENGTH_S = 180.0
"""The longest segment without its overlaps; a shorter flight is a single one."""

MOST_KEYPOINTS = 280_000
"""The most keypoints in a segment, times x cameras x joints of a person: memory grows with them."""

SHORTEST_S = 30.0
"""No segment of a flight longer than this is shorter, however many keypoints it has."""

OVERLAP_S = 10.0
"""Time that two neighbours share."""

APART_M = 1.0
"""People of two segments who are further apart at the same times are not the same."""

# Segments are blended over this time about the middle of an overlap, away from the ends of both.
_BLENDED_NS = 6_000_000_000
# Other cameras and clocks need pictures this long before and after the times of a segment.
_AROUND_NS = 2_000_000_000
# Two people seen together at fewer times are not said to be the same.
_FEWEST_TIMES = 10

_XYZ = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class Segment:
    """A stretch of a flight."""

    number: int
    t_ns: Int64  # [T] the skeleton's times, with those that it shares with its neighbours
    own_ns: Span  # first and last time that are not rather its neighbours'

    @property
    def name(self) -> str:
        """A name by which segments sort in time."""
        return f"segment-{self.number:06d}"

    @property
    def span_ns(self) -> Span:
        """First and last time of the pictures that it needs."""
        return int(self.t_ns[0]) - _AROUND_NS, int(self.t_ns[-1]) + _AROUND_NS

    @property
    def own(self) -> slice:
        """Rows of its times that are its own."""
        first, stop = np.searchsorted(self.t_ns, (self.own_ns[0], self.own_ns[1] + 1)).tolist()
        return slice(first, stop)

    def later(self, offset_ns: int) -> Segment:
        """Return the same stretch by another clock."""
        own_ns = self.own_ns[0] + offset_ns, self.own_ns[1] + offset_ns
        return Segment(self.number, self.t_ns + offset_ns, own_ns)


def divided(t_ns: Int64, keypoints: int) -> list[Segment]:
    """Divide the skeleton's times [T] into segments of equal length; a short flight is one.

    Args:
        t_ns: the times.
        keypoints: of a person at one time, in all cameras together.
    """
    if not len(t_ns):
        return []
    lasts_s = float(t_ns[-1] - t_ns[0]) / 1e9
    by_memory = min(len(t_ns) * keypoints / MOST_KEYPOINTS, lasts_s / SHORTEST_S)
    count = int(np.ceil(max(lasts_s / LENGTH_S, by_memory, 1.0)))
    edges = t_ns[0] + np.round(np.linspace(0.0, lasts_s, count + 1) * 1e9).astype(np.int64)
    edges[-1] = t_ns[-1] + 1
    reach_ns = round(0.5e9 * OVERLAP_S)
    found: list[Segment] = []
    for first_ns, stop_ns in pairwise(edges.tolist()):
        begin, end = np.searchsorted(t_ns, (first_ns - reach_ns, stop_ns + reach_ns)).tolist()
        own = np.searchsorted(t_ns, (first_ns, stop_ns))
        if own[0] < own[1]:  # else the flight pauses
            found.append(Segment(len(found), t_ns[begin:end], (first_ns, stop_ns - 1)))
    return found


def sampled(segments: Sequence[Segment], count: int) -> list[Segment]:
    """Choose some segments, spread over the flight."""
    rows = np.unique(np.linspace(0, len(segments) - 1, min(count, len(segments))).round().astype(int))
    return [segments[row] for row in rows.tolist()]


# --- people --------------------------------------------------------------------------------------------


def places(skeleton: pd.DataFrame, within_ns: Span) -> tuple[Int64, Float]:
    """Compute the middle [T, P, 3] of the joints of each person at the times [T] of a span; NaN unseen."""
    own = skeleton[skeleton["t_ns"].between(*within_ns)]
    t_ns, row = np.unique(own["t_ns"].to_numpy(np.int64), return_inverse=True)
    person = own["person"].to_numpy(np.int64)
    people = int(person.max(initial=0)) + 1
    xyz = own[list(_XYZ)].to_numpy(np.float64)
    there = np.isfinite(xyz).all(axis=1)
    total, count = np.zeros((len(t_ns), people, 3)), np.zeros((len(t_ns), people, 1))
    np.add.at(total, (row[there], person[there]), xyz[there])
    np.add.at(count, (row[there], person[there]), 1.0)
    return t_ns, np.where(count > 0, total / np.maximum(count, 1.0), np.nan)


def apart_m(before: tuple[Int64, Float], after: tuple[Int64, Float]) -> Float:
    """Compute the median distance [P, Q] m between people of two segments; NaN if rarely seen together."""
    _, one, other = np.intersect1d(before[0], after[0], return_indices=True)
    distance = np.linalg.norm(before[1][one][:, :, None] - after[1][other][:, None], axis=-1)
    seen = np.isfinite(distance)
    median = np.full(distance.shape[1:], np.nan)
    for p, q in np.ndindex(median.shape):
        if seen[:, p, q].sum() >= _FEWEST_TIMES:
            median[p, q] = np.median(distance[seen[:, p, q], p, q])
    return median


def same_people(distance: Float, logged: int) -> dict[int, int]:
    """Match the people of a segment to those of the segment before: number there by number here.

    Args:
        distance: [P, Q] m, see `apart_m`.
        logged: the first so many are known from their logs.
    """
    from scipy.optimize import linear_sum_assignment

    cost = np.where(distance <= APART_M, distance, 1e3)  # NaN too
    pairs = zip(*(side.tolist() for side in linear_sum_assignment(cost)), strict=True)
    matched = {q: p for p, q in pairs if cost[p, q] <= APART_M and p >= logged and q >= logged}
    return {k: k for k in range(min(logged, distance.shape[1]))} | matched


def numbered(matched: Mapping[int, int], count: int, before: Sequence[int]) -> list[int]:
    """Number the people of a segment over the flight; whoever is new takes the least number that is free.

    Args:
        matched: see `same_people`.
        count: of the people in the segment.
        before: the numbers of those in the segment before.
    """
    known = {q: before[p] for q, p in matched.items() if q < count}
    free = iter(sorted(set(range(count + len(before))) - set(known.values())))
    return [known[q] if q in known else next(free) for q in range(count)]


def rows_of_people(skeleton: pd.DataFrame, number: Sequence[int], people: int, key: str) -> pd.DataFrame:
    """Return the rows of a dense table with `people` people, those of the segment under their numbers.

    Args:
        skeleton: rows sorted by time, person and `key`; every combination has one.
        number: of each person of the segment.
        people: in the flight; those who are not in the segment were not detected.
        key: "joint" or "angle".
    """
    if list(number) == list(range(people)):
        return skeleton
    import pandas as pd

    kinds = len(skeleton) // max(skeleton["t_ns"].nunique() * len(number), 1)
    times = len(skeleton) // (kinds * len(number))
    rows = np.arange(len(skeleton)).reshape(times, len(number), kinds)
    place = np.full((times, people, kinds), -1)
    place[:, list(number)] = rows
    row = place.ravel()
    made = {}
    for name in skeleton.columns:
        values = skeleton[name].to_numpy()[row]
        missing = {"status": "not_detected", "views": 0}.get(str(name), np.nan)
        if name == "t_ns":
            values = np.repeat(skeleton["t_ns"].to_numpy()[:: kinds * len(number)], people * kinds)
        elif name == "person":
            values = np.tile(np.repeat(np.arange(people), kinds), times)
        elif name == key:
            values = np.tile(skeleton[key].to_numpy()[:kinds], times * people)
        else:
            values[row < 0] = missing
        made[name] = values
    return pd.DataFrame(made)


# --- tables --------------------------------------------------------------------------------------------


def joined(
    parts: Iterator[tuple[Segment, pd.DataFrame]], keys: Sequence[str], mean: Mean
) -> Iterator[pd.DataFrame]:
    """Join the tables of segments, and yield the rows of the flight in parts, sorted by time.

    Args:
        parts: segments in order, with their rows; of at most two at once.
        keys: columns that say which rows of two segments are the same, `t_ns` first.
        mean: gives the values between those of two segments.
    """
    held: pd.DataFrame | None = None
    before: Segment | None = None
    for segment, table in parts:
        rest = table
        if held is not None and before is not None:
            seam_ns = segment.own_ns[0]
            begin, end = _together(before, segment) or (seam_ns, seam_ns)
            t_ns = held["t_ns"].to_numpy()
            yield held[t_ns < begin]
            middle = held[(t_ns >= begin) & (t_ns < end)]
            t_ns = table["t_ns"].to_numpy()
            blended = _between(middle, table[(t_ns >= begin) & (t_ns < end)], keys, mean, seam_ns)
            if len(blended):
                yield blended
            rest = table[t_ns >= end]
        held, before = rest, segment
    if held is not None:
        yield held


Mean = Callable[["pd.DataFrame", "pd.DataFrame", Float], "dict[str, Any]"]
"""Function from the same rows of two segments, and the share [N] of the later one, to columns."""


def _together(before: Segment, after: Segment) -> Span | None:
    """Return the first time of the blended stretch and the one after it; None if they share no times."""
    seam_ns = after.own_ns[0]
    first, last = max(int(after.t_ns[0]), int(before.t_ns[0])), min(int(before.t_ns[-1]), int(after.t_ns[-1]))
    if before.own_ns[1] + 1 != seam_ns or first >= last:
        return None
    return max(seam_ns - _BLENDED_NS // 2, first), min(seam_ns + _BLENDED_NS // 2, last + 1)


def shares(t_ns: Int64, seam_ns: int) -> Float:
    """Compute the share [N] of the later one of two segments: 0 before the blended stretch, 1 after it."""
    u = np.clip((t_ns - seam_ns) / _BLENDED_NS + 0.5, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2), dtype=np.float64)


def _between(
    one: pd.DataFrame, other: pd.DataFrame, keys: Sequence[str], mean: Mean, seam_ns: int
) -> pd.DataFrame:
    """Return the rows of the blended stretch; a row that only one segment has stays as it is."""
    import pandas as pd

    columns = list(one.columns)
    if not len(one) and not len(other):
        return one
    left, right = one.set_index(list(keys)), other.set_index(list(keys))
    if not left.index.equals(right.index):
        index = left.index.union(right.index)
        left, right = left.reindex(index), right.reindex(index)
    rows = left.index.to_frame(index=False)
    share = shares(rows["t_ns"].to_numpy(np.int64), seam_ns)
    first = right.columns[0]
    missing = left[first].isna().to_numpy(), right[first].isna().to_numpy()
    share = np.where(missing[0] & ~missing[1], 1.0, np.where(missing[1] & ~missing[0], 0.0, share))
    later = share >= 0.5
    made = {
        str(name): np.where(later, right[name].to_numpy(), left[name].to_numpy()) for name in left.columns
    }
    made |= mean(left, right, share)
    return pd.DataFrame({str(key): rows[key].to_numpy() for key in keys} | made)[columns]


def mean_skeleton(left: pd.DataFrame, right: pd.DataFrame, share: Float) -> dict[str, Any]:
    """Compute positions and covariances between those of two segments."""
    later = {"views": np.where(share >= 0.5, right["views"], left["views"]).astype(np.int64)}
    return later | {name: _linear(left, right, share, name) for name in (*_XYZ, *POINT_COVARIANCE_COLUMNS)}


def mean_angles(left: pd.DataFrame, right: pd.DataFrame, share: Float) -> dict[str, Any]:
    """Compute angles and their standard deviations between those of two segments."""
    one, other = left["value_deg"].to_numpy(), right["value_deg"].to_numpy()
    turned = one + share * ((other - one + 180.0) % 360.0 - 180.0)
    turned = np.where(turned > 180.0, turned - 360.0, np.where(turned <= -180.0, turned + 360.0, turned))
    side = np.where(share >= 0.5, other, one)
    variance = (1 - share) * left["sigma_deg"].to_numpy() ** 2 + share * right["sigma_deg"].to_numpy() ** 2
    of_side = np.where(share >= 0.5, right["sigma_deg"], left["sigma_deg"])
    both = np.isfinite(turned) & np.isfinite(variance) & (share > 0) & (share < 1)
    return {
        "value_deg": np.where(both, turned, side),
        "sigma_deg": np.where(both, np.sqrt(np.maximum(variance, 0.0)), of_side),
    }


def mean_poses(left: pd.DataFrame, right: pd.DataFrame, share: Float) -> dict[str, Any]:
    """Compute poses of cameras between those of two segments."""
    one, other = left[list(_QUATERNION)].to_numpy(), right[list(_QUATERNION)].to_numpy()
    sign = np.where(np.sum(one * other, axis=1) < 0, -1.0, 1.0)[:, None]
    turned = (1 - share[:, None]) * one + share[:, None] * sign * other
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    both = np.isfinite(turned).all(axis=1) & (share > 0) & (share < 1)
    side = np.where((share >= 0.5)[:, None], other, one)
    turned = np.where(both[:, None], turned, side)
    moved = {name: _linear(left, right, share, name) for name in _XYZ}
    return moved | dict(zip(_QUATERNION, turned.T, strict=True))


def _linear(left: pd.DataFrame, right: pd.DataFrame, share: Float, name: str) -> Float:
    """Compute values between two; those of the nearer segment where one has none."""
    one, other = left[name].to_numpy(np.float64), right[name].to_numpy(np.float64)
    both = np.isfinite(one) & np.isfinite(other) & (share > 0) & (share < 1)
    mean = (1 - share) * one + share * other
    return np.where(both, mean, np.where(share >= 0.5, other, one))


# --- figures -------------------------------------------------------------------------------------------

_SUMMED = {
    *(
        "joint_frames",
        "frames",
        "e_recon_m2",
        "e_recon_terms",
        "root_frames_left_out",
        "pa_frames_left_out",
        "times",
    ),
    *(
        "times_with_more",
        "status_counts",
        "detections_not_used",
        "no_people",
        "phantoms",
        "readout",
        "pictures",
    ),
    *("undone_over_time", "between_views", "association", "present", "misses", "switches", "gaps", "filled"),
    *("gaps_without_example", "count", "points", "joint_frames_in_runs_too_short", "frames"),
}
"""Names of figures that count something; whatever stands below such a name is summed as well."""

_LARGEST = {"seen_at_once", "asked", "level", "resamples", "seed", "longest_gap_s", "readout_s"}


def merged(figures: Sequence[Any], weights: Sequence[float], name: str = "", *, summed: bool = False) -> Any:
    """Merge the figures of segments: counts are added, all others are means with these weights.

    A mean of medians is no median, but near it where segments are alike. Texts are those of most segments.
    Lists of as many numbers are merged number by number, others are those of the heaviest segment. The ends
    of an interval of a mean (name "intervals") are moved together as independent parts of a mean allow.
    """
    there = [(value, weight) for value, weight in zip(figures, weights, strict=True) if value is not None]
    if not there:
        return None
    values, shares_of = [value for value, _ in there], np.array([weight for _, weight in there])
    weight = shares_of / shares_of.sum() if shares_of.sum() > 0 else np.full(len(there), 1 / len(there))
    summed = summed or name in _SUMMED
    if all(isinstance(value, Mapping) for value in values):
        keys = list(dict.fromkeys(key for value in values for key in value))
        return {
            key: merged(
                [value.get(key) for value in values],
                shares_of.tolist(),
                "interval"
                if name in ("intervals", "interval of joints") and _is_interval(values, key)
                else key,
                summed=summed,
            )
            if not (name == "intervals" and key == "per_joint")
            else {
                joint: merged(
                    [value[key].get(joint) for value in values if key in value],
                    [w for w, value in zip(shares_of.tolist(), values, strict=True) if key in value],
                    "interval of joints",
                )
                for joint in dict.fromkeys(j for value in values for j in value.get(key, {}))
            }
            for key in keys
        }
    if name == "interval":
        ends = np.array(values, dtype=np.float64)
        middle, half = ends.mean(axis=1), (ends[:, 1] - ends[:, 0]) / 2
        mean, reach = float(weight @ middle), float(np.sqrt(np.sum((weight * half) ** 2)))
        return [mean - reach, mean + reach]
    if all(isinstance(value, bool) for value in values):
        return sum(values) * 2 > len(values)
    if all(isinstance(value, int | float) for value in values):
        if summed:
            return sum(values)
        if name in _LARGEST:
            return max(values)
        return values[0] if len(set(values)) == 1 else float(weight @ np.array(values, dtype=np.float64))
    if all(isinstance(value, list) for value in values):
        return _merged_lists(values, weight, summed=summed)
    return (
        Counter(map(str, values)).most_common(1)[0][0]
        if all(isinstance(v, str) for v in values)
        else values[0]
    )


def _is_interval(values: Sequence[Mapping[str, Any]], key: str) -> bool:
    return any(isinstance(value.get(key), list) and len(value[key]) == 2 for value in values)


def _merged_lists(values: Sequence[list[Any]], weight: Float, *, summed: bool) -> list[Any]:
    numbers = all(isinstance(each, int | float) for value in values for each in value)
    longest = max(values, key=len)
    if numbers and summed:
        return [sum(value[k] for value in values if k < len(value)) for k in range(len(longest))]
    if numbers and len({len(value) for value in values}) == 1:
        mean: list[Any] = (weight @ np.array(values, dtype=np.float64)).tolist() if longest else []
        return mean
    return longest if len(longest) > len(values[int(np.argmax(weight))]) else values[int(np.argmax(weight))]


def figures_of_flight(metrics: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Merge metrics.json of the segments; each counts by its measured joint-frames."""
    weights = [float(each["status_counts"]["ok"]) for each in metrics]
    flight: dict[str, Any] = merged(metrics, weights)
    for figures in (flight, *flight["per_joint"].values()):
        counts = figures["status_counts"]
        figures["reconstructed_share"] = counts["ok"] / max(counts["all"], 1)
        if figures.get("e_recon_terms"):
            figures["e_recon_per_joint_frame_m2"] = figures["e_recon_m2"] / figures["e_recon_terms"]
    if "refinement" in flight:
        used = [each["refinement"] for each in metrics if each["refinement"]["fallback"] is None]
        if used and len(used) < len(metrics):
            flight["refinement"] = merged(used, [1.0] * len(used)) | {"fallback": None}
    used_by = Counter(each["method_used"]["summary"] for each in metrics)
    if len(used_by) > 1:
        summary, count = used_by.most_common(1)[0]
        flight["method_used"]["summary"] = f"{summary} (in {count} of {len(metrics)} segments)"
    return flight


def doubts_of_flight(
    doubts: Sequence[Sequence[Mapping[str, Any]]],
) -> tuple[list[Doubt], list[tuple[Doubt, int, int]]]:
    """Choose the doubts of at least half of the segments, those of most segments first, and list the others.

    Returns:
        The doubts; and those that fewer segments have, with their number and the first of these segments. A
        mistake that begins in the middle of a flight is one of the latter, and so is a false alarm.
    """
    codes = Counter(code for of in doubts for code in {each["code"] for each in of})
    often, seldom = [], []
    for code, count in codes.most_common():
        first, found = next((k, d) for k, of in enumerate(doubts) for d in of if d["code"] == code)
        doubt = Doubt.model_validate(found)
        if 2 * count >= len(doubts):
            often.append(doubt)
        else:
            seldom.append((doubt, count, first))
    return often, seldom


def warnings_of_flight(warnings: Sequence[Sequence[str]]) -> list[str]:
    """List the warnings of segments; those that differ in their numbers alone are one, the first of them."""
    counts: Counter[str] = Counter()
    first: dict[str, str] = {}
    for of in warnings:
        alike = {re.sub(r"[0-9]+(\.[0-9]+)?", "#", line): line for line in reversed(of)}
        counts.update(alike.keys())
        for kind, line in alike.items():
            first.setdefault(kind, line)
    total = len(warnings)
    return [
        line if counts[kind] == total else f"{line} (so, or alike, in {counts[kind]} of {total} segments)"
        for kind, line in first.items()
    ]


def nothing_seen(segment: Segment, joints: tuple[str, ...], people: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Make rows of `tables.SKELETON` and `tables.ANGLES` where too few cameras have pictures."""
    import pandas as pd

    times, status = len(segment.t_ns), STATUS.index("few_views")

    def keys(kind: str, names: Sequence[str]) -> pd.DataFrame:
        return pd.DataFrame(
            {
                "t_ns": np.repeat(segment.t_ns, people * len(names)),
                "person": np.tile(np.repeat(np.arange(people), len(names)), times),
                kind: np.tile(np.array(names, dtype=object), times * people),
            }
        )

    skeleton = keys("joint", joints)
    skeleton[[*_XYZ, *POINT_COVARIANCE_COLUMNS, "reprojection_px"]] = np.nan
    skeleton["views"], skeleton["status"] = 0, STATUS[status]
    shape = (times, people, len(joints))
    found = joint_angles(
        joints, np.full((*shape, 3), np.nan), np.full((*shape, 6), np.nan), np.full(shape, status, np.int8)
    )
    angles = keys("angle", tuple(ANGLES))
    angles["value_deg"], angles["sigma_deg"] = found.value_deg.ravel(), found.sigma_deg.ravel()
    angles["status"] = np.array(ANGLE_STATUS, dtype=object)[found.status.ravel()]
    return skeleton, angles
