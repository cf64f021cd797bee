"""Summary of a session: the numbers of the page's tables."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.bones import Bone, watched_bones
from pipelines.reporting.content import SessionContent, number, section
from pipelines.reporting.motion import Motion, errors_mm, motion_from_skeleton, share_inside_95, truth_at
from pipelines.reporting.wording import (
    fixed,
    percent,
    quantity,
    significant,
)
from pipelines.session.description import CameraEntry, Description


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
class Measure:
    """A number of the error table, and its meaning."""

    label: str
    value: str
    meaning: str


@dataclass(frozen=True)
class CameraErrors:
    """Agreement of one camera's keypoints with the skeleton, in px; None where it was not measured."""

    name: str
    median_px: float | None
    mean_px: float | None
    left_out_median_px: float | None  # against joints that were reconstructed without this camera


@dataclass(frozen=True)
class Summary:
    """A session in numbers."""

    origin_ns: int  # the page's zero of time: the first frame of all cameras
    description: Description
    cameras: tuple[CameraRow, ...]
    motion: Motion | None
    truth: Float | None  # [T, P, J, 3] m at the motion's times and joints
    errors_mm: Float | None  # [T, P, J]
    share: float | None
    counts: dict[str, int]
    inside_95: float | None
    joints: tuple[JointRow, ...]
    bones: tuple[Bone, ...]
    metrics: dict[str, object] = field(default_factory=dict)

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
    counts = _status_counts(motion) if motion is not None else {}
    metrics = content.metrics or {}
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
        joints=tuple(_joint_rows(motion, error, metrics)) if motion is not None else (),
        bones=tuple(watched_bones(motion)) if motion is not None else (),
        metrics=metrics,
    )


def _status_counts(motion: Motion) -> dict[str, int]:
    counted = np.bincount(motion.status[motion.status >= 0], minlength=len(STATUS))
    return {word: int(n) for word, n in zip(STATUS, counted, strict=True) if n}


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


def _joint_rows(motion: Motion, error: Float | None, metrics: dict[str, object]) -> list[JointRow]:
    per_joint = section(metrics, "per_joint")
    sigma = 1000 * motion.sigma_m
    rows = []
    for j, name in enumerate(motion.joints):
        stated = section(per_joint, name)
        status = motion.status[..., j]
        measured = motion.measured[..., j]
        counted = np.bincount(status[status >= 0], minlength=len(STATUS))
        computed = _mean(error[..., j]) if error is not None else None
        mpjpe = number(stated, "mpjpe_mm")
        reprojection = number(section(stated, "reprojection_px"), "median")
        seen = finite_median(motion.reprojection_px[..., j][measured])
        rows.append(
            JointRow(
                name=name,
                share=float(measured.sum() / max(counted.sum(), 1)),
                mpjpe_mm=computed if mpjpe is None else mpjpe,
                root_mpjpe_mm=number(stated, "root_mpjpe_mm"),
                reprojection_px=seen if reprojection is None else reprojection,
                sigma_mm=finite_median(sigma[..., j][measured]),
                counts={word: int(n) for word, n in zip(STATUS, counted, strict=True)},
            )
        )
    return rows


def _mean(values: Float) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else None


def finite_median(values: Float) -> float | None:
    """Compute the median of the finite values; None where there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


def measures(summary: Summary) -> list[Measure]:
    """Return the rows of the error table: every overall number of the metrics, known ones explained."""
    reprojection = section(summary.metrics, "reprojection_px")
    rows = []
    if summary.share is not None:
        rows.append(Measure("Reconstructed", percent(summary.share), "share of joint-frames measured"))
    for key, label, unit, digits, meaning in _KNOWN_MEASURES:
        value = number(summary.metrics | section(summary.metrics, "shape"), key)
        if value is not None:
            shown = percent(value) if unit == "%" else f"{fixed(value, digits)} {unit}".strip()
            rows.append(Measure(label, shown, meaning))
    for key, label in (("median", "Reprojection, median"), ("mean", "Reprojection, mean")):
        value = number(reprojection, key)
        if value is not None:
            meaning = "distance in the picture from the keypoints, over all views"
            rows.append(Measure(label, quantity(value, "px", 2), meaning))
    explained = {key for key, *_ in _KNOWN_MEASURES} | _STATED_ELSEWHERE
    rows += [
        Measure(key, significant(number(summary.metrics, key)), "")
        for key in summary.metrics
        if key not in explained and number(summary.metrics, key) is not None
    ]
    return rows


def errors_per_camera(summary: Summary) -> list[CameraErrors]:
    """Return the rows of the table of reprojection errors; none if the metrics have none per camera."""
    own = section(summary.metrics, "reprojection_px_per_camera")
    left_out = section(summary.metrics, "leave_one_camera_out_px")
    return [
        CameraErrors(
            name=name,
            median_px=number(section(own, name), "median"),
            mean_px=number(section(own, name), "mean"),
            left_out_median_px=number(section(left_out, name), "median"),
        )
        for name in own
    ]


_KNOWN_MEASURES = (
    ("mpjpe_mm", "MPJPE", "mm", 1, "mean distance of joints from truth, in the world"),
    ("root_mpjpe_mm", "Root-relative MPJPE", "mm", 1, "the same with the hips laid on each other"),
    ("pa_mpjpe_mm", "PA-MPJPE", "mm", 1, "after the best shift, turn and scale of each frame"),
    (
        "pck150",
        "PCK at 150 mm",
        "%",
        1,
        "share of joints within 150 mm of truth; missing ones count as wrong",
    ),
    ("pck150_auc", "PCK area", "%", 1, "mean of PCK over all thresholds from 0 to 150 mm"),
    ("acceleration_error_mm_s2", "Acceleration error", "mm/s²", 0, "mean difference of accelerations"),
    ("jerk_m_s3", "Jerk", "m/s³", 0, "median length of the third derivative of the joints' motion"),
    ("bone_spread_mm", "Bone length spread", "mm", 1, "median over the bones of each one's spread"),
    ("e_recon_m2", "E_recon", "m²", 3, "sum of squared distances over all joint-frames with truth"),
    ("e_recon_terms", "E_recon, terms", "", 0, "joint-frames in that sum"),
    ("e_recon_per_joint_frame_m2", "E_recon per joint-frame", "m²", 6, "the sum divided by its terms"),
    ("root_frames_left_out", "Frames without root", "", 0, "left out of the root-relative error"),
    ("pa_frames_left_out", "Frames not aligned", "", 0, "too few joints in common for PA-MPJPE"),
)
_STATED_ELSEWHERE = {"reconstructed_share", "reconstructed_share_of_truth", "joint_frames", "schema"}
