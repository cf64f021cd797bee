"""Parts of a flight as they were read, and as a session stores them: tables, entries, doubts."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np

from pipelines.geometry.arrays import Bool, ClockFit, Int64, Intrinsics
from pipelines.geometry.poses import gaps
from pipelines.session.camera_poses import poses_at
from pipelines.session.description import (
    CameraEntry,
    ClockEntry,
    FramesEntry,
    Interpolation,
    KeypointsEntry,
    MediaEntry,
    MountEntry,
    PictureMapEntry,
    PlaceEntry,
    PosesEntry,
)
from pipelines.session.errors import DataError
from pipelines.session.manifest import PICTURES, Axes, CameraSources
from pipelines.session.records import Detections, Trajectory
from pipelines.session.tables import (
    FRAMES,
    KEYPOINTS,
    frames_table,
    keypoints_table,
    pose_schema,
    pose_table,
    write_table,
)
from pipelines.session.urls import named
from pipelines.sources.world import losses, mounted

# A video that covers less of its pose log may have lost its end.
MIN_COVERED_SHARE = 0.9


# Logs run on for about a second after the video of a short flight.
MIN_UNCOVERED_S = 1.0


@dataclass(frozen=True)
class CameraFrames:
    """Pictures of a camera in world time; numbers and times strictly increase."""

    frame: Int64  # [F] frame numbers as in the keypoints
    t_ns: Int64  # [F]
    pts_ns: Int64  # [F] since the first picture of the video
    topic: str | None = None  # the topic of the log that holds the pictures themselves
    dropped: dict[str, int] = field(default_factory=dict)  # pictures that were left out, by cause

    def some(self, which: Bool | slice, t_ns: Int64, lost: Counter[str]) -> Self:
        """Return some of the frames at other times, with all losses."""
        frame, pts_ns = self.frame[which], self.pts_ns[which]
        return replace(self, frame=frame, t_ns=t_ns, pts_ns=pts_ns, dropped=dict(+lost))


@dataclass(frozen=True)
class CameraData:
    """Data of one camera, as read."""

    detections: Detections | None
    detector_format: str
    intrinsics: Intrinsics
    frames: CameraFrames
    trajectory: Trajectory
    media: MediaEntry | None
    log_clock: ClockFit | None
    still: bool  # it stands still, with one pose
    notes: list[str]
    pose_noise: dict[str, dict[str, float | str]] | None
    stamps: str | None  # of a log of poses
    axes: tuple[Axes, Axes]  # of poses, and of a gimbal's angles
    picture_map: PictureMapEntry | None = None


def store_camera(data: CameraData, folder: Path) -> None:
    """Write the tables of one camera."""
    frames, poses = data.frames, data.trajectory
    write_table(folder / "frames.parquet", frames_table(frames.frame, frames.t_ns, frames.pts_ns), FRAMES)
    write_table(folder / "poses.parquet", pose_table(poses), pose_schema(poses))
    if data.detections is not None:
        keypoints = keypoints_table(data.detections, frames.frame, frames.t_ns)
        write_table(folder / "keypoints.parquet", keypoints, KEYPOINTS)


def camera_entry(
    name: str,
    camera: CameraSources,
    data: CameraData,
    interpolation: Interpolation,
    base: Path,
    note: Callable[[str], None],
) -> CameraEntry:
    """Describe a camera for session.json, and note doubts and losses; DataError: no frame has a pose."""
    frames = data.frames
    entry = CameraEntry(
        intrinsics=data.intrinsics,
        frames=FramesEntry(
            count=len(frames.t_ns),
            first_t_ns=int(frames.t_ns[0]),
            last_t_ns=int(frames.t_ns[-1]),
            rate_hz=_rate(frames.t_ns),
            dropped=frames.dropped,
        ),
        poses=_poses_entry(name, camera, data, interpolation, base, note),
        keypoints=_keypoints_entry(camera, data),
        clock=ClockEntry(
            offset_s=camera.clock.offset_ns / 1e9 if camera.clock else 0.0,
            sigma_s=camera.clock.sigma_s if camera.clock else 0.0,
            start=_clock_start(camera, frames),
        ),
        log_clock=data.log_clock,
        pose_noise=data.pose_noise,
        media=data.media,
        picture_map=data.picture_map,
    )
    for part, dropped in (
        ("frames", entry.frames.dropped),
        ("poses", entry.poses.dropped),
        ("keypoints", entry.keypoints.dropped if entry.keypoints else {}),
    ):
        if dropped:
            note(f"{name}: {part} dropped: {losses(dropped)}")
    if entry.keypoints and entry.keypoints.adjusted:
        note(f"{name}: keypoints adjusted: {losses(entry.keypoints.adjusted)}")
    return entry


def _poses_entry(
    name: str,
    camera: CameraSources,
    data: CameraData,
    interpolation: Interpolation,
    base: Path,
    note: Callable[[str], None],
) -> PosesEntry:
    pose, trajectory, frames_t_ns = camera.pose, data.trajectory, data.frames.t_ns
    static = data.still
    without_pose = 0
    if not static:
        position, _ = poses_at(trajectory, frames_t_ns, interpolation)
        without_pose = int(np.isnan(position[:, 0]).sum())
        if without_pose == len(frames_t_ns):
            frames, poses = (span_words(*t_ns[[0, -1]]) for t_ns in (frames_t_ns, trajectory.t_ns))
            problem = (
                f"has a pose for none of the {without_pose} frames of camera {name}: frames span {frames},"
                f" poses {poses} at {_rate(trajectory.t_ns) or 0:.3g} Hz"
            )
            apart_ns = max(frames_t_ns[0] - trajectory.t_ns[-1], trajectory.t_ns[0] - frames_t_ns[-1])
            if apart_ns > 0:
                remedy = (
                    f"log and film share no time: say when the film began on the log's clock,"
                    f" cameras.{name}.frame_times.start: {trajectory.t_ns[0] / 1e9:.3f} for example, or move"
                    " the log with logs: {NAME: {clock: {offset_s: SECONDS}}}"
                )
                raise DataError(named(base, pose.file), problem, remedy, code="no-overlap")
            remedy = "its poses are too far apart: raise --max-pose-gap, or check the unit of its times"
            raise DataError(named(base, pose.file), problem, remedy, code="no-poses")
        if without_pose:
            note(
                f"{name}: {without_pose} of {len(frames_t_ns)} frames have no pose (no logged pose within"
                f" {interpolation.max_gap_s:g} s gaps and {interpolation.max_extrapolation_s:g} s"
                " at the ends)"
            )
        span, covered = int(np.ptp(trajectory.t_ns)) / 1e9, int(np.ptp(frames_t_ns)) / 1e9
        if covered < MIN_COVERED_SHARE * span and span - covered > MIN_UNCOVERED_S:
            fps = camera.frame_times and camera.frame_times.fps
            rate = f"; is cameras.{name}.frame_times.fps: {float(fps):g} right?" if fps else ""
            note(f"{name}: its pictures cover {covered:.1f} s of {span:.1f} s of poses{rate}")
    return PosesEntry(
        source=pose.file or PICTURES,
        static=static,
        count=len(trajectory.t_ns),
        rate_hz=_rate(trajectory.t_ns),
        gaps_ns=[] if static else gaps(trajectory.t_ns, interpolation.max_gap_ns),
        frames_without_pose=without_pose,
        dropped=trajectory.dropped,
        stamps=data.stamps,
        topic=pose.topic,
        gimbal=_gimbal_of(camera),
        gimbal_fixed=camera.gimbal is not None and camera.gimbal.is_fixed,
        gimbal_axes=data.axes[1],
        gimbal_log=(camera.gimbal.file or None) if camera.gimbal is not None else None,
        gimbal_topic=camera.gimbal.topic if camera.gimbal is not None else None,
        axes=data.axes[0],
        mount=None if camera.gimbal else _mount_entry(camera),
        in_gimbal=_mount_entry(camera) if camera.gimbal else None,
        inverse=bool(pose.options.get("inverse")),
        z="down" if pose.options.get("z") == "down" else "up",
        world_from_source=PlaceEntry.model_validate(pose.world_from_source.model_dump()),
    )


def _gimbal_of(camera: CameraSources) -> str | None:
    """Return what the stated angles of a gimbal are relative to; None without such angles."""
    gimbal = camera.gimbal
    if gimbal is None or (gimbal.topic is None and not gimbal.is_fixed):
        return None
    return gimbal.relative_to or "world"


def _keypoints_entry(camera: CameraSources, data: CameraData) -> KeypointsEntry | None:
    detections = data.detections
    if camera.keypoints is None or detections is None:
        return None
    frames, people = np.unique(detections.frame, return_counts=True)
    return KeypointsEntry(
        source=camera.keypoints.file,
        format=data.detector_format,
        joints=list(detections.joints),
        detections=len(detections.frame),
        people_at_once=int(people.max()),
        frames_without_person=len(data.frames.t_ns) - len(frames),
        dropped=detections.dropped,
        adjusted=detections.adjusted,
        mirrored=camera.keypoints.mirrored,
    )


def _clock_start(camera: CameraSources, frames: CameraFrames) -> Literal["stated", "assumed", "none"]:
    """Return if the manifest, or a file or log that it names, states when the pictures were taken."""
    times, clock = camera.frame_times, camera.clock
    if (times and times.assumed) or (clock and clock.assumed):
        return "assumed"
    if clock or frames.topic or (times and times.is_placed):
        return "stated"
    return "none"


def _mount_entry(camera: CameraSources) -> MountEntry | None:
    """Describe how a camera is fixed to what turns it; None where nothing is said of that."""
    if camera.mount is None:
        return None
    translation, rotation_xyzw = mounted(camera.mount)
    return MountEntry(translation=tuple(translation.tolist()), rotation_xyzw=tuple(rotation_xyzw.tolist()))


def _rate(t_ns: Int64) -> float | None:
    return 1e9 * (len(t_ns) - 1) / float(t_ns[-1] - t_ns[0]) if len(t_ns) > 1 else None


def span_of_pictures(entries: Mapping[str, CameraEntry]) -> tuple[int, int]:
    """Return the first and the last frame time of all cameras, ns."""
    frames = [entry.frames for entry in entries.values()]
    return min(each.first_t_ns for each in frames), max(each.last_t_ns for each in frames)


def span_words(first_ns: int, last_ns: int) -> str:
    """Format a time span for messages."""
    return f"{first_ns / 1e9:.3f} to {last_ns / 1e9:.3f} s"


def refuse_no_overlap(source: Path | str, t_ns: Int64, entries: Mapping[str, CameraEntry]) -> None:
    """Refuse times [N] that are all before or all after the pictures of all cameras."""
    first, last = span_of_pictures(entries)
    if t_ns[0] > last or t_ns[-1] < first:
        problem = f"spans {span_words(t_ns[0], t_ns[-1])}, the pictures {span_words(first, last)}"
        raise DataError(source, problem, "check its time base: stamps are world times", code="no-overlap")
