"""Summary of a session: the numbers of the page's tables, and its judgement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.metrics import own_truth
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.content import (
    Bone,
    MeasuredMotion,
    SessionContent,
    errors_mm,
    items,
    motion_from_skeleton,
    number,
    section,
    share_inside_95,
    text,
    watched_bones,
)
from pipelines.reporting.wording import (
    ABSENT,
    STATUS_LABELS,
    STATUS_REASONS,
    STATUS_REMEDIES,
    THIN,
    Column,
    Table,
    fixed,
    joint_label,
    listing,
    percent,
    plain,
    plural,
    quantity,
    whole,
)
from pipelines.session.camera_poses import logged_covariance
from pipelines.session.description import CameraEntry, Description, Doubt
from pipelines.session.people import true_joints_at
from pipelines.session.tables import figures_by_joint, motion_from, trajectory_from

# Keypoints below this confidence are left out by `reconstruct` where its record states no other.
DEFAULT_MIN_CONFIDENCE = 0.3

_PCK = "share of joints within 150 mm of truth; missing ones count as wrong"
_KNOWN_MEASURES = (
    ("mpjpe_mm", "MPJPE", "mm", 1, "mean distance of joints from truth, in the world"),
    ("root_mpjpe_mm", "Root-relative MPJPE", "mm", 1, "the same with the hips laid on each other"),
    ("pa_mpjpe_mm", "PA-MPJPE", "mm", 1, "after the best shift, turn and scale of each frame"),
    ("pck150", "PCK at 150 mm", "%", 1, _PCK),
    ("acceleration_error_mm_s2", "Acceleration error", "mm/s²", 0, "mean difference of accelerations"),
    ("jerk_m_s3", "Jerk", "m/s³", 0, "median length of the third derivative of the joints' motion"),
    ("bone_spread_mm", "Bone length spread", "mm", 1, "median over the bones of each one's spread"),
)


@dataclass(frozen=True)
class CameraRow:
    """One camera as it was ingested. Times in seconds since the page's zero."""

    name: str
    entry: CameraEntry
    first_s: float
    last_s: float
    gaps_s: tuple[tuple[float, float], ...]

    @property
    def gap_total_s(self) -> float:
        """Total duration of the gaps in the poses."""
        return sum(end - start for start, end in self.gaps_s)


@dataclass(frozen=True)
class JointRow:
    """One joint over the whole recording; None where a value is not known."""

    name: str
    share: float
    mpjpe_mm: float | None
    root_mpjpe_mm: float | None
    reprojection_px: float | None
    sigma_mm: float | None
    counts: dict[str, int]  # by status


