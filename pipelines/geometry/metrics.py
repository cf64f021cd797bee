"""Errors of a skeleton against the truth, and measures of its plausibility without truth.

Positions are [T, P, J, 3] in metres, NaN is missing; stamps [T] strictly increase. A joint-frame is one joint
of one person at one time, a person-frame one person at one time. Means run over joint-frames. ValueError:
shapes disagree, or stamps do not increase.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Index, Int64, best_pairs

Series = tuple[Float, Float]
"""Sums [T] and weights [T] of a figure at every moment or trial: the figure is the ratio of their totals."""

# The benchmark MPI-INF-3DHP counts joints within 150 mm (3DPCK).
PCK_THRESHOLD_M = 0.15
# A step longer than this many median steps is a gap in time: no acceleration or jerk is taken across it.
_GAP_STEPS = 3
# Median absolute deviation to standard deviation, for a normal distribution.
_SIGMA_PER_MAD = 1.4826
# World errors are computed in segments of so many samples, as in SLAHMR (Ye et al., CVPR 2023).
_SEGMENT_SAMPLES = 100
# People without a common time are matched last, and a wild joint counts no more than this.
_NEVER_TOGETHER_M, _LARGEST_ERROR_M = 1e6, 1e3
# A foot whose true speed is lower stands: 10 mm in a frame of 30 Hz (WHAM).
_STANDING_M_S = 0.3
# Foot sliding is stated in millimetres for each picture of a 30 Hz film (WHAM).
_FIELD_RATE_HZ = 30.0

WORLD_ERRORS = ("w_mpjpe_mm", "wa_mpjpe_mm", "rte_percent", "jitter", "foot_sliding_mm", "shifted_mpjpe_mm")
"""The errors of `world_errors`."""


ERRORS = (
    *("joint_frames", "reconstructed_share", "mpjpe_mm", "root_mpjpe_mm", "pa_mpjpe_mm", "e_recon_m2"),
    *("e_recon_terms", "e_recon_per_joint_frame_m2", "pck150", "pck150_auc", "acceleration_error_mm_s2"),
)
"""The errors of a set of joints against the truth; NaN where nothing could be measured.

