"""Contents of a page, as the stage loads it from a session: tables, dense arrays, readers of loose JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.metrics import bone_lengths
from pipelines.geometry.triangulation import STATUS
from pipelines.session.description import Description
from pipelines.session.records import POINT_COVARIANCE_COLUMNS, Occupancy, full_covariance

# Joints are stored as this part of a picture's side, which fits 16 bits and is finer than a pixel.
FULL_SCALE = 10_000
# The 95 % quantile of chi-square with 3 degrees of freedom, for a Gaussian in three dimensions.
CHI2_95_OF_3 = 7.815


@dataclass(frozen=True)
class ReplanContent:
    """Stored results of a comparison of planners."""

    metrics: dict[str, object]  # replan/metrics.json
    arms: dict[str, pd.DataFrame]  # arm: tables.REPLAN
    actor: pd.DataFrame  # tables.ACTOR at the same times: the reference of the arms' scores
    map: Occupancy | None = None  # the session's last map
    filmed: dict[str, object] = field(default_factory=dict)  # film/metrics.json of this comparison


@dataclass(frozen=True)
class StudyContent:
    """Results of `mocap study` in a folder."""

    metrics: dict[str, Any]  # its metrics.json
    command: str  # that makes it again
    digest: str  # SHA-256 of that file


@dataclass(frozen=True)
class SessionContent:
    """Contents of one session's page; a part that the session lacks is None or empty."""

    name: str
    session: Description
    skeleton: pd.DataFrame | None  # tables.SKELETON
    metrics: dict[str, object] | None  # reconstruct/metrics.json
    truth: pd.DataFrame | None  # tables.TRUTH
    poses: dict[str, pd.DataFrame]  # camera: tables.POSES
    frames: dict[str, pd.DataFrame]  # camera: tables.FRAMES
    keypoints: dict[str, pd.DataFrame]  # camera: tables.KEYPOINTS, of cameras that have any
    stages: dict[str, dict[str, object]]  # stage: its stage.json
    replan: ReplanContent | None = None
    refined: dict[str, pd.DataFrame] = field(default_factory=dict)  # camera: tables.POSES, where refined
    made_by: dict[str, dict[str, str]] = field(default_factory=dict)  # stage: program or library, and version
    outdated: tuple[str, ...] = ()  # stages whose inputs have changed since
    angles: pd.DataFrame | None = None  # tables.ANGLES, where the reconstruction has them
    joint_errors: pd.DataFrame | None = None  # tables.JOINT_ERRORS, likewise
    studies: tuple[StudyContent, ...] = ()  # that stand beside the flight
    bodies: pd.DataFrame | None = None  # tables.BODY, where bodies were fitted
    shapes: pd.DataFrame | None = None  # tables.BODY_SHAPE, likewise
    every: int = 1  # times of the skeleton of which one was loaded, with what was recorded about it


@dataclass(frozen=True)
class Strip:
    """Pictures of one camera."""

    camera: str
    t_ns: Int64  # [N]
    pictures: tuple[str, ...]  # [N] WebP in base64
    joints: Float  # [N, P, K, 2] part of the picture's side from its upper left corner; NaN if missing
    projection: Float  # [N, 3, 4] homogeneous, to such parts from the world (m), exact near the person


def section(mapping: Mapping[str, object], key: str) -> dict[str, object]:
    """Return the mapping under a key; empty when it is absent or something else."""
    value = mapping.get(key)
    return {str(k): v for k, v in value.items()} if isinstance(value, Mapping) else {}


def items(mapping: Mapping[str, object], key: str) -> list[object]:
    """Return the list under a key; empty when it is absent or something else."""
    value = mapping.get(key)
    return list(value) if isinstance(value, list | tuple) else []


def number(mapping: Mapping[str, object], key: str) -> float | None:
    """Return the number under a key; None when it is absent, null or something else."""
    value = mapping.get(key)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def text(mapping: Mapping[str, object], key: str) -> str:
    """Return the text under a key; empty when it is absent or something else."""
    value = mapping.get(key)
    return value if isinstance(value, str) else ""


def estimated_clocks(metrics: Mapping[str, object]) -> dict[str, int]:
    """Read the clock offsets, ns, of reconstruct/metrics.json: what to add to the ingested frame times."""
    offsets = section(metrics, "clock_offsets_s")
    return {name: round((number(offsets, name) or 0.0) * 1e9) for name in offsets}


def as_reconstructed(content: SessionContent) -> SessionContent:
    """Return the session with the refined poses and the clocks that its skeleton was measured with."""
    offset_ns = estimated_clocks(content.metrics or {})
    frames = {
        name: table.assign(t_ns=table["t_ns"] + offset_ns.get(name, 0))
        for name, table in content.frames.items()
    }
    return replace(content, poses=content.poses | content.refined, frames=frames)


@dataclass(frozen=True)
class MeasuredMotion:
    """Joints over time: T stamps, P people, J joints, in the order in which the table first names them."""

    t_ns: Int64  # [T], strictly increasing
    joints: tuple[str, ...]
    position: Float  # [T, P, J, 3] m
    covariance: Float  # [T, P, J, 6] m^2, upper triangle: POINT_COVARIANCE_COLUMNS
    reprojection_px: Float  # [T, P, J]
    status: NDArray[np.int8]  # [T, P, J] index into triangulation.STATUS, -1 where the table has no row
    views: Int64  # [T, P, J] number of cameras that the joint was taken from

    @property
    def measured(self) -> NDArray[np.bool_]:
        """True [T, P, J] where a joint was reconstructed from pictures; a filled joint was not."""
        measured: NDArray[np.bool_] = self.status == STATUS.index("ok")
        return measured

    @property
    def measured_position(self) -> Float:
        """Positions [T, P, J, 3] of measured joints, NaN elsewhere."""
        return np.where(self.measured[..., None], self.position, np.nan)

    @property
    def sigma_m(self) -> Float:
        """Standard deviation per axis of measured joints, sqrt(trace / 3), [T, P, J]; NaN if unknown."""
        trace = self.covariance[..., [0, 3, 5]].sum(axis=-1)
        return np.where(self.measured, np.sqrt(trace / 3), np.nan)