@dataclass(frozen=True)
class Summary:
    """A session in numbers."""

    origin_ns: int  # the page's zero of time: the first frame of all cameras
    description: Description
    cameras: tuple[CameraRow, ...]
    motion: MeasuredMotion | None
    truth: Float | None  # [T, P, J, 3] m at the motion's times and joints
    errors_mm: Float | None  # [T, P, J]
    share: float | None
    counts: dict[str, int]
    inside_95: float | None
    sigma_mm: float | None  # stated per axis, median
    joints: tuple[JointRow, ...]
    bones: tuple[Bone, ...]
    metrics: dict[str, object] = field(default_factory=dict)

    @property
    def people(self) -> tuple[str, ...]:
        """Names of the reconstructed people; none without a motion."""
        count = self.motion.position.shape[1] if self.motion is not None else 0
        return tuple(self.description.names_of_people(count))

    @property
    def total(self) -> int:
        """Number of joint-frames."""
        return sum(self.counts.values())

    @property
    def statuses(self) -> list[str]:
        """Statuses that any joint-frame has, in their usual order."""
        return [word for word in STATUS if self.counts.get(word)]

    @property
    def nothing_measured(self) -> bool:
        """True if a reconstruction ran and gave no joint at all."""
        return self.motion is not None and not self.counts.get("ok", 0)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last frame of all cameras."""
        return max(camera.last_s for camera in self.cameras) - min(camera.first_s for camera in self.cameras)


def summarise(content: SessionContent) -> Summary:
    """Compute every number that the page shows."""
    description = content.session
    origin_ns = description.start_ns
    has_rows = content.skeleton is not None and len(content.skeleton) > 0
    motion = motion_from_skeleton(content.skeleton) if content.skeleton is not None and has_rows else None
    truth = truth_at(content.truth, motion) if motion is not None and content.truth is not None else None
    error = errors_mm(motion, truth) if motion is not None and truth is not None else None
    found = np.bincount(motion.status[motion.status >= 0]) if motion is not None else ()
    counts = {word: int(n) for word, n in zip(STATUS, found, strict=False) if n}
    metrics = content.metrics or {}
    if content.every > 1:  # rows were left out, but were counted
        stated = section(metrics, "status_counts")
        counts = {word: int(number(stated, word) or 0) for word in STATUS if number(stated, word)}
    total = sum(counts.values())
    return Summary(
        origin_ns=origin_ns,
        description=description,
        cameras=tuple(_camera_row(name, entry, origin_ns) for name, entry in description.cameras.items()),
        motion=motion,
        truth=truth,
        errors_mm=error if error is not None and np.isfinite(error).any() else None,
        share=counts.get("ok", 0) / total if total else None,
        counts=counts,
        inside_95=share_inside_95(motion, truth) if motion is not None and truth is not None else None,
        sigma_mm=finite_median(1000 * motion.sigma_m) if motion is not None else None,
        joints=tuple(_joint_rows(motion, content.joint_errors)) if motion is not None else (),
        bones=tuple(watched_bones(motion)) if motion is not None else (),
        metrics=metrics,
    )


def truth_at(truth: pd.DataFrame, motion: MeasuredMotion) -> Float:
    """Return the true positions at the motion's times and joints, [T, P, J, 3], of the nearest person."""
    known = motion_from(truth, motion.joints)
    return own_truth(motion.measured_position, true_joints_at(known, motion.t_ns))


def _camera_row(name: str, entry: CameraEntry, origin_ns: int) -> CameraRow:
    return CameraRow(
        name=name,
        entry=entry,
        first_s=(entry.frames.first_t_ns - origin_ns) / 1e9,
        last_s=(entry.frames.last_t_ns - origin_ns) / 1e9,
        gaps_s=tuple(
            ((start - origin_ns) / 1e9, (end - origin_ns) / 1e9) for start, end in entry.poses.gaps_ns
        ),
    )


def _joint_rows(motion: MeasuredMotion, stored: pd.DataFrame | None) -> list[JointRow]:
    per_joint = {} if stored is None else figures_by_joint(stored)
    rows = []
    for j, name in enumerate(motion.joints):
        stated, status = per_joint.get(name, {}), motion.status[..., j]
        measured = motion.measured[..., j]
        counted = np.bincount(status[status >= 0], minlength=len(STATUS))
        rows.append(
            JointRow(
                name=name,
                share=float(measured.sum() / max(counted.sum(), 1)),
                mpjpe_mm=stated.get("mpjpe_mm"),
                root_mpjpe_mm=stated.get("root_mpjpe_mm"),
                reprojection_px=finite_median(motion.reprojection_px[..., j][measured]),
                sigma_mm=finite_median(1000 * motion.sigma_m[..., j][measured]),
                counts={word: int(n) for word, n in zip(STATUS, counted, strict=True)},
            )
        )
    return rows


def finite_median(values: Float) -> float | None:
    """Compute the median of the finite values; None where there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


# --- tables ---


def camera_errors(summary: Summary) -> dict[str, tuple[float | None, ...]]:
    """Return median, mean, and median without the camera, of keypoints' distances (px) by camera."""
    own = section(summary.metrics, "reprojection_px_per_camera")
    left_out = section(summary.metrics, "leave_one_camera_out_px")
    return {
        name: (
            number(section(own, name), "median"),
            number(section(own, name), "mean"),
            number(section(left_out, name), "median"),
        )
        for name in own
    }


