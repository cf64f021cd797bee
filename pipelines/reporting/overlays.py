"""The skeleton reprojected into the pictures, beside the keypoints that were found there.

A few moments are shown, spread over the flight, always with the worst: that of the largest error where truth
is known, else of the largest disagreement of the views. Each camera shows its frame nearest to the moment,
with the skeleton and the logged pose interpolated to that frame's time. `views_of` does the same for any
stretch of a camera's frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Int64, Intrinsics, Picture, known_median, nearest_rows
from pipelines.geometry.cameras import project
from pipelines.geometry.poses import interpolate_points, matrix_from_quaternion
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.content import MeasuredMotion, SessionContent, estimated_clocks, number, section
from pipelines.reporting.summary import Summary
from pipelines.session.camera_poses import poses_at
from pipelines.session.description import Description, Interpolation
from pipelines.session.people import with_derived
from pipelines.session.records import Trajectory, full_covariance
from pipelines.session.stages import StageRecord
from pipelines.session.storage import read_json
from pipelines.session.tables import (
    CAMERA_POSES,
    KEYPOINTS,
    POSES,
    detections_from,
    read_table,
    trajectory_from,
)

ReadFrame = Callable[[str, int], Picture | None]
"""Function that returns the picture of a camera's frame; None where there is none."""

# More moments make the page larger and tell no more.
MOMENTS = 6
# The skeleton is not interpolated between times that are more than this many usual steps apart.
MAX_STEPS_INTERPOLATED = 1.5
# Among times with errors this close, the views decide which is the worst.
SAME_ERROR_MM = 1.0
# This part of a joint's depth is small against lens distortion and large against rounding.
DERIVATIVE_STEP = 1e-4
# A detection farther away than half of a body's size in the picture is another person.
SAME_PERSON_SHARE = 0.5


@dataclass(frozen=True)
class OverlayView:
    """The sight of one camera at a moment: P people of the skeleton with its J joints."""

    camera: str
    intrinsics: Intrinsics
    joints: tuple[str, ...]  # K: the skeleton's, then those derived of it
    frame: int
    t_s: float  # of the frame
    found: Float  # [P, J, 2] px; NaN where a joint was not found
    reprojected: Float  # [P, K, 2] px; NaN where a joint was not reconstructed, or there is no pose
    rejected: Bool  # [P, J] found, but the views of it disagreed
    unmeasured: Bool  # [P, J] found, but not reconstructed for another reason
    others: Float  # [D, J, 2] px: people who are not part of the skeleton
    has_pose: bool
    picture: Picture | None
    spread: Float | None = None  # [P, J, 2, 2] px^2 covariance of reprojected joints; NaN where unknown

    @property
    def residual_px(self) -> Float:
        """Distance [P, J] between found and reprojected joints; NaN where either is missing."""
        distance: Float = np.linalg.norm(self.found - self.reprojected[:, : self.found.shape[1]], axis=-1)
        return distance

    @property
    def median_px(self) -> float | None:
        """Median of `residual_px`; None where there are none."""
        known = self.residual_px[np.isfinite(self.residual_px)]
        return float(np.median(known)) if known.size else None


@dataclass(frozen=True)
class OverlayMoment:
    """All cameras at one time; cameras without a frame near it only by name."""

    t_s: float
    worst: bool
    error_mm: float | None  # the largest of a measured joint, where truth is known
    views: tuple[OverlayView, ...]
    without_frame: tuple[str, ...]


def collect_moments(
    content: SessionContent, summary: Summary, read_frame: ReadFrame | None
) -> tuple[OverlayMoment, ...]:
    """Collect the cameras' views at a few moments; nothing without a skeleton or without keypoints."""
    motion = summary.motion
    if motion is None or not motion.measured.any():
        return ()
    cameras = filmed_cameras(content)
    if not cameras:
        return ()
    chosen, worst = choose_moments(motion, summary.errors_mm)
    moments = []
    for row in chosen:
        t_ns = int(motion.t_ns[row])
        views, without_frame = list[OverlayView](), list[str]()
        for camera in cameras:
            if (at := camera.nearest_frame(t_ns)) is None:
                without_frame.append(camera.name)
                continue
            (view,) = views_of(camera, np.array([at]), motion, motion.status[[row]], summary.origin_ns)
            picture = None if read_frame is None else read_frame(view.camera, view.frame)
            views.append(replace(view, picture=picture))
        t_s, error_mm = (t_ns - summary.origin_ns) / 1e9, _largest_mm(summary.errors_mm, row)
        moments.append(OverlayMoment(t_s, row == worst, error_mm, tuple(views), tuple(without_frame)))
    return tuple(moments)