def motion_from_skeleton(table: pd.DataFrame) -> MeasuredMotion:
    """Make dense arrays of a skeleton table (tables.SKELETON), in any order of its rows."""
    t_ns, time = np.unique(table["t_ns"].to_numpy(dtype=np.int64), return_inverse=True)
    persons, person = np.unique(table["person"].to_numpy(dtype=np.int64), return_inverse=True)
    joint, joints = pd.factorize(table["joint"])
    shape = (len(t_ns), len(persons), len(joints))
    cell = (time, person, joint)

    def dense(*columns: str) -> Float:
        values = np.full((*shape, len(columns)), np.nan)
        values[cell] = table[list(columns)].to_numpy(dtype=np.float64)
        return values

    status = np.full(shape, -1, dtype=np.int8)
    status[cell] = pd.Index(STATUS).get_indexer(pd.Index(table["status"]))
    return MeasuredMotion(
        t_ns=t_ns,
        joints=tuple(str(name) for name in joints),
        position=dense("x", "y", "z"),
        covariance=dense(*POINT_COVARIANCE_COLUMNS),
        reprojection_px=dense("reprojection_px")[..., 0],
        status=status,
        views=np.nan_to_num(dense("views")[..., 0]).astype(np.int64),
    )


def middles(position: Float) -> Float:
    """Return the coordinate-wise medians [T, P, 3] of joints [T, P, J, 3]; NaN where none is known."""
    there = np.isfinite(position[..., 0]).any(axis=-1)
    middle = np.full((*position.shape[:2], 3), np.nan)
    middle[there] = np.nanmedian(position[there], axis=1)
    return middle


def errors_mm(motion: MeasuredMotion, truth: Float) -> Float:
    """Compute the distance of every measured joint from truth in mm, [T, P, J]; NaN if either is missing."""
    distance: Float = 1000 * np.linalg.norm(motion.measured_position - truth, axis=-1)
    return distance


def share_inside_95(motion: MeasuredMotion, truth: Float) -> float | None:
    """Compute the share of true joints inside the 95 % ellipsoids; None if nothing can be compared.

    e' S^-1 e of a Gaussian is chi-square with 3 degrees of freedom: a calibrated covariance gives 0.95.
    """
    error = motion.measured_position - truth
    usable = np.isfinite(error).all(axis=-1) & np.isfinite(motion.covariance).all(axis=-1)
    covariance = full_covariance(motion.covariance[usable])
    positive = np.linalg.eigvalsh(covariance)[:, 0] > 0
    if not positive.any():
        return None
    e = error[usable][positive]
    weighted = np.linalg.solve(covariance[positive], e[:, :, np.newaxis])[:, :, 0]
    squared = (e * weighted).sum(axis=1)
    return float(np.mean(squared < CHI2_95_OF_3))


_LIMBS = {
    "upper arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
    "trunk side": ("shoulder", "hip"),
    "thigh": ("hip", "knee"),
    "shank": ("knee", "ankle"),
}
_WATCHED = (
    *(
        (name, side, f"{side}_{start}", f"{side}_{end}")
        for name, (start, end) in _LIMBS.items()
        for side in ("left", "right")
    ),
    ("shoulders", "", "left_shoulder", "right_shoulder"),
    ("hips", "", "left_hip", "right_hip"),
)


@dataclass(frozen=True)
class Bone:
    """The length of one bone over a recording, in metres."""

    name: str
    side: str  # left, right, or empty for a bone across
    median_m: float
    low_m: float  # 10th percentile
    high_m: float  # 90th percentile
    spread: float  # half the central 68 % of the lengths, relative to the median: 0 for a rigid bone


def watched_bones(motion: MeasuredMotion) -> list[Bone]:
    """Measure the bones with both ends measured at some time, limb by limb, left before right."""
    there = [bone for bone in _WATCHED if set(bone[2:]) <= set(motion.joints)]
    lengths = bone_lengths(
        motion.measured_position, motion.joints, [(start, end) for *_, start, end in there]
    )
    bones = []
    for b, (name, side, *_) in enumerate(there):
        measured = lengths[..., b][np.isfinite(lengths[..., b])]
        if measured.size:
            low, p16, median, p84, high = (float(p) for p in np.percentile(measured, [10, 16, 50, 84, 90]))
            spread = (p84 - p16) / 2 / median if median > 0 else 0.0
            bones.append(Bone(name, side, median, low, high, spread))
    return bones


def standing_heights(motion: MeasuredMotion) -> Float:
    """Return the height [T, P] on which each person stands, m.

    It is the median over two seconds of the lowest measured joint; where nothing was measured, that of the
    last time before, else of the first after. Whoever was never measured stands as high as the others'
    median; without anybody it is 0.
    """
    height = motion.measured_position[..., 2]
    lowest = np.where(np.isfinite(height), height, np.inf).min(axis=-1)
    table = pd.DataFrame(np.where(np.isinf(lowest), np.nan, lowest), index=pd.to_datetime(motion.t_ns))
    near = table.rolling("2s", center=True, closed="both", min_periods=1).median()
    heights = near.ffill().bfill().to_numpy(np.float64)
    known = heights[np.isfinite(heights)]
    return np.where(np.isfinite(heights), heights, np.median(known) if len(known) else 0.0)