def tables_of_errors(summary: Summary) -> list[Table]:
    """Make the tables of all joints and times, of each person, and of each camera."""
    found = [
        Table(
            "measures",
            "Over all joints and times.",
            (Column("Measure", text=True), Column("Value"), Column("Meaning", text=True)),
            _measures(summary),
            "measures",
        ),
        _by_person(summary),
        Table(
            "per-camera",
            "Distance in the picture between a camera’s keypoints and the reconstructed joints, in px.",
            (
                Column("Camera", text=True),
                Column("Median"),
                Column("Mean"),
                Column("Median", "joints from the other cameras alone"),
            ),
            [[name, *(fixed(px, 2) for px in errors)] for name, errors in camera_errors(summary).items()],
            "measures",
        ),
    ]
    return [one for one in found if one.rows]


def _measures(summary: Summary) -> list[list[str]]:
    """Return every overall number of the metrics, known ones explained."""
    rows = []
    if summary.share is not None:
        rows.append(["Reconstructed", percent(summary.share), "share of joint-frames measured"])
    for key, label, unit, digits, meaning in _KNOWN_MEASURES:
        value = number(summary.metrics | section(summary.metrics, "shape"), key)
        if value is not None:
            shown = percent(value) if unit == "%" else f"{fixed(value, digits)} {unit}".strip()
            rows.append([label, shown, meaning])
    reprojection = section(summary.metrics, "reprojection_px")
    for key in ("median", "mean"):
        value = number(reprojection, key)
        if value is not None:
            meaning = "distance in the picture from the keypoints, over all views"
            rows.append([f"Reprojection, {key}", quantity(value, "px", 2), meaning])
    return rows


def _by_person(summary: Summary) -> Table:
    """Make the table of people; without rows if fewer than two were reconstructed."""
    own, tracking = section(summary.metrics, "by_person"), section(summary.metrics, "tracking")
    caption, columns = "By person.", [Column("Person", text=True), Column("Seen", "% of the times")]
    columns += [Column("Measured", "% of joint-frames"), Column("MPJPE", "mm")]
    if tracking:
        columns += [Column("Switches"), Column("Misses", "frames"), Column("Phantom", "frames")]
        counts = [f"{whole(number(tracking, key))} {key}" for key in ("switches", "misses", "phantoms")]
        caption += f" Against truth, at {fixed(number(tracking, 'within_m'))} m: {', '.join(counts)} in"
        caption += f" {whole(number(tracking, 'present'))} person-frames"
        scores = [f"{key.upper()} {fixed(number(tracking, key), 3)}" for key in ("mota", "idf1")]
        caption += f"; {', '.join(scores)}." if number(tracking, "mota") is not None else "."
    rows = []
    for name in own if len(own) > 1 else ():
        stated = section(own, name)
        shares = [number(stated, key) for key in ("coverage", "reconstructed_share")]
        cells = [fixed(None if share is None else 100 * share) for share in shares]
        cells.append(fixed(number(stated, "mpjpe_mm")))
        keys = ("switches", "misses", "phantoms") if tracking else ()
        rows.append([name, *cells, *(whole(number(stated, key)) for key in keys)])
    return Table("by-person", caption, columns, rows, "measures people")


def table_of_joints(summary: Summary) -> Table:
    """Make the table of all joints, with the number of joint-frames by status."""
    with_truth = any(row.mpjpe_mm is not None for row in summary.joints)
    columns = [Column("Joint", text=True), Column("Measured", "share")]
    columns += [Column("MPJPE", "mm"), Column("Relative", "to hips, mm")] * with_truth
    columns += [Column("Reprojection", "median, px"), Column("Uncertainty", "median σ, mm")]
    columns += [Column(STATUS_LABELS[word].capitalize(), key=word) for word in summary.statuses]
    caption = (
        "Every joint: how often it was measured, how well, and how many joint-frames ended with which status."
    )
    rows = [
        [
            joint_label(row.name),
            percent(row.share),
            *([fixed(row.mpjpe_mm), fixed(row.root_mpjpe_mm)] if with_truth else []),
            fixed(row.reprojection_px, 2),
            fixed(row.sigma_mm),
            *(whole(row.counts[word]) for word in summary.statuses),
        ]
        for row in summary.joints
    ]
    return Table("joints", caption, columns, rows, "joints")


