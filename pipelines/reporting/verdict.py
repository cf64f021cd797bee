"""Judgement of a session: is it good, how good, why, what next, and what is doubtful."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.reporting.content import SessionContent, items, number, section, text
from pipelines.reporting.summary import Summary
from pipelines.reporting.wording import (
    STATUS_LABELS,
    STATUS_REASONS,
    STATUS_REMEDIES,
    fixed,
    joint_label,
    listing,
    percent,
    plural,
    quantity,
    whole,
)
from pipelines.session.description import Doubt

# Hip to ankle is 0.491 of the stature, 1.4 to 2.05 m, by Drillis and Contini (1966): Winter, Biomechanics and
# Motor Control of Human Movement, 4th edition, figure 4.1.
USUAL_LEG_M = (0.69, 1.01)
# Running people are slower than this.
USUAL_SPEED_MPS = 8.0
# Speeds over half a second average out the swing of the hips.
SPEED_SPAN_NS = 500_000_000
# Below this share of measured times a joint is named among the doubts.
DOUBTFUL_COVERAGE = 0.8
# A status is named among the doubts from this share of joint-frames on.
NOTABLE_LOSS = 0.01
# The first screen has room for so many reasons.
MOST_REASONS = 3


@dataclass(frozen=True)
class Verdict:
    """First words of the page. A doubt is `wrong`, `doubt` or `note`, and its sentence."""

    grade: str  # good, usable, poor, wrong, or empty where nothing was estimated
    lead: str
    error: str = ""  # of a joint: expected, or against truth
    why: tuple[str, ...] = ()
    next: str = ""  # command
    doubts: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Glance:
    """A figure of the body that a person can judge, with the usual range of people."""

    label: str
    value: str
    usual: str
    odd: bool  # outside the usual range


def at_a_glance(summary: Summary) -> list[Glance]:
    """Compare the first person with people: legs and speed; what is not known is left out."""
    if summary.motion is None or not summary.motion.measured.any():
        return []
    glances = []
    bones = {(bone.name, bone.side): bone.median_m for bone in summary.bones}
    sides = [[bones.get((name, side), np.nan) for name in ("thigh", "shank")] for side in ("left", "right")]
    legs = np.sum(sides, axis=1)
    if np.isfinite(legs).any():
        leg, (low, high) = float(np.nanmean(legs)), USUAL_LEG_M
        usual = f"hip to ankle; adults {low:.2f} to {high:.2f} m"
        glances.append(Glance("Legs", quantity(leg, "m", 2), usual, not low <= leg <= high))
    position, joints = summary.motion.measured_position[:, 0], summary.motion.joints
    hips = [joints.index(name) for name in ("left_hip", "right_hip") if name in joints]
    speed = _speeds(summary.motion.t_ns, position[:, hips].mean(axis=1)) if hips else np.empty(0)
    if len(speed):
        fast = float(np.percentile(speed, 95))
        value = f"{quantity(float(np.median(speed)), 'm/s')}, up to {quantity(fast, 'm/s')}"
        usual = f"median and 95 % of the time; running people up to {USUAL_SPEED_MPS:.0f} m/s"
        glances.append(Glance("Speed", value, usual, fast > USUAL_SPEED_MPS))
    return glances


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
    """Judge a session by its metrics.json; without a verdict there, by what was measured."""
    doubts = tuple(_doubts(content, summary))
    worst = tuple(sentence for kind, sentence in doubts if kind != "note")[:MOST_REASONS]
    session = f"{content.name}.session"
    if content.skeleton is None:
        lead = "This session was ingested, but not reconstructed yet."
        return Verdict("", lead, why=worst, next=f"mocap reconstruct {session}", doubts=doubts)
    if summary.motion is None or summary.nothing_measured:
        return Verdict("wrong", _why_nothing(summary), why=worst, next=f"mocap info {session}", doubts=doubts)
    given = section(summary.metrics, "verdict")
    grade = text(given, "grade")
    lead = f"{percent(summary.share)} of {plural(summary.total, 'joint-frame')} were measured."
    why = tuple(str(each) for each in items(given, "why"))[:MOST_REASONS] or worst
    remedy = (
        "mocap check flight.yaml" if doubts_of_flight(summary) else f"mocap export {session} --to trc,angles"
    )
    ends = [end for end in items(given, "expected_error_mm") if isinstance(end, int | float)]
    error = ""
    if len(ends) == 3:
        low, median, high = ends
        error = f"{fixed(median, 0)} mm (expected: {fixed(low, 0)} to {fixed(high, 0)})"
    elif (measured := number(summary.metrics, "mpjpe_mm")) is not None:
        error = f"{quantity(measured, 'mm', 0)} (mean, against truth)"
    return Verdict(grade, lead, error, why, text(given, "next") or remedy, doubts)


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


def doubts_of_flight(summary: Summary) -> list[dict[str, object]]:
    """Return what metrics.json doubts of the flight, what explains the most first; else session.json."""
    if "doubts" not in summary.metrics:
        return [doubt.as_json() for doubt in summary.description.doubts]
    return [doubt for doubt in items(summary.metrics, "doubts") if isinstance(doubt, dict)]


def _stated(doubt: Mapping[str, object]) -> str:
    """State a doubt of the flight as `reconstruct` warns of it."""
    code, what, remedy = (text(doubt, key) for key in ("code", "what", "remedy"))
    return Doubt(code=code, cameras=[], what=what, evidence={}, remedy=remedy).as_warning()


def _doubts(content: SessionContent, summary: Summary) -> list[tuple[str, str]]:
    """List what is wrong, then what is doubtful, then what was lost; each once."""
    found = {_stated(doubt): "wrong" for doubt in doubts_of_flight(summary)}
    for stage in content.outdated:
        found[f"The inputs of {stage} have changed since: run it again."] = "wrong"
    told = [doubt.as_warning() for doubt in summary.description.doubts]  # reconstruct says them again
    warnings = [warning for warning in summary.description.warnings if warning not in told]
    for stage, record in content.stages.items():
        warnings += [] if stage == "replan" else [str(warning) for warning in items(record, "warnings")]
    for warning in warnings:
        found.setdefault(warning, "doubt")
    if not summary.nothing_measured:
        for word, count in sorted(summary.counts.items(), key=lambda item: -item[1]):
            if word != "ok" and count / summary.total >= NOTABLE_LOSS:
                share = percent(count / summary.total)
                found[f"{share} of the joint-frames: {STATUS_REASONS[word]} ({word})."] = "note"
        thin = sorted((row.share, row.name) for row in summary.joints if row.share < DOUBTFUL_COVERAGE)
        if thin:
            named = listing(f"{joint_label(name)} ({percent(share)})" for share, name in thin[:5])
            found[f"Seldom measured: {named}{f', and {len(thin) - 5} more' if len(thin) > 5 else ''}."] = (
                "note"
            )
    for camera in summary.cameras:
        missed = camera.entry.keypoints.frames_without_person if camera.entry.keypoints else 0
        if missed > NOTABLE_LOSS * (count := camera.entry.frames.count):
            found[
                f"{camera.name}: no person was detected in {whole(missed)} of {plural(count, 'frame')}."
            ] = "note"
    return [(kind, sentence) for sentence, kind in found.items()]