def filmed_cameras(content: SessionContent) -> list[FilmedCamera]:
    """Collect the cameras that have keypoints."""
    least = number(section(content.stages.get("reconstruct", {}), "settings"), "min_confidence") or 0.0
    return [
        FilmedCamera.of(
            name, content.session, content.frames[name], content.keypoints[name], least, content.poses[name]
        )
        for name in content.session.cameras
        if name in content.keypoints
    ]


def residuals_over_time(
    content: SessionContent, summary: Summary, most: int
) -> dict[str, tuple[Float, Float]]:
    """Compute each camera's median distance of keypoints and joints: times [N] s and medians [N] px."""
    motion = summary.motion
    if motion is None or not motion.measured.any():
        return {}
    found = {}
    for camera in filmed_cameras(content):
        every = max(1, -(-len(camera.frame) // most))
        at = np.arange(0, len(camera.frame), every)
        status = status_at(motion, camera.frame_t_ns[at])
        views = views_of(camera, at, motion, status, summary.origin_ns)
        medians = [np.nan if view.median_px is None else view.median_px for view in views]
        found[camera.name] = ((camera.frame_t_ns[at] - summary.origin_ns) / 1e9, np.array(medians))
    return found


def _largest_mm(error_mm: Float | None, row: int) -> float | None:
    known = np.empty(0) if error_mm is None else error_mm[row][np.isfinite(error_mm[row])]
    return float(known.max()) if known.size else None


def choose_moments(motion: MeasuredMotion, error_mm: Float | None = None) -> tuple[list[int], int]:
    """Choose rows of the motion to show, in order, and the worst of them.

    Each of `MOMENTS` equal stretches gives the time with the most joints, nearest its middle, and the worst
    one itself: that of the largest error of a measured joint where truth is known (`error_mm` [T, P, J]),
    since views may agree on swapped legs, else that of the largest median reprojection error among the times
    with at least half of the most joints, just before and after as well.
    """
    count = motion.measured.sum(axis=(1, 2))
    around = np.concatenate([count[:1], count, count[-1:]])
    steady = np.minimum(np.minimum(around[:-2], around[2:]), count)
    error = known_median(np.where(motion.measured, motion.reprojection_px, np.nan).reshape(len(count), -1), 1)
    eligible = np.isfinite(error) & (steady >= steady.max() / 2)
    if error_mm is not None and np.isfinite(error_mm).any():
        largest = np.nan_to_num(error_mm, nan=-np.inf).max(axis=(1, 2))
        as_large = largest > largest.max() - SAME_ERROR_MM
        eligible = eligible & as_large if (eligible & as_large).any() else as_large
        error = np.nan_to_num(error)
    worst = int(np.argmax(np.where(eligible, error, -1.0) if eligible.any() else count))
    chosen = []
    for rows in np.array_split(np.arange(len(count)), min(MOMENTS, len(count))):
        fullest = rows[steady[rows] == steady[rows].max()]
        middle = int(fullest[np.argmin(np.abs(fullest - rows.mean()))])
        if worst in rows:
            chosen.append(worst)
        elif count[middle]:
            chosen.append(middle)
    return chosen, worst


def match_people(reprojected: Float, found: Float) -> list[int | None]:
    """Match people [P, J, 2] px to the nearest detections [D, J, 2], each once; None beyond half a body."""
    matches: list[int | None] = []
    for body in reprojected:
        distance = known_median(np.linalg.norm(found - body, axis=-1), 1)
        distance[[match for match in matches if match is not None]] = np.nan
        seen = body[np.isfinite(body).all(axis=-1)]
        reach = SAME_PERSON_SHARE * float(np.linalg.norm(np.ptp(seen, axis=0))) if len(seen) else 0.0
        near = np.isfinite(distance) & (distance <= reach)
        matches.append(int(np.argmin(np.where(near, distance, np.inf))) if near.any() else None)
    return matches


@dataclass(frozen=True)
class FilmedCamera:
    """Frames F, poses and detected keypoints of one camera."""

    name: str
    intrinsics: Intrinsics
    frame: Int64  # [F]
    frame_t_ns: Int64  # [F]
    keypoints: pd.DataFrame  # tables.KEYPOINTS
    track: Trajectory
    static: bool  # the first pose of the track holds all the time
    between: Interpolation  # limits of the track's interpolation

    @classmethod
    def of(
        cls,
        name: str,
        description: Description,
        frames: pd.DataFrame,
        keypoints: pd.DataFrame,
        least: float,
        poses: pd.DataFrame,
    ) -> FilmedCamera:
        """Take a camera from its tables; keypoints below the least confidence were not used."""
        entry = description.cameras[name]
        return cls(
            name=name,
            intrinsics=entry.intrinsics,
            frame=frames["frame"].to_numpy(np.int64),
            frame_t_ns=frames["t_ns"].to_numpy(np.int64),
            keypoints=keypoints[keypoints["confidence"] >= least],
            track=trajectory_from(poses),
            static=entry.poses.static,
            between=description.pose_interpolation,
        )

    def nearest_frame(self, t_ns: int) -> int | None:
        """Return the row of the frame nearest to a time; None where none lies within a frame period."""
        nearest = int(np.argmin(np.abs(self.frame_t_ns - t_ns)))
        period = int(np.median(np.diff(self.frame_t_ns))) if len(self.frame_t_ns) > 1 else 0
        return nearest if abs(int(self.frame_t_ns[nearest]) - t_ns) <= period else None

    def people_in(self, frames: Int64, joints: tuple[str, ...]) -> list[Float]:
        """Return the detections in each of these frames, [D, J, 2] px; NaN for joints not found."""
        people = detections_from(self.keypoints[self.keypoints["frame"].isin(frames)], joints)
        first, behind = (np.searchsorted(people.frame, frames, side=side) for side in ("left", "right"))
        return [people.xy[start:stop] for start, stop in zip(first, behind, strict=True)]

    def poses_at(self, t_ns: Int64) -> tuple[Float, Float]:
        """Interpolate world_from_camera at times [N]: position [N, 3], rotation [N, 3, 3], NaN if none."""
        position, quaternion = poses_at(self.track, t_ns, self.between, static=self.static)
        return position, matrix_from_quaternion(quaternion)


def status_at(motion: MeasuredMotion, t_ns: Int64) -> NDArray[np.int8]:
    """Return every joint's status nearest to each of [N] times, [N, P, J]; -1 where nothing is near."""
    held = np.clip(t_ns, motion.t_ns[0], motion.t_ns[-1])
    before = np.searchsorted(motion.t_ns, held, side="right") - 1
    after = np.minimum(before + 1, len(motion.t_ns) - 1)
    step, since = motion.t_ns[after] - motion.t_ns[before], held - motion.t_ns[before]
    known = (held == t_ns) & ((since == 0) | (step <= _longest_step_ns(motion)))
    return np.where(known[:, None, None], motion.status[nearest_rows(motion.t_ns, t_ns)], np.int8(-1))


def angles_at(motion: MeasuredMotion, angles: pd.DataFrame, name: str, t_ns: Int64) -> Float:
    """Interpolate an angle and its deviation to times [N]: [N, P, 2] deg, NaN beside what is undetermined."""
    own = angles[angles["angle"] == name]
    times, persons = (np.unique(angles[column]) for column in ("t_ns", "person"))
    values = np.full((len(times), len(persons), 2), np.nan)
    cell = (np.searchsorted(times, own["t_ns"]), np.searchsorted(persons, own["person"]))
    values[cell] = own[["value_deg", "sigma_deg"]]
    turned = np.radians(values[..., 0])
    parts = np.stack([np.cos(turned), np.sin(turned), values[..., 1]], axis=-1)
    along, across, sigma = np.moveaxis(
        interpolate_points(times, parts, t_ns, max_gap_ns=_longest_step_ns(motion)), -1, 0
    )
    return np.stack([np.degrees(np.arctan2(across, along)), sigma], axis=-1)


def views_of(
    camera: FilmedCamera, at: Int64, motion: MeasuredMotion, status: NDArray[np.int8], origin_ns: int
) -> list[OverlayView]:
    """Reproject the skeleton into frames `at` [N] of a camera, beside the detections; no pictures."""
    frame, t_ns = camera.frame[at], camera.frame_t_ns[at]
    skeleton = interpolate_points(
        motion.t_ns, motion.measured_position, t_ns, max_gap_ns=_longest_step_ns(motion)
    )
    joints, points = with_derived(motion.joints, skeleton)
    position, rotation = camera.poses_at(t_ns)
    seen = (points - position[:, None, None]) @ rotation[:, None]
    reprojected = project(seen, camera.intrinsics)
    stated = np.where(motion.measured[..., None], motion.covariance, np.nan)[nearest_rows(motion.t_ns, t_ns)]
    spread = seen_spread(
        seen[..., : len(motion.joints), :], stated, rotation[:, None, None], camera.intrinsics
    )
    views = []
    for n, people in enumerate(camera.people_in(frame, motion.joints)):
        matches = match_people(reprojected[n, :, : len(motion.joints)], people)
        nobody = np.full((len(motion.joints), 2), np.nan)
        found = np.stack([nobody if match is None else people[match] for match in matches])
        lost = np.isfinite(found[..., 0]) & np.isnan(skeleton[n, ..., 0])
        rejected = lost & (status[n] == STATUS.index("rejected"))
        views.append(
            OverlayView(
                camera=camera.name,
                intrinsics=camera.intrinsics,
                joints=joints,
                frame=int(frame[n]),
                t_s=(int(t_ns[n]) - origin_ns) / 1e9,
                found=found,
                reprojected=reprojected[n],
                rejected=rejected,
                unmeasured=lost & ~rejected,
                others=people[[d for d in range(len(people)) if d not in matches]],
                has_pose=bool(np.isfinite(position[n]).all()),
                picture=None,
                spread=spread[n],
            )
        )
    return views


def seen_spread(points: Float, covariance: Float, world_from_camera: Float, lens: Intrinsics) -> Float:
    """Propagate the covariance of joints [..., 6] m^2 (world, upper triangle) into a picture: J R' S R J'.

    It is that of the joints alone, [..., 2, 2] px^2, NaN where a number is missing: the camera's pose is
    exact. Points [..., 3] m are in the camera; J is the lens's derivative there, by central differences.
    """
    step = DERIVATIVE_STEP * np.abs(points[..., 2])[..., None]
    columns = [
        (project(points + step * axis, lens) - project(points - step * axis, lens)) / (2 * step)
        for axis in np.eye(3)
    ]
    derivative = np.stack(columns, axis=-1) @ np.swapaxes(world_from_camera, -1, -2)
    return derivative @ full_covariance(covariance) @ np.swapaxes(derivative, -1, -2)


def _longest_step_ns(motion: MeasuredMotion) -> int:
    """Return the longest step of the skeleton's times that is interpolated."""
    usual_ns = float(np.median(np.diff(motion.t_ns))) if len(motion.t_ns) > 1 else 0.0
    return round(MAX_STEPS_INTERPOLATED * usual_ns)


def refined_poses(folder: Path, record: StageRecord) -> dict[str, Trajectory]:
    """Read the poses of the cameras that a session's reconstruction, of this record, refined."""
    name = "reconstruct/cameras.parquet"
    if name not in record.outputs:
        return {}
    table = read_table(folder / name, CAMERA_POSES)
    return {str(name): trajectory_from(own.sort_values("t_ns")) for name, own in table.groupby("camera")}


def read_filmed(
    folder: Path, description: Description, record: StageRecord, frames: Mapping[str, pd.DataFrame]
) -> dict[str, FilmedCamera]:
    """Read cameras with logged or refined poses, frames by estimated clocks, and confident keypoints."""
    offset_ns = estimated_clocks(read_json(folder / "reconstruct" / "metrics.json"))
    refined = refined_poses(folder, record)
    filmed = {}
    for name, table in frames.items():
        stage = "cameras" if description.cameras[name].keypoints is not None else "detect"
        keypoints = read_table(folder / stage / name / "keypoints.parquet", KEYPOINTS)
        poses = read_table(folder / "cameras" / name / "poses.parquet", POSES)
        shifted = table.assign(t_ns=table["t_ns"] + offset_ns.get(name, 0))
        camera = FilmedCamera.of(
            name, description, shifted, keypoints, record.settings["min_confidence"], poses
        )
        filmed[name] = replace(camera, track=refined.get(name, camera.track))
    return filmed