def table_of_cameras(content: SessionContent, summary: Summary, started: str) -> Table:
    """Make the table of what was ingested; `started` is the zero of its times."""
    columns = [Column("Camera", text=True), Column("Picture", "px"), Column("Frames"), Column("Rate", "Hz")]
    columns += [Column("Span", "s"), Column("Poses"), Column("Gaps", "in poses")]
    columns += [Column("Frames", "without pose"), Column("Frames", "without person")]
    columns += [Column("Keypoints", text=True)]
    settings = section(content.stages.get("detect", {}), "settings")
    detector = settings.get("detector") or "a detector"
    rows = []
    for camera in summary.cameras:
        entry, keypoints = camera.entry, camera.entry.keypoints
        gaps = f"{len(camera.gaps_s)} ({fixed(camera.gap_total_s, 2)} s)" if camera.gaps_s else "none"
        source = f"{detector}, run here" if camera.name in content.keypoints else "none"
        if keypoints is not None:
            source = f"{keypoints.format}, {len(keypoints.joints)} joints"
        rows.append(
            [
                camera.name,
                f"{entry.intrinsics.width} × {entry.intrinsics.height}",
                whole(entry.frames.count),
                fixed(entry.frames.rate_hz, 2),
                f"{fixed(camera.first_s, 2)} to {fixed(camera.last_s, 2)}",
                "stands still" if entry.poses.static else whole(entry.poses.count),
                gaps,
                whole(entry.poses.frames_without_pose),
                ABSENT if keypoints is None else whole(keypoints.frames_without_person),
                source,
            ]
        )
    caption = f"Cameras. Times count from the first frame of all, {started}; the clock offsets stated in the"
    return Table("cameras", f"{caption} flight are applied.", columns, rows)


def table_of_quality(content: SessionContent, summary: Summary) -> Table:
    """Make the table of the quality of every camera's data."""
    columns = [Column("Camera", text=True), Column("Pose noise", text=True), Column("Clock", "offset")]
    columns += [Column("Clock", "σ"), Column("Person found", "of frames")]
    columns += [Column("Keypoints used", "of those found")]
    caption = "Pose noise is per axis. A clock’s offset is as stated, plus what was estimated."
    rows = [_quality(content, summary, camera) for camera in summary.cameras]
    return Table("quality", caption, columns, rows, "quality")


def _quality(content: SessionContent, summary: Summary, camera: CameraRow) -> list[str]:
    clock = camera.entry.clock
    found = number(section(summary.metrics, "clock_offsets_s"), camera.name)
    offset = quantity(clock.offset_s, "s", 3)
    if found is not None:
        offset += f" {'+' if found >= 0 else ''}{quantity(found, 's', 3)}"
    found_s = number(section(summary.metrics, "clock_offset_sigmas_s"), camera.name)
    sigma_s = clock.prior_sigma_s
    words = f"±{THIN}{quantity(sigma_s, 's', 3)}" if sigma_s else "known"
    words += {"stated": "", "assumed": ", assumed", "none": ", not stated"}[clock.start]
    return [
        camera.name,
        _stated_noise(camera, content.poses.get(camera.name)),
        offset,
        f"{words}; estimated to ±{THIN}{quantity(found_s, 's', 3)}" if found_s else words,
        *(percent(share) for share in _detection(content, camera)),
    ]


