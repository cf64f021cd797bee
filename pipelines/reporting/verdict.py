"""Judgement of a session in plain sentences: quality, certainty and doubts."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.reporting.content import SessionContent, items, number, section, text
from pipelines.reporting.summary import Summary, camera_errors, finite_median
from pipelines.reporting.wording import (
    STATUS_LABELS,
    STATUS_REASONS,
    STATUS_REMEDIES,
    joint_label,
    listing,
    percent,
    plural,
    quantity,
    whole,
)
from pipelines.session.description import Doubt

# Thigh and shank are these parts of the stature by Drillis and Contini (1966): Winter, Biomechanics and Motor
# Control of Human Movement, 4th edition, figure 4.1.
LEG_OF_STATURE = 0.245 + 0.246
# Few adults are smaller or taller.
USUAL_STATURE_M = (1.4, 2.05)
# Walking people keep the trunk more upright than this.
USUAL_TRUNK_DEG = 30.0
# The lower foot of walking people rises and falls by less than this.
USUAL_RISE_OF_FEET_M = 0.2
# Running people are slower than this.
USUAL_SPEED_MPS = 8.0
# Speeds over half a second average out the swing of the hips.
SPEED_SPAN_NS = 500_000_000
# Below this share of measured times a joint is named among the doubts.
DOUBTFUL_COVERAGE = 0.8
# A status is named among the doubts from this share of joint-frames on.
NOTABLE_LOSS = 0.01
# A camera is named among the doubts when its reprojection error is this many times the usual one.
ODD_CAMERA = 2.0
# Measured joints further from truth than this are named among the doubts, however few.
LARGE_ERROR_MM = 300.0
# Root-relative error below this part of the absolute one: the cameras' poses carry most of the error.
MOSTLY_SHARED = 0.6


@dataclass(frozen=True)
class Verdict:
    """First words of the page."""

    lead: str
    quality: tuple[str, ...] = ()
    certainty: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Glance:
    """A figure of the body that a person can judge, with the usual range of people."""

    label: str
    value: str
    usual: str
    odd: bool  # outside the usual range


def at_a_glance(summary: Summary) -> list[Glance]:
    """Compare the first person with people: stature, trunk, feet and speed; what is not known is left out."""
    if summary.motion is None or not summary.motion.measured.any():
        return []
    glances = []
    legs = {(bone.name, bone.side): bone.median_m for bone in summary.bones}
    whole_legs = [
        legs["thigh", side] + legs["shank", side]
        for side in ("left", "right")
        if ("thigh", side) in legs and ("shank", side) in legs
    ]
    if whole_legs:
        stature = float(np.mean(whole_legs)) / LEG_OF_STATURE
        usual = f"roughly, from thigh and shank; adults {USUAL_STATURE_M[0]} to {USUAL_STATURE_M[1]} m"
        is_odd = not USUAL_STATURE_M[0] <= stature <= USUAL_STATURE_M[1]
        glances.append(Glance("Height", quantity(stature, "m", 2), usual, is_odd))
    position, joints = summary.motion.measured_position[:, 0], summary.motion.joints
    hips, shoulders = (_middle(position, joints, kind) for kind in ("hip", "shoulder"))
    trunk = shoulders - hips
    tilt = np.degrees(np.arctan2(np.linalg.norm(trunk[:, :2], axis=1), trunk[:, 2]))
    if (middle := finite_median(tilt)) is not None:
        usual = f"of the trunk from upright; walking people up to {USUAL_TRUNK_DEG:.0f}°"
        glances.append(Glance("Upright", quantity(middle, "°"), usual, middle > USUAL_TRUNK_DEG))
    feet = [
        j for j, name in enumerate(joints) if name.endswith(("_ankle", "_heel", "_big_toe", "_foot_index"))
    ]
    lowest = np.where(np.isnan(position[:, feet, 2]), np.inf, position[:, feet, 2]).min(
        axis=1, initial=np.inf
    )
    if (spread := _rise_of_feet(summary.motion.t_ns, lowest)) is not None:
        usual = f"rise and fall of the lower foot; walking people up to {100 * USUAL_RISE_OF_FEET_M:.0f} cm"
        glances.append(
            Glance("Feet on the ground", quantity(100 * spread, "cm"), usual, spread > USUAL_RISE_OF_FEET_M)
        )
    speed = _speeds(summary.motion.t_ns, hips)
    if len(speed):
        fast = float(np.percentile(speed, 95))
        value = f"{quantity(float(np.median(speed)), 'm/s')}, up to {quantity(fast, 'm/s')}"
        usual = f"median and 95 % of the time; running people up to {USUAL_SPEED_MPS:.0f} m/s"
        glances.append(Glance("Speed", value, usual, fast > USUAL_SPEED_MPS))
    return glances


def _middle(position: Float, joints: tuple[str, ...], kind: str) -> Float:
    """Return the middle [T, 3] of a left and a right joint; NaN where either is missing."""
    pair = [joints.index(f"{side}_{kind}") for side in ("left", "right") if f"{side}_{kind}" in joints]
    return position[:, pair].mean(axis=1) if len(pair) == 2 else np.full((len(position), 3), np.nan)


def _rise_of_feet(t_ns: Int64, lowest: Float) -> float | None:
    """Measure how far the lower foot is from its median over two seconds: 10th to 90th percentile, m."""
    known = np.isfinite(lowest)
    if not known.any():
        return None
    t_ns, lowest = t_ns[known], lowest[known]
    around = np.stack([np.searchsorted(t_ns, t_ns - 10**9), np.searchsorted(t_ns, t_ns + 10**9)], axis=1)
    some = range(0, len(t_ns), max(1, len(t_ns) // 2000))
    above = [lowest[k] - np.median(lowest[slice(*around[k])]) for k in some]
    low, high = np.percentile(above, [10, 90])
    return float(high - low)


def _speeds(t_ns: Int64, hips: Float) -> Float:
    """Compute horizontal speeds of the hips over half a second, m/s, where they are known."""
    after = np.searchsorted(t_ns, t_ns + SPEED_SPAN_NS)
    start = np.flatnonzero(after < len(t_ns))
    span_ns = t_ns[after[start]] - t_ns[start]
    moved = np.linalg.norm((hips[after[start]] - hips[start])[:, :2], axis=1)
    usable = np.isfinite(moved) & (span_ns < 2 * SPEED_SPAN_NS)
    speeds: Float = moved[usable] / (span_ns[usable] / 1e9)
    return speeds


def give_verdict(content: SessionContent, summary: Summary) -> Verdict:
    """Judge quality, certainty and doubts, in sentences that state their numbers."""
    if content.skeleton is None:
        lead = "This session was ingested, but not reconstructed yet: run mocap reconstruct on it."
        return Verdict(_doubted(summary) + lead, doubts=tuple(_doubts(content, summary)))
    if summary.motion is None or summary.nothing_measured:
        return Verdict(_doubted(summary) + _why_nothing(summary), doubts=tuple(_doubts(content, summary)))
    return Verdict(
        _lead(summary),
        quality=tuple(_quality(summary)),
        certainty=tuple(_certainty(summary)),
        doubts=tuple(_doubts(content, summary)),
    )


def _why_nothing(summary: Summary) -> str:
    if not summary.counts:
        return "Nothing was reconstructed: the skeleton has no rows."
    word, count = max(summary.counts.items(), key=lambda item: item[1])
    reason = STATUS_REASONS.get(word, STATUS_LABELS[word])
    where = "In all of them" if count == summary.total else f"In {percent(count / summary.total)} of them"
    return (
        f"Nothing was reconstructed: none of {plural(summary.total, 'joint-frame')} passed. "
        f"{where} {reason} ({word}). {STATUS_REMEDIES.get(word, '')}".rstrip()
    )


def _lead(summary: Summary) -> str:
    share = summary.share or 0.0
    if doubted := _doubted(summary):
        return (
            f"{doubted}{percent(share)} of {plural(summary.total, 'joint-frame')} were reconstructed "
            "all the same."
        )
    amount = next(
        words
        for least, words in (
            (1.0, "All of the motion was"),
            (0.95, "Nearly all of the motion was"),
            (0.7, "Most of the motion was"),
            (0.4, "About half of the motion was"),
            (0.0, "Only a small part of the motion was"),
        )
        if share >= least
    )
    return f"{amount} reconstructed: {percent(share)} of {plural(summary.total, 'joint-frame')}."


def _quality(summary: Summary) -> list[str]:
    absolute, root, aligned = (
        number(summary.metrics, k) for k in ("mpjpe_mm", "root_mpjpe_mm", "pa_mpjpe_mm")
    )
    reprojection = number(section(summary.metrics, "reprojection_px"), "median")
    used = text(section(summary.metrics, "method_used"), "summary")
    sentences = [f"The method {text(summary.metrics, 'method')} {used}."] if used else []
    if absolute is not None:
        finer = [f"{quantity(root, 'mm')} relative to the hips"] if root is not None else []
        finer += (
            [f"{quantity(aligned, 'mm')} after aligning each frame with truth"] if aligned is not None else []
        )
        sentences.append(
            f"Compared with truth, the joints are off by {quantity(absolute, 'mm')} on average"
            + (f"; by {listing(finer)}." if finer else ".")
        )
        if root is not None and root < MOSTLY_SHARED * absolute:
            sentences.append(
                "Most of that is a shift common to all joints, which wrong camera poses cause, "
                "not a wrong shape of the body."
            )
    else:
        sentences.append("There is no truth to compare with, so the error in the world is not known.")
    if reprojection is not None:
        sentences.append(
            f"The joints fall {quantity(reprojection, 'px')} from the keypoints (median over all views)."
        )
    if absolute is None and summary.bones:
        worst = max(summary.bones, key=lambda bone: bone.spread)
        typical = float(np.median([bone.spread for bone in summary.bones]))
        sentences.append(
            f"Bone lengths, which should not change, vary by {percent(typical)} (median over the bones), "
            f"most of all the {f'{worst.side} {worst.name}'.strip()} with {percent(worst.spread)}."
        )
    return sentences


def _certainty(summary: Summary) -> list[str]:
    motion = summary.motion
    sigma = finite_median(motion.sigma_m[motion.measured]) if motion is not None else None
    if sigma is None:
        return ["The method states no uncertainty for its positions."]
    sentences = [f"The stated uncertainty of a joint is {quantity(1000 * sigma, 'mm')} per axis (median)."]
    if summary.inside_95 is not None:
        sentences.append(
            f"{percent(summary.inside_95)} of the true positions lie inside the stated 95{chr(0x202F)}% "
            "ellipsoids. A flight is one draw of its constant pose errors, so only many flights tell if the "
            "uncertainty is right."
        )
    return sentences


def _odd_cameras(summary: Summary) -> list[str]:
    """List cameras that agree far worse with the skeleton than the others."""
    medians = {name: px[0] for name, px in camera_errors(summary).items() if px[0] is not None}
    if len(medians) < 3:
        return []
    usual = float(np.median(list(medians.values())))
    return [
        f"{name}: its keypoints lie {quantity(median, 'px')} from the joints, those of the usual camera "
        f"{quantity(usual, 'px')}; its calibration, poses or clock may be wrong."
        for name, median in medians.items()
        if median > ODD_CAMERA * usual
    ]


def _large_errors(summary: Summary) -> list[str]:
    """State the number, the joints and the times of measured joint-frames that are far from truth."""
    if summary.motion is None or summary.errors_mm is None:
        return []
    large = np.nan_to_num(summary.errors_mm) > LARGE_ERROR_MM
    if not large.any():
        return []
    count = large.sum(axis=(0, 1))
    most = [joint_label(summary.motion.joints[j]) for j in np.argsort(-count, kind="stable")[:4] if count[j]]
    t_s = (summary.motion.t_ns[large.any(axis=(1, 2))] - summary.origin_ns) / 1e9
    when = (
        f"at {quantity(t_s[0], 's', 2)}"
        if len(t_s) == 1
        else (f"at {plural(len(t_s), 'time')} from {quantity(t_s[0], 's', 2)} to {quantity(t_s[-1], 's', 2)}")
    )
    least, largest = quantity(LARGE_ERROR_MM, "mm", 0), quantity(float(np.nanmax(summary.errors_mm)), "mm", 0)
    return [
        f"Errors of more than {least} in {plural(int(large.sum()), 'joint-frame')} called measured (ok), "
        f"up to {largest}, {when}; most often of the {listing(most)}."
    ]


def _doubted(summary: Summary) -> str:
    """State the first doubt of the flight, to be put before everything else; empty without one."""
    doubts = doubts_of_flight(summary)
    return f"This flight is doubted: {text(doubts[0], 'what')}. " if doubts else ""


def doubts_of_flight(summary: Summary) -> list[dict[str, object]]:
    """Return what metrics.json doubts of the flight, what explains the most first; else session.json."""
    if "doubts" not in summary.metrics:
        return [doubt.as_json() for doubt in summary.description.doubts]
    return [doubt for doubt in items(summary.metrics, "doubts") if isinstance(doubt, dict)]


def _stated(doubt: Mapping[str, object]) -> str:
    """State a doubt of the flight as `reconstruct` warns of it."""
    code, what, remedy = (text(doubt, key) for key in ("code", "what", "remedy"))
    return Doubt(code=code, cameras=[], what=what, evidence={}, remedy=remedy).as_warning()


def _doubts(content: SessionContent, summary: Summary) -> list[str]:
    doubts = [_stated(doubt) for doubt in doubts_of_flight(summary)]
    losses = sorted(((n, word) for word, n in summary.counts.items() if word != "ok"), reverse=True)
    if not summary.nothing_measured:
        doubts += [
            f"{percent(n / summary.total)} of the joint-frames: {STATUS_REASONS[word]} ({word})."
            for n, word in losses
            if n / summary.total >= NOTABLE_LOSS
        ]
        thin = sorted((row.share, row.name) for row in summary.joints if row.share < DOUBTFUL_COVERAGE)
        if thin:
            named = listing(f"{joint_label(name)} ({percent(share)})" for share, name in thin[:5])
            more = f", and {len(thin) - 5} more" if len(thin) > 5 else ""
            doubts.append(f"Seldom measured: {named}{more}.")
    doubts += [
        f"{camera.name}: no person was detected in {whole(missed)} of {plural(count, 'frame')}."
        for camera in summary.cameras
        if camera.entry.keypoints
        and (missed := camera.entry.keypoints.frames_without_person)
        >= NOTABLE_LOSS * (count := camera.entry.frames.count)
    ]
    doubts += _large_errors(summary)
    doubts += _odd_cameras(summary)
    doubts += [f"The inputs of {stage} have changed since: run it again." for stage in content.outdated]
    told = [doubt.as_warning() for doubt in summary.description.doubts]  # reconstruct says them again
    doubts += [warning for warning in summary.description.warnings if warning not in told]
    for record in content.stages.values():
        doubts += [str(warning) for warning in items(record, "warnings")]
    return list(dict.fromkeys(doubts))  # a stage repeats the warnings of ingest