`reconstructed_share` is that of the `joint_frames` with truth; `mpjpe_mm` the mean distance, `root_` after
both skeletons are moved to their root (without the root itself), `pa_` after a similarity per person-frame
(Procrustes); `e_recon_m2` the sum of `e_recon_terms` squared distances; `pck150` the share within 150 mm,
missing joints are wrong, `pck150_auc` its mean over thresholds from 0; `acceleration_error_mm_s2` the mean
length of the difference, over three consecutive samples.
"""


def measure(estimate: Float, truth: Float, joints: Sequence[str], t_ns: Int64) -> dict[str, object]:
    """Compute every error of an estimate against the truth, over all joints and per joint, as JSON.

    The root is `hip`, or the middle of `left_hip` and `right_hip`. The result has the `ERRORS`
    (null for what could not be measured), `root_frames_left_out` (person-frames with common joints but
    without a root on both sides), `pa_frames_left_out` (those with fewer than 3 common joints, or on a line)
    and `per_joint`.
    """
    distances = _distances(estimate, truth, joints, t_ns)
    shared = np.isfinite(distances.absolute).any(axis=-1)
    rooted = np.isfinite(_root(estimate, joints) - _root(truth, joints)).all(axis=-1)
    aligned = np.isfinite(distances.aligned).any(axis=-1)
    return {
        **distances.errors(slice(None)),
        "root_frames_left_out": int((shared & ~rooted).sum()),
        "pa_frames_left_out": int((shared & ~aligned).sum()),
        "per_joint": {name: distances.errors(slice(j, j + 1)) for j, name in enumerate(joints)},
    }


def world_errors(
    estimate: Float, truth: Float, joints: Sequence[str], t_ns: Int64
) -> dict[str, float | None]:
    """Compute the errors in the world by their names in the field (Shin et al., WHAM, CVPR 2024).

    `w_mpjpe_mm` and `wa_mpjpe_mm`: MPJPE in segments of 100 samples after the similarity of their first two
    samples, and of the whole segment; `rte_percent`: distance of the roots after one rigid motion, over the
    length of their true way; `jitter`: mean third derivative of the estimate, 10 m/s^3; `foot_sliding_mm`:
    motion of standing feet in 1/30 s; `shifted_mpjpe_mm`: MPJPE after one shift of the whole flight. None if
    unknown.
    """
    _check_shapes(estimate, truth, joints, t_ns)
    by_first: list[Float] = [np.empty(0)]
    by_all: list[Float] = [np.empty(0)]
    rooted: list[Float] = [np.empty(0)]
    path_m = 0.0
    for own, true in zip(np.moveaxis(estimate, 1, 0), np.moveaxis(truth, 1, 0), strict=True):
        there = np.flatnonzero(np.isfinite(own - true).all(axis=-1).any(axis=-1))
        for start in range(0, len(there), _SEGMENT_SAMPLES):
            rows = there[start : start + _SEGMENT_SAMPLES]
            by_first.append(_aligned_as(own[rows], true[rows], 2).ravel())
            by_all.append(_aligned_as(own[rows], true[rows], len(rows)).ravel())
        # A straight way leaves its roll open: the motion is that of all joints.
        rigid = align_each(own[there].reshape(-1, 3), true[there].reshape(-1, 3), with_scale=False)
        root, true_root = (_root(each[there, None], joints)[:, 0] for each in (own, true))
        rooted.append(_length(rigid.apply(root) - true_root))
        path_m += float(np.nansum(_length(np.diff(true_root, axis=0))))
    feet = [index for index, name in enumerate(joints) if name.endswith(("ankle", "heel", "big_toe"))]
    speed = _length(_derivative(estimate[:, :, feet], t_ns, 1))
    stands = _length(_derivative(truth[:, :, feet], t_ns, 1)) < _STANDING_M_S
    apart = estimate - truth
    shift = np.array([_mean(apart[..., axis]) for axis in range(3)])
    found = {
        "w_mpjpe_mm": 1e3 * _mean(np.concatenate(by_first)),
        "wa_mpjpe_mm": 1e3 * _mean(np.concatenate(by_all)),
        "rte_percent": 100 * _mean(np.concatenate(rooted)) / path_m if path_m > 0 else math.nan,
        "jitter": _mean(_length(_derivative(estimate, t_ns, 3))) / 10,
        "foot_sliding_mm": 1e3 * _mean(speed[stands]) / _FIELD_RATE_HZ,
        "shifted_mpjpe_mm": 1e3 * _mean(_length(apart - shift)),
    }
    return _jsonable(found)


def _aligned_as(own: Float, true: Float, samples: int) -> Float:
    """Compute distances [T, J] in m after the similarity of the first samples of one person [T, J, 3]."""
    first = align_each(own[:samples].reshape(-1, 3), true[:samples].reshape(-1, 3), with_scale=True)
    return _length(first.apply(own.reshape(-1, 3)).reshape(own.shape) - true)


def error_series(
    estimate: Float, truth: Float, joints: Sequence[str], t_ns: Int64
) -> tuple[dict[str, Series], Iterator[dict[str, Series]]]:
    """Compute the errors of `measure` at each time, over all joints, and of each joint as it is asked for."""
    distances = _distances(estimate, truth, joints, t_ns)
    return distances.series(slice(None)), (distances.series(slice(j, j + 1)) for j in range(len(joints)))


def root_relative_distances(estimate: Float, truth: Float, joints: Sequence[str]) -> Float:
    """Compute root-relative distances [T, P, J] of joints in m; NaN without a root, and for `hip` itself."""
    root_error = _root(estimate, joints) - _root(truth, joints)
    distances = _length(estimate - truth - root_error[:, :, None])
    if "hip" in joints:
        distances[:, :, joints.index("hip")] = np.nan
    return distances


def aligned_distances(estimate: Float, truth: Float) -> Float:
    """Compute distances [T, P, J] in m after a similarity per person-frame; NaN where it is undetermined."""
    return _length(align_each(estimate, truth, with_scale=True).apply(estimate) - truth)


def common(*estimates: Float) -> Bool:
    """Mark the joint-frames [T, P, J] that every estimate [T, P, J, 3] has, where methods may be compared."""
    return np.asarray(np.isfinite(np.stack(estimates)).all(axis=(0, -1)))


# --- without truth -------------------------------------------------------------------------------------


def bone_lengths(position: Float, joints: Sequence[str], bones: Sequence[tuple[str, str]]) -> Float:
    """Compute lengths [T, P, B] m of bones, NaN where an end is missing; ValueError: an unknown joint."""
    unknown = sorted({end for bone in bones for end in bone} - set(joints))
    if unknown:
        raise ValueError(f"bones end at {', '.join(unknown)}, which the skeleton does not have")
    starts, ends = ([joints.index(bone[end]) for bone in bones] for end in (0, 1))
    return _length(position[:, :, ends] - position[:, :, starts])


def measure_shape(
    position: Float, joints: Sequence[str], bones: Sequence[tuple[str, str]], t_ns: Int64
) -> dict[str, object]:
    """Measure the plausibility of a skeleton without truth: constant bone lengths, symmetry, smoothness.

    `bones`: name ("left_hip-left_knee") to `median_mm`, `spread_mm` (1.4826 times the median absolute
    deviation from the person's own median) and `frames`; `bone_spread_mm`: the median of those spreads;
    `asymmetry_mm`: bone without its side to the distance between the left and right medians, mean over
    people; `jerk_m_s3`: the median length of the third derivative. ValueError, too, if a joint of a bone is
    missing.
    """
    _check_shapes(position, position, joints, t_ns)
    lengths = bone_lengths(position, joints, bones) * 1e3
    own_median = np.array([[_median(bone) for bone in person.T] for person in np.moveaxis(lengths, 1, 0)])
    deviation = np.abs(lengths - own_median)
    names = [f"{start}-{end}" for start, end in bones]
    summary = {
        name: {
            "median_mm": _median(lengths[:, :, index]),
            "spread_mm": _SIGMA_PER_MAD * _median(deviation[:, :, index]),
            "frames": int(np.isfinite(lengths[:, :, index]).sum()),
        }
        for index, name in enumerate(names)
    }
    return {
        "bones": {name: _jsonable(bone) for name, bone in summary.items()},
        "bone_spread_mm": _number(_median(np.array([bone["spread_mm"] for bone in summary.values()]))),
        "asymmetry_mm": {
            names[left].replace("left_", ""): _number(
                _mean(np.abs(own_median[:, left] - own_median[:, right]))
            )
            for left, right in _mirrored(bones)
        },
        "jerk_m_s3": _number(_median(_length(_derivative(position, t_ns, 3)))),
    }


def _mirrored(bones: Sequence[tuple[str, str]]) -> list[tuple[int, int]]:
    """Find the indices of the left and right bone of every pair; bones that cross the middle have none."""
    index_of = {frozenset(bone): index for index, bone in enumerate(bones)}
    pairs = []
    for index, bone in enumerate(bones):
        mirror = frozenset(end.replace("left_", "right_") for end in bone)
        if mirror in index_of and index_of[mirror] != index and not any("right_" in end for end in bone):
            pairs.append((index, index_of[mirror]))
    return pairs


# --- shared steps --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Distances:
    """Distances between estimate and truth in m (and m/s^2), [T, P, J], NaN where one is missing."""

    has_truth: Bool
    absolute: Float
    root: Float
    aligned: Float
    acceleration: Float  # [T - 2, P, J]

    def errors(self, joints: slice) -> dict[str, float | None]:
        """Compute `ERRORS`, JSON-able."""
        totals = {name: (sums.sum(), weights.sum()) for name, (sums, weights) in self.series(joints).items()}
        terms, judged = totals["reconstructed_share"]
        found = {name: total / weight if weight else math.nan for name, (total, weight) in totals.items()}
        found["e_recon_m2"] = found["e_recon_m2"] if terms else math.nan
        found |= {"joint_frames": int(judged), "e_recon_terms": int(terms)}
        return _jsonable({name: found[name] for name in ERRORS})

    def series(self, joints: slice) -> dict[str, Series]:
        """Compute the same errors at each time; an acceleration is at the middle of its three samples."""
        absolute = self.absolute[:, :, joints]
        present = np.isfinite(absolute)
        judged = self.has_truth[:, :, joints].sum(axis=(1, 2), dtype=np.float64)
        count = present.sum(axis=(1, 2), dtype=np.float64)
        distance = np.where(present, absolute, 0.0)
        squared = (distance**2).sum(axis=(1, 2))
        near = np.where(present, np.maximum(0.0, 1 - distance / PCK_THRESHOLD_M), 0.0).sum(axis=(1, 2))
        within = (present & (distance <= PCK_THRESHOLD_M)).sum(axis=(1, 2), dtype=np.float64)
        acceleration = np.full((len(absolute), *absolute.shape[1:]), np.nan)
        acceleration[1:-1] = self.acceleration[:, :, joints]
        return {
            "reconstructed_share": (count, judged),
            "mpjpe_mm": _summed(absolute),
            "root_mpjpe_mm": _summed(self.root[:, :, joints]),
            "pa_mpjpe_mm": _summed(self.aligned[:, :, joints]),
            "e_recon_m2": (squared, np.full(len(squared), 1 / max(len(squared), 1))),
            "e_recon_per_joint_frame_m2": (squared, count),
            "pck150": (within, judged),
            "pck150_auc": (near, judged),
            "acceleration_error_mm_s2": _summed(acceleration),
        }


def _distances(estimate: Float, truth: Float, joints: Sequence[str], t_ns: Int64) -> _Distances:
    _check_shapes(estimate, truth, joints, t_ns)
    return _Distances(
        has_truth=common(truth),
        absolute=_length(estimate - truth),
        root=root_relative_distances(estimate, truth, joints),
        aligned=aligned_distances(estimate, truth),
        acceleration=_length(_derivative(estimate - truth, t_ns, 2)),
    )


def _summed(distance_m: Float) -> Series:
    """Compute sums [T] in mm and counts [T] of the finite distances."""
    there = np.isfinite(distance_m)
    return 1e3 * np.where(there, distance_m, 0.0).sum(axis=(1, 2)), there.sum(axis=(1, 2), dtype=np.float64)


def _root(position: Float, joints: Sequence[str]) -> Float:
    """Compute the root [T, P, 3] of every skeleton; NaN where it is missing or there is no hip joint."""
    if "hip" in joints:
        return position[:, :, joints.index("hip")]
    if "left_hip" in joints and "right_hip" in joints:
        return (position[:, :, joints.index("left_hip")] + position[:, :, joints.index("right_hip")]) / 2
    return np.full((*position.shape[:2], 3), np.nan)


def _derivative(position: Float, t_ns: Int64, order: int) -> Float:
    """Compute the derivative [T - order, ...] by divided differences; NaN across gaps."""
    samples = len(t_ns)
    if samples <= order:
        return np.empty((0, *position.shape[1:]))
    derivative = position
    spread = (-1,) + (1,) * (position.ndim - 1)
    for k in range(1, order + 1):
        seconds = (t_ns[k:] - t_ns[:-k]) / 1e9
        derivative = np.diff(derivative, axis=0) * k / seconds.reshape(spread)
    steps = np.diff(t_ns)
    long = steps > _GAP_STEPS * np.median(steps)
    across = np.any([long[k : samples - order + k] for k in range(order)], axis=0)
    return np.where(across.reshape(spread), np.nan, derivative)


def _check_shapes(estimate: Float, truth: Float, joints: Sequence[str], t_ns: Int64) -> None:
    people = truth.shape[1] if truth.ndim == 4 else 1
    expected = (len(t_ns), people, len(joints), 3)
    if estimate.shape != expected or truth.shape != expected:
        raise ValueError(
            f"positions {estimate.shape} and {truth.shape} are not both [T, P, J, 3] = {expected}"
        )
    if (np.diff(t_ns) <= 0).any():
        raise ValueError("stamps must increase strictly")


def _length(vectors: Float) -> Float:
    length: Float = np.linalg.norm(vectors, axis=-1)
    return length


def _mean(values: Float) -> float:
    """Compute the mean of the finite values; NaN if there are none, without a warning."""
    present = values[np.isfinite(values)]
    return float(present.mean()) if present.size else math.nan


def _median(values: Float) -> float:
    present = values[np.isfinite(values)]
    return float(np.median(present)) if present.size else math.nan


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _jsonable(fields: Mapping[str, float]) -> dict[str, float | None]:
    return {name: _number(value) for name, value in fields.items()}


# --- alignment -----------------------------------------------------------------------------------------

# Ratio of the second to the first singular value of the covariance below which the points count as
# collinear: a bend of 0.02 mm over 0.6 m in both sets. Rounding 1 km from the origin stays below it.
_COLLINEAR = 1e-9


@dataclass(frozen=True)
class Alignment:
    """Rigid motion or similarity target_from_source, x -> scale * rotation @ x + translation, one or a batch.

    S. Umeyama, IEEE PAMI 13(4), 1991; equation numbers below are his.
    """

    scale: Float  # [...]
    rotation: Float  # [..., 3, 3], proper
    translation: Float  # [..., 3]

    def apply(self, points: Float) -> Float:
        """Move points [..., J, 3] of the source onto the target."""
        turned = points @ np.swapaxes(self.rotation, -1, -2)
        return self.scale[..., None, None] * turned + self.translation[..., None, :]


def align_each(source: Float, target: Float, *, with_scale: bool) -> Alignment:
    """Align pairs of point sets [..., J, 3] without NaN points; NaN for fewer than 3, or on a line."""
    present = (np.isfinite(source) & np.isfinite(target)).all(axis=-1, keepdims=True)
    count = present.sum(axis=-2)
    divisor = np.maximum(count, 1)
    mean_source = np.where(present, source, 0.0).sum(axis=-2) / divisor  # Eq. 34
    mean_target = np.where(present, target, 0.0).sum(axis=-2) / divisor  # Eq. 35
    from_mean = np.where(present, source - mean_source[..., None, :], 0.0)
    to_mean = np.where(present, target - mean_target[..., None, :], 0.0)
    variance = (from_mean**2).sum(axis=(-2, -1)) / divisor[..., 0]  # Eq. 36
    covariance = np.swapaxes(to_mean, -1, -2) @ from_mean / divisor[..., None]  # Eq. 38
    u, d, vt = np.linalg.svd(covariance)
    # Eqs. 39 and 43 in one: the sign that makes U S V' a rotation, also when the points lie in a plane.
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    s = np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)
    rotation = (u * s[..., None, :]) @ vt  # Eq. 40
    determined = (count[..., 0] >= 3) & (d[..., 1] > _COLLINEAR * d[..., 0])
    if with_scale:
        scale = (d * s).sum(axis=-1) / np.where(variance > 0, variance, 1.0)  # Eq. 42
    else:
        scale = np.ones_like(variance)
    translation = mean_target - scale[..., None] * (rotation @ mean_source[..., None])[..., 0]  # Eq. 41
    return Alignment(
        scale=np.where(determined, scale, np.nan),
        rotation=np.where(determined[..., None, None], rotation, np.nan),
        translation=np.where(determined[..., None], translation, np.nan),
    )


def tracking_errors(position: Float, truth: Float, *, within_m: float = 0.5) -> dict[str, Any]:
    """Count who was found, missed and confused over time, as the field does for several people.

    A reconstructed person is at a true one if the mean difference of their common joints is at most
    `within_m`. At each time a person's last pair stays if it holds, and the others are assigned with the
    least sum of distances (CLEAR MOT: Bernardin and Stiefelhagen 2008). A true person who is paired with
    somebody else than the last time counts as a switch. For IDF1 (Ristani et al. 2016) each reconstructed
    person is paired with one true person for the whole flight. `mota` is 1 - (misses + phantoms + switches) /
    present, of joint times of true people. `by_person` has for each reconstructed person the times as a
    phantom, and the misses and switches of the true one who is theirs in IDF1 (None without one).
    """
    known = np.isfinite(truth[..., 0]).any(axis=(1, 2))
    position, truth = position[known], truth[known]
    offset = position[:, :, None] - truth[:, None]
    both: Bool = np.isfinite(offset[..., 0])
    mean = np.where(both[..., None], offset, 0.0).sum(axis=3) / np.maximum(both.sum(axis=3), 1)[..., None]
    distance: Float = np.where(both.sum(axis=3) > 0, np.linalg.norm(mean, axis=-1), np.inf)
    distance[distance > within_m] = np.inf
    phantom, missed = (np.isfinite(own[..., 0]).any(axis=2).sum(axis=0) for own in (position, truth))
    found, total = int(phantom.sum()), int(missed.sum())
    last: dict[int, int] = {}
    switched = np.zeros(truth.shape[1], np.int64)
    for near in distance:
        pairs: dict[int, int] = {}
        for q, p in sorted(last.items()):
            if near[p, q] < np.inf and p not in pairs.values():
                pairs[q] = p
        free = near.copy()
        free[list(pairs.values())] = np.inf
        free[:, list(pairs)] = np.inf
        cost = np.where(free < np.inf, free, 1e6)
        for p, q in np.transpose(best_pairs(-cost)).tolist():
            if free[p, q] < np.inf:
                pairs[q] = p
                switched[q] += last.get(q, p) != p
        last |= pairs
        missed[list(pairs)] -= 1
        phantom[list(pairs.values())] -= 1
    at = (distance < np.inf).sum(axis=0)
    theirs = best_pairs(at)
    same = int(at[theirs].sum())
    true_one = {p: q for p, q in np.transpose(theirs).tolist() if at[p, q]}
    misses, phantoms, switches = int(missed.sum()), int(phantom.sum()), int(switched.sum())
    return {
        "within_m": within_m,
        "present": total,
        "misses": misses,
        "phantoms": phantoms,
        "switches": switches,
        "mota": 1 - (misses + phantoms + switches) / total if total else np.nan,
        "idf1": 2 * same / (total + found) if total else np.nan,
        "by_person": [
            {
                "phantoms": int(phantom[p]),
                "misses": int(missed[true_one[p]]) if p in true_one else None,
                "switches": int(switched[true_one[p]]) if p in true_one else None,
            }
            for p in range(position.shape[1])
        ],
    }


# --- confidence intervals ----------------------------------------------------------------------------------

# Trials are independent: the interval of their mean is Student's, which holds for few of them, too. In a
# flight neighbours correlate: the flight is treated as a circle, and stretches of a fixed length are drawn
# from it (circular block bootstrap, Politis & Romano 1992). The interval holds the middle 95 % of the means
# of many draws. Errors that are the same throughout are not in it: it is valid for this flight alone.

# Papers of the field state intervals of 95 %.
LEVEL = 0.95
STRETCH_S = 5.0
"""Length of a stretch: the longest time over which the figures of a flight correlate.

Errors of detectors and white pose errors decorrelate within two steps of a walk, 2 s; tilt, occlusion and
drifting pose errors follow the actor's path, past an obstacle or around a turn, for up to 5 s. Too short a
stretch makes the interval too narrow. Too long a one makes only its ends less certain.
"""

RESAMPLES = 2000
"""Draws; the ends of an interval scatter by 4 % of half its width."""

# An interval of `LEVEL` leaves 2.5 % of the draws on either side.
_TAIL_PERCENT = 2.5
# Draws from fewer stretches repeat each other, and the interval would be too narrow.
_MIN_STRETCHES = 5
# Fewer samples or trials do not tell how a figure scatters.
_MIN_SAMPLES, _MIN_TRIALS = 10, 2


def matched(position: Float, others: Float) -> tuple[Index, Index]:
    """Match people of [T, P, J, 3] and [T, Q, J, 3], nearest on average and each once: rows of both."""
    distance = _length(position[:, :, None] - others[:, None])
    shared = np.isfinite(distance)
    count = shared.sum(axis=(0, 3))
    total = np.where(shared, np.minimum(distance, _LARGEST_ERROR_M), 0.0).sum(axis=(0, 3))
    return best_pairs(-np.where(count > 0, total / np.maximum(count, 1), _NEVER_TOGETHER_M))


def own_truth(position: Float, truth: Float) -> Float:
    """Return the truth of each person [T, P, J, 3], the nearest true one (`matched`); NaN without one."""
    own: Float = np.full(position.shape, np.nan)
    person, match = matched(position, truth)
    own[:, person] = truth[:, match]
    return own


def stretch_samples(t_ns: Int64) -> int:
    """Return the samples of a stretch: `STRETCH_S`, at most a fifth of the flight, and at least one."""
    step_s = float(np.median(np.diff(t_ns))) / 1e9
    return max(min(round(STRETCH_S / step_s), len(t_ns) // _MIN_STRETCHES), 1)


def intervals(
    series: Mapping[str, Series], t_ns: Int64 | None, *, seed: int = 0
) -> dict[str, tuple[float, float] | None]:
    """Compute the interval of every figure, of a flight with the same draws for all of them.

    `series` are [T] each, without NaN; `t_ns` is None for independent trials. None with fewer than ten
    samples or two trials, or if a draw has no data for the figure.
    """
    if t_ns is None:
        return {name: _of_trials(*each) for name, each in series.items()}
    return {name: interval_of(values) for name, values in resampled(series, t_ns, seed=seed).items()}


def _of_trials(sums: Float, weights: Float) -> tuple[float, float] | None:
    """Compute Student's interval of a ratio of totals over trials [K], to first order; None for one."""
    if len(sums) < _MIN_TRIALS or not weights.sum() > 0:
        return None
    from scipy.special import stdtrit

    ratio = float(sums.sum() / weights.sum())
    error = float((sums - ratio * weights).std(ddof=1) / weights.mean() / math.sqrt(len(sums)))
    reach = float(stdtrit(len(sums) - 1, 0.5 + LEVEL / 2)) * error
    return ratio - reach, ratio + reach


def resampled(series: Mapping[str, Series], t_ns: Int64, *, seed: int = 0) -> dict[str, Float]:
    """Compute every figure of every draw of a flight, [RESAMPLES], as for `intervals`; NaN without data."""
    count = len(next(iter(series.values()))[0]) if series else 0
    if count < _MIN_SAMPLES:
        return {name: np.full(RESAMPLES, np.nan) for name in series}
    length = stretch_samples(t_ns)
    first = np.random.default_rng([seed, count]).integers(count, size=(RESAMPLES, math.ceil(count / length)))
    found = {}
    for name, (sums, weights) in series.items():
        total, weight = (_of_stretches(values, length)[first].sum(axis=1) for values in (sums, weights))
        there = weight > 0
        found[name] = np.where(there, total / np.where(there, weight, 1.0), np.nan)
    return found


def interval_of(values: Float) -> tuple[float, float] | None:
    """Return the middle 95 % of a figure's draws; None if any of them has no data for it."""
    if not np.isfinite(values).all():
        return None
    low, high = np.percentile(values, [_TAIL_PERCENT, 100 - _TAIL_PERCENT])
    return float(low), float(high)


def _of_stretches(values: Float, length: int) -> Float:
    """Sum [T] the stretch that begins at each sample; stretches wrap around the end."""
    if length == 1:
        return values
    total = np.concatenate([[0.0], np.cumsum(np.concatenate([values, values[: length - 1]]))])
    return np.asarray(total[length:] - total[:-length], dtype=np.float64)