def _stated_noise(camera: CameraRow, poses: pd.DataFrame | None) -> str:
    """Describe the errors of the poses, by flight.yaml or by the log."""
    if camera.entry.pose_noise:
        return "; ".join(f"{name} {plain(model)}" for name, model in camera.entry.pose_noise.items())
    covariance = logged_covariance(trajectory_from(poses)) if poses is not None else None
    if covariance is not None:
        variances = np.diagonal(covariance, axis1=1, axis2=2)
        position_m, rotation_rad = (
            float(np.sqrt(np.median(variances[:, k : k + 3].mean(axis=1)))) for k in (0, 3)
        )
        return f"by the log: {fixed(position_m, 3)}{THIN}m, {fixed(np.degrees(rotation_rad), 2)}{THIN}deg"
    return "stands still" if camera.entry.poses.static else "nothing"


def _detection(content: SessionContent, camera: CameraRow) -> tuple[float | None, float | None]:
    table = content.keypoints.get(camera.name)
    if table is None:
        return None, None
    least = number(section(content.stages.get("reconstruct", {}), "settings"), "min_confidence")
    used = table["confidence"].to_numpy() >= (DEFAULT_MIN_CONFIDENCE if least is None else least)
    confident = float(used.mean()) if len(used) else None
    if camera.entry.keypoints is not None:
        count = camera.entry.frames.count
        return 1 - camera.entry.keypoints.frames_without_person / max(count, 1), confident
    counts = section(section(content.stages.get("detect", {}), "counts"), "cameras")
    looked = number(section(counts, camera.name), "frames") or camera.entry.frames.count
    return float(min(content.every * table["frame"].nunique() / max(looked, 1), 1.0)), confident


# Hip to ankle is 0.491 of the stature, 1.4 to 2.05 m, by Drillis and Contini (1966): Winter, Biomechanics and
# Motor Control of Human Movement, 4th edition, figure 4.1.
USUAL_LEG_M = (0.69, 1.01)
# The statures that the range of legs rests on.
USUAL_STATURE_M = (1.4, 2.05)
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
# A longer reason would push the person from the first screen of a phone; it stands whole below.
MOST_REASON_CHARACTERS = 120


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
    unusual: bool  # outside the usual range


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
    bodies = section(summary.metrics, "body")
    body = section(bodies, next(iter(bodies), ""))
    stature_m, sigma_m = number(body, "stature_m"), number(body, "stature_sigma_m")
    if stature_m is not None and sigma_m is not None:
        (low, high), value = USUAL_STATURE_M, f"{stature_m:.2f} ± {sigma_m:.2f} m"
        usual = f"of the fitted body; adults {low:.2f} to {high:.2f} m"
        glances.append(Glance("Stature", value, usual, not low <= stature_m <= high))
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
        return Verdict(
            "wrong", _reason_for_no_result(summary), why=worst, next=f"mocap info {session}", doubts=doubts
        )
    given = section(summary.metrics, "verdict")
    grade = text(given, "grade")
    lead = f"{percent(summary.share)} of the joints were measured."
    reasons = tuple(str(each) for each in items(given, "why"))[:MOST_REASONS] or worst
    why = tuple(map(_short, reasons))
    following = text(given, "next").replace("SESSION", session)
    if not following or following.startswith("mocap report"):  # that is this page
        following = f"mocap export {session} --to trc,angles"
    ends = [end for end in items(given, "expected_error_mm") if isinstance(end, int | float)]
    error = ""
    if len(ends) == 3:
        low, median, high = ends
        error = f"{fixed(median, 0)} mm, likely {fixed(low, 0)} to {quantity(high, 'mm', 0)}"
    if (measured := number(summary.metrics, "mpjpe_mm")) is not None:
        error += f"{'; ' if error else ''}{quantity(measured, 'mm', 0)} against truth"
    return Verdict(grade, lead, error, why, following, doubts)


def _short(reason: str) -> str:
    """Cut a reason for the first screen: behind a clause, else between two words."""
    kept = reason[:MOST_REASON_CHARACTERS]
    return reason if kept == reason else f"{kept.rpartition('; ')[0] or kept.rpartition(' ')[0]} …"


def _reason_for_no_result(summary: Summary) -> str:
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
