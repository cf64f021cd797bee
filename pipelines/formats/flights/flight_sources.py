"""What a manifest names, read as records: in world axes (ENU), at world times, of the picture's size.

Everything a user may have got wrong between two sources shows here, and is refused with the file at fault
or said as a note.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Literal, Self

import numpy as np

from pipelines.formats.flights.flight_logs import FlightLogs, Frames, in_world
from pipelines.formats.flights.gimbal_angles import attitudes_at, stated_angles
from pipelines.formats.flights.telemetry_poses import Origin, TelemetryPoses
from pipelines.formats.logs.map_topics import LoggedMaps
from pipelines.formats.maps.ros_map import FORMAT as ROS_MAP
from pipelines.formats.videos.frame_times import read_frame_times, times_of_frames
from pipelines.formats.videos.picture_motion import turning_of_pictures
from pipelines.formats.videos.video import created_ns
from pipelines.geometry.cameras import Intrinsics, fit_to_size
from pipelines.geometry.clocks import ClockFit
from pipelines.geometry.mounting import (
    body_from_camera,
    compose_gimbal,
    compose_mount,
    flu_body_from_frd,
)
from pipelines.geometry.pose_covariance import carried_covariance, mounted_covariance
from pipelines.geometry.poses import enu_from_ned
from pipelines.geometry.turning import fit_start
from pipelines.session.description import MediaEntry
from pipelines.session.errors import DataError
from pipelines.session.manifest import (
    Axes,
    Camera,
    Flight,
    FrameTimes,
    IntrinsicsSource,
    KeypointSource,
    Map,
    Mount,
    Plan,
    TruthJoints,
)
from pipelines.session.records import (
    CalibratedCamera,
    Detections,
    Float,
    Int64,
    JointMotion,
    Occupancy,
    Trajectory,
    VideoIndex,
)
from pipelines.session.registries import (
    FORMATS,
    CalibrationFormat,
    JointFormat,
    KeypointFormat,
    MapFormat,
    TrajectoryFormat,
    VideoFormat,
    recognise,
)

_MOST_FRAMES = 20_000_000  # a week at 30 Hz: more is a frame number misread from a date
_WATCHED_NS = 120 * 10**9  # of a video, to find out when it began
_LARGEST_SHARE_OUTSIDE = 0.05  # of keypoints beyond the picture; detectors overshoot the border a little


@dataclass(frozen=True)
class CameraFrames:
    """The pictures of a camera in world time; numbers and times strictly increase."""

    frame: Int64  # [F] numbers, as keypoints count them
    t_ns: Int64  # [F]
    pts_ns: Int64  # [F] since the first picture of the video
    topic: str | None = None  # the pictures themselves lie in this topic of a log
    dropped: dict[str, int] = field(default_factory=dict)  # pictures that are not among them, by cause
    start_sigma_s: float = 0.0  # of all times together, where it was found out


class FlightSources:
    """Reads the parts of one flight; a context manager that closes the logs.

    Args:
        flight: the manifest.
        manifest: its path.
        max_gap_ns: the longest stretch between two logged poses or angles that is bridged.
        note: told what was chosen and what is doubtful, one line each.
    """

    def __init__(
        self, flight: Flight, manifest: Path, *, max_gap_ns: int, note: Callable[[str], None]
    ) -> None:
        self._flight = flight
        self._manifest = manifest
        self._base = manifest.parent
        self._max_gap_ns = max_gap_ns
        self._note = note
        self._logs = FlightLogs(flight, self._base, note)
        self._telemetry = TelemetryPoses(flight, manifest, self._logs, max_gap_ns=max_gap_ns, note=note)
        self._calibrations: dict[str, dict[str, CalibratedCamera]] = {}

    def __enter__(self) -> Self:
        """The sources themselves."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the logs."""
        self._logs.__exit__(*exception)

    def origin(self) -> Origin | None:
        """Where on Earth the world lies, where that is known; heights that do not go together are noted."""
        self._telemetry.doubt_heights()
        return self._telemetry.origin()

    def log_clock(self, camera: Camera) -> ClockFit | None:
        """How the clock of a drone's own log was taken to GPS time; None where it was not."""
        return self._telemetry.fit(camera.pose) if camera.pose.is_telemetry else None

    def stamps(self, log: str) -> str:
        """Which stamps of a log's messages count: header or receive."""
        return self._logs.settings(log).stamps

    # --- keypoints and pictures ------------------------------------------------------------------------

    def keypoints(self, source: KeypointSource) -> tuple[Detections, str]:
        """The keypoints that came with a camera, and the name of their format."""
        path = self._base / source.path
        if source.format:
            reader = FORMATS.get(source.format)
            if not isinstance(reader, KeypointFormat):
                raise DataError(path, f"{source.format} is no keypoint format", "leave `format:` out")
        else:
            reader = recognise(path, KeypointFormat, "keypoint file")
        detections = reader.read_keypoints(path, skeleton=source.skeleton, first_frame=source.first_frame)
        if not len(detections.frame):
            raise DataError(path, "holds no keypoints", "run the detector again, or leave the camera out")
        if source.image_size:
            detections = replace(detections, image_size=(source.image_size[0], source.image_size[1]))
        return detections, reader.name

    def video(self, camera: Camera) -> VideoIndex | None:
        """The index of a camera's video file; None where it has none."""
        if camera.video is None or camera.video.path is None:
            return None
        path = self._base / camera.video.path
        return recognise(path, VideoFormat, "video").index(path)

    def frames(
        self,
        name: str,
        camera: Camera,
        video: VideoIndex | None,
        detections: Detections | None,
        intrinsics: Intrinsics,
    ) -> CameraFrames:
        """When each picture was taken.

        By what the manifest states: `fps` from `start` on, a file or topic of frame times, the stamps of
        pictures in a log, or the container's own stamps from `start` on. Where the start is to be found by
        motion, it is the time at which the pictures turn as the poses do.

        Raises:
            DataError: nothing says when the pictures were taken, or what does is unusable.
        """
        offset_ns = camera.clock.offset_ns if camera.clock else 0
        unclocked = self._unclocked_frames(name, camera, video, detections)
        if camera.frame_times and camera.frame_times.start_from == "motion":
            unclocked = self._begun_by_motion(name, camera, unclocked, intrinsics)
        return replace(unclocked, t_ns=unclocked.t_ns + offset_ns)

    def _unclocked_frames(
        self, name: str, camera: Camera, video: VideoIndex | None, detections: Detections | None
    ) -> CameraFrames:
        times = camera.frame_times or FrameTimes()
        logged = None
        if camera.video is not None and camera.video.log is not None:
            logged = self._logs.frames(camera.video.log, camera.video.topic)
        pictures = _pictures(video, logged)
        if times.fps is not None:
            count = len(pictures.t_ns) if pictures else self._listed_frames(camera, detections)
            since_start = _ticks_ns(count, times.fps)
            topic, lost = (pictures.topic, pictures.dropped) if pictures else (None, {})
            start_ns = self._start_ns(name, camera, times)
            return CameraFrames(np.arange(count), start_ns + since_start, since_start, topic, lost)
        if times.csv or times.srt:
            return self._frames_of_file(self._base / (times.csv or times.srt or ""), pictures)
        if times.log is not None:
            triggers = self._logs.triggers(times.log, times.topic)
            stamped = triggers or self._logs.frames(times.log, times.topic)
            return self._frames_by_stamps(stamped.t_ns, stamped.dropped, pictures)
        if times.ulog or times.ardupilot:
            kind: Literal["ulog", "ardupilot"] = "ulog" if times.ulog else "ardupilot"
            triggered = self._telemetry.triggers(kind, times.ulog or times.ardupilot or "")
            return self._frames_by_stamps(triggered, {}, pictures)
        if pictures is None:
            raise DataError(
                self._manifest,
                f"cameras.{name}: nothing says when its frames were taken",
                "write frame_times: {start: SECONDS, fps: 30}",
            )
        if logged is None:
            return replace(pictures, t_ns=self._start_ns(name, camera, times) + pictures.pts_ns)
        if times.start_ns:
            raise DataError(
                self._manifest,
                f"cameras.{name}.frame_times: start has no use, the log stamps its pictures",
                "leave it out, or correct the log's clock with logs: {...: {clock: ...}}",
            )
        return pictures

    def media(self, camera: Camera, frames: CameraFrames, session: Path) -> MediaEntry | None:
        """Where the pictures lie, as seen from the session: it is moved together with its flight."""
        video = camera.video
        if video is None:
            return None
        stated = self._logs.settings(video.log).path if video.log else [video.path or ""]
        return MediaEntry(
            paths=[Path(os.path.relpath(self._base / path, session)).as_posix() for path in stated],
            sources=stated,
            topic=frames.topic,
            stamps=self._logs.settings(video.log).stamps if video.log else "header",
        )

    def _listed_frames(self, camera: Camera, detections: Detections | None) -> int:
        if detections is None or camera.keypoints is None:
            raise DataError(
                self._manifest, "a camera without video and keypoints has no frames", "give it one of them"
            )
        count = int(detections.frames_listed[-1]) + 1
        if count > _MOST_FRAMES:
            raise DataError(
                self._base / camera.keypoints.path,
                f"numbers its frames up to {count - 1}",
                "say with first_frame which number the first frame bears",
            )
        return count

    def _frames_of_file(self, path: Path, pictures: CameraFrames | None) -> CameraFrames:
        stamps = read_frame_times(path)
        if pictures is None:
            since_start = stamps.t_ns - stamps.t_ns[0]
            return CameraFrames(stamps.frame, stamps.t_ns, since_start, dropped=stamps.dropped)
        t_ns, known = times_of_frames(stamps, pictures.pts_ns)
        if not known.any():
            raise DataError(path, "has a time for none of the pictures", "check that they belong together")
        lost = Counter(pictures.dropped) + Counter(stamps.dropped)
        lost["without a time"] += int((~known).sum())
        return replace(
            pictures,
            frame=pictures.frame[known],
            t_ns=t_ns[known],
            pts_ns=pictures.pts_ns[known],
            dropped=dict(+lost),
        )

    def _start_ns(self, name: str, camera: Camera, times: FrameTimes) -> int:
        """When a video begins that has stamps of its own."""
        if times.start_from == "motion":
            if times.start_ns:
                place = f"{self._manifest}: cameras.{name}.frame_times"
                raise DataError(place, "has a start and start_from: motion", "leave one of them out")
            return 0  # found when the pictures and the poses are there
        if times.start_from is None:
            return times.start_ns
        path = self._base / (camera.video.path or "") if camera.video else None
        made_ns = created_ns(path) if path is not None and camera.video and camera.video.path else None
        if made_ns is None:
            raise DataError(
                path or self._manifest,
                "does not say when it was made",
                f"write frame_times: {{start: SECONDS}} for camera {name}",
            )
        if camera.clock is None:
            self._note(
                f"{name}: its video says that it was made at {made_ns / 1e9:.0f} s, to a second at best:"
                " say clock: {sigma_s: 1}"
            )
        return times.start_ns + made_ns

    def _begun_by_motion(
        self, name: str, camera: Camera, frames: CameraFrames, intrinsics: Intrinsics
    ) -> CameraFrames:
        """Frames of a video at the times at which its pictures turn as the poses do."""
        place = f"{self._manifest}: cameras.{name}.frame_times"
        remedy = "say start: SECONDS instead, or give the stamps of a log"
        if camera.video is None or camera.video.path is None or camera.pose.static:
            raise DataError(place, "start_from: motion needs a video and poses that move", remedy)
        poses = self.trajectory(name, camera, 0)
        some = int(np.searchsorted(frames.pts_ns, frames.pts_ns[0] + _WATCHED_NS))
        turned = turning_of_pictures(self._base / camera.video.path, intrinsics, some)
        try:
            fit = fit_start(
                poses.t_ns,
                poses.quaternion_xyzw,
                frames.pts_ns[:some],
                turned,
                max_gap_ns=self._max_gap_ns,
            )
        except ValueError as error:
            problem = f"its pictures do not say when the video began: {error}"
            raise DataError(place, problem, remedy) from None
        self._note(
            f"{name}: its video begins at {fit.start_ns / 1e9:.3f} s +- {1e3 * fit.sigma_s:.1f} ms, by the"
            f" turning of its pictures ({fit.turning_deg_s:.2g} deg/s, of which the poses explain"
            f" {fit.explained:.0%})"
        )
        return replace(frames, t_ns=fit.start_ns + frames.pts_ns, start_sigma_s=fit.sigma_s)

    def _frames_by_stamps(
        self, t_ns: Int64, dropped: dict[str, int], pictures: CameraFrames | None
    ) -> CameraFrames:
        """Frame times that a log states, for the frames of a video in the same order."""
        if pictures is None:
            since_start = t_ns - t_ns[0]
            return CameraFrames(np.arange(len(since_start)), t_ns, since_start, dropped=dropped)
        count = min(len(pictures.t_ns), len(t_ns))
        lost = Counter(pictures.dropped) + Counter(dropped)
        lost["without a stamp in the log"] += len(pictures.t_ns) - count
        lost["stamp in the log without a picture"] += len(t_ns) - count
        return replace(
            pictures,
            frame=pictures.frame[:count],
            t_ns=t_ns[:count],
            pts_ns=pictures.pts_ns[:count],
            dropped=dict(+lost),
        )

    # --- calibration -----------------------------------------------------------------------------------

    def intrinsics(
        self, name: str, camera: Camera, video: VideoIndex | None, detections: Detections | None
    ) -> Intrinsics:
        """The intrinsics of a camera, fitted to the size of its pictures.

        Raises:
            DataError: not there, of pictures of another shape, or too small for the keypoints.
        """
        source = camera.intrinsics
        place = f"{self._manifest}: cameras.{name}.intrinsics"
        if source.path:
            calibrated = self._calibrated(name, source.path, source.camera)
            if calibrated.intrinsics is None:
                raise DataError(
                    self._base / source.path, "holds poses but no intrinsics", "name one with both"
                )
            intrinsics = calibrated.intrinsics
        elif source.log:
            intrinsics = self._logs.intrinsics(source.log, source.topic).intrinsics
        else:
            intrinsics = _inline_intrinsics(source, place)
        if source.readout_s:
            intrinsics = replace(intrinsics, readout_s=source.readout_s)
        size = (video.width, video.height) if video else (detections.image_size if detections else None)
        if size:
            try:
                intrinsics, note = fit_to_size(intrinsics, *size)
            except ValueError as error:
                remedy = "give the calibration that belongs to these pictures"
                raise DataError(place, str(error), remedy) from None
            if note:
                self._note(f"{name}: {note}")
        if detections is not None:
            _refuse_keypoints_outside(place, intrinsics, detections)
        return intrinsics

    def _calibrated(self, name: str, path: str, camera: str | None) -> CalibratedCamera:
        """The camera of a calibration file that is asked for, bears this name, or is the only one."""
        if path not in self._calibrations:
            file = self._base / path
            self._calibrations[path] = recognise(file, CalibrationFormat, "calibration").read_calibration(
                file
            )
        cameras = self._calibrations[path]
        if camera is None and name not in cameras and len(cameras) == 1:
            return next(iter(cameras.values()))
        if (camera or name) not in cameras:
            listed = ", ".join(sorted(cameras)[:20])
            raise DataError(
                self._base / path,
                f"holds no camera {camera or name!r} (there are {listed})",
                "say which with {path: ..., camera: ...}",
            )
        return cameras[camera or name]

    # --- poses -----------------------------------------------------------------------------------------

    def trajectory(self, name: str, camera: Camera, first_frame_ns: int) -> Trajectory:
        """world_from_camera over time; a still camera has one row, at its first frame.

        Raises:
            DataError: nothing usable, or the camera's place on the body is not stated.
        """
        pose = camera.pose
        if pose.static:
            calibrated = self._calibrated(name, pose.static.path, pose.static.camera)
            if calibrated.position is None or calibrated.quaternion_xyzw is None:
                path = self._base / pose.static.path
                raise DataError(path, "holds intrinsics but no camera pose", "name a file with extrinsics")
            still = Trajectory(
                t_ns=np.array([first_frame_ns]),
                position=calibrated.position[None],
                quaternion_xyzw=calibrated.quaternion_xyzw[None],
            )
            return _in_enu(still, self._axes(pose.axes))
        if pose.is_telemetry:
            return self._telemetry.trajectory(name, camera, self._mounted(name, camera.mount))
        if pose.log:
            return self._logged_trajectory(name, camera, pose.log)
        trajectory = self._filed_trajectory(pose.tum or pose.csv or "", "tum" if pose.tum else "csv")
        if pose.of != "body":
            return _in_enu(trajectory, self._axes(pose.axes))
        return self._on_body(name, camera, _body_in_enu(trajectory, self._axes(pose.axes)))

    def _axes(self, *stated: Axes | None) -> Axes:
        return next((axes for axes in stated if axes), self._flight.world.frame)

    def _filed_trajectory(self, stated: str, kind: str) -> Trajectory:
        path = self._base / stated
        reader = FORMATS.get(kind)
        if not isinstance(reader, TrajectoryFormat):
            raise DataError(path, f"the format {kind} reads no trajectories")
        trajectory = reader.read_trajectory(path)
        if not len(trajectory.t_ns):
            raise DataError(path, f"holds no usable pose ({losses(trajectory.dropped)})", "mend the log")
        return trajectory

    def _logged_trajectory(self, name: str, camera: Camera, log: str) -> Trajectory:
        pose, settings = camera.pose, self._logs.settings(log)
        trajectory = self._logs.trajectory(
            log, pose.topic, pose.parent, pose.child, max_gap_ns=self._max_gap_ns
        )
        of_camera = pose.of == "camera" or (
            pose.of is None and camera.mount is None and camera.gimbal is None
        )
        if of_camera and pose.of is None and pose.child is None:
            self._note(
                f"{name}: poses in {log} are taken as the camera's (say `of: body` with a mount if not)"
            )
        axes = self._axes(pose.axes, settings.axes)
        in_enu = _in_enu(trajectory, axes) if of_camera else _body_in_enu(trajectory, axes)
        moved = in_world(in_enu, settings)
        return moved if of_camera else self._on_body(name, camera, moved)

    def _mounted(self, name: str, mount: Mount | None) -> tuple[Float, Float]:
        """Lever arm [3] and rotation [4] of a camera in its body, or in its gimbal if there is one."""
        try:
            return _mounted(mount)
        except ValueError as error:
            place = f"{self._manifest}: cameras.{name}.mount"
            raise DataError(place, str(error), "say how the camera sits on the body") from None

    def _on_body(self, name: str, camera: Camera, body: Trajectory) -> Trajectory:
        """The poses of the camera, from those of the body that carries it."""
        lever_arm, rotation = self._mounted(name, camera.mount)
        world_from_body = (body.position, body.quaternion_xyzw)
        dropped = dict(body.dropped)
        if camera.gimbal is None:
            position, quaternion = compose_mount(world_from_body, (lever_arm, rotation))
        else:
            position, quaternion, without = self._on_gimbal(camera, body, lever_arm, rotation)
            if without:
                dropped["pose without gimbal angles"] = without
        known = ~np.isnan(quaternion[:, 0])
        if not known.any():
            raise DataError(
                self._manifest,
                f"cameras.{name}: its gimbal's angles and the poses of its body share no time",
                "check the clocks of the two logs",
            )
        covariance = body.covariance
        if covariance is not None:
            covariance = mounted_covariance(covariance, body.quaternion_xyzw, lever_arm, quaternion)
            covariance = covariance if known.all() else covariance[known]
        return Trajectory(
            t_ns=body.t_ns[known],
            position=position[known],
            quaternion_xyzw=quaternion[known],
            covariance=covariance,
            dropped=dropped,
        )

    def _on_gimbal(
        self, camera: Camera, body: Trajectory, lever_arm: Float, rotation: Float
    ) -> tuple[Float, Float, int]:
        gimbal = camera.gimbal
        if gimbal is None:
            raise ValueError("the camera has no gimbal")
        track = stated_angles(gimbal, self._logs, self._flight.world.frame)
        attitude = attitudes_at(track, body.t_ns, max_gap_ns=self._max_gap_ns)
        position, quaternion = compose_gimbal(
            (body.position, body.quaternion_xyzw),
            lever_arm,
            attitude,
            rotation,
            relative_to=track.relative_to,
        )
        return position, quaternion, int(np.isnan(attitude[:, 0]).sum())

    # --- actor, map, truth -----------------------------------------------------------------------------

    def actor(self, log: str, topic: str | None) -> Trajectory:
        """Where the actor was, as logged; its rotation means nothing."""
        if (track := self._logs.positions(log, topic)) is not None:
            return self._telemetry.points("actor", log, track)
        settings = self._logs.settings(log)
        trajectory = self._logs.trajectory(log, topic, None, None, max_gap_ns=self._max_gap_ns)
        return in_world(_in_enu(trajectory, self._axes(settings.axes)), settings)

    def planned(self, camera: str, plan: Plan) -> Trajectory:
        """Where a drone was sent; its rotation means nothing."""
        if camera in plan.files:
            path = self._base / plan.files[camera]
            filed = recognise(path, TrajectoryFormat, "file of commanded poses").read_trajectory(path)
            return _in_enu(filed, self._flight.world.frame)
        log, topic = plan.log_of(camera), plan.topics[camera].topic
        settings = self._logs.settings(log)
        sent = self._logs.commands(log, topic)
        if sent is None:
            sent = self._logs.trajectory(log, topic, None, None, max_gap_ns=self._max_gap_ns)
        return in_world(_in_enu(sent, self._axes(settings.axes)), settings)

    def map(self, stated: str, resolution_m: float | None) -> Occupancy:
        """What stands around, from a file."""
        path = self._base / stated
        return recognise(path, MapFormat, "map").read_map(path, resolution_m=resolution_m)

    def logged_maps(self, stated: Map) -> LoggedMaps:
        """What stands around, from a log: maps that replace each other, in ENU axes at world times."""
        settings = self._logs.settings(stated.log or "")
        axes = self._axes(settings.axes)
        found = self._logs.maps(
            stated, lambda poses: in_world(_in_enu(poses, axes), settings), max_gap_ns=self._max_gap_ns
        )
        for note in found.notes:
            self._note(note)
        return found

    def true_joints(self, source: TruthJoints) -> JointMotion:
        """The true joints."""
        path = self._base / source.path
        named = FORMATS.get(source.format) if source.format else None
        reader = named or recognise(path, JointFormat, "file of true joints")
        if not isinstance(reader, JointFormat):
            raise DataError(path, f"{source.format} holds no joints", "leave `format:` out")
        if source.axes is None and self._flight.world.frame == "ned":
            raise DataError(
                path,
                "has joints of unknown axes in a NED world",
                "say truth: {joints: {axes: ned}} or z-up, y-up",
            )
        is_ned = source.axes == "ned"
        motion = reader.read_joints(path, unit=source.unit, axes="z-up" if is_ned else source.axes)
        if is_ned:
            motion = replace(motion, position=motion.position[..., [1, 0, 2]] * [1, 1, -1])
        return replace(motion, t_ns=motion.t_ns + round(source.offset_s * 1e9))

    def true_poses(self, stated: str) -> Trajectory:
        """The true poses of one camera."""
        path = self._base / stated
        trajectory = recognise(path, TrajectoryFormat, "camera trajectory").read_trajectory(path)
        return _in_enu(trajectory, self._flight.world.frame)


def _pictures(video: VideoIndex | None, logged: Frames | None) -> CameraFrames | None:
    """The pictures of a video or a topic, by their own stamps; None where there are none."""
    if video is not None:
        return CameraFrames(np.arange(video.count), video.pts_ns, video.pts_ns, dropped=video.dropped)
    if logged is not None:
        since_start = logged.t_ns - logged.t_ns[0]
        count = np.arange(len(since_start))
        return CameraFrames(count, logged.t_ns, since_start, logged.topic, logged.dropped)
    return None


def source_files(path: Path) -> list[Path]:
    """A stated source and the files that it leads to: a floor plan is a YAML and a picture."""
    if path.suffix.lower() in {".yaml", ".yml"} and ROS_MAP.recognises(path):
        return [path, *ROS_MAP.pictures(path)]
    return [path]


def losses(dropped: dict[str, int]) -> str:
    """What was dropped, in words."""
    return ", ".join(f"{count} {cause}" for cause, count in dropped.items()) or "it is empty"


def _mounted(mount: Mount | None) -> tuple[Float, Float]:
    """Lever arm [3] and rotation [4] of a camera in its body, or in its gimbal if there is one."""
    if mount is None:  # the manifest makes sure that there is a gimbal then
        return np.zeros(3), body_from_camera("forward")
    if mount.body_from_camera is not None:
        stated = mount.body_from_camera
        return np.array(stated.translation), np.array(stated.rotation_xyzw)
    return np.array(mount.translation), body_from_camera(mount.looks or "forward", mount.down_deg)


def _inline_intrinsics(source: IntrinsicsSource, place: str) -> Intrinsics:
    try:
        return Intrinsics(
            width=source.width or 0,
            height=source.height or 0,
            fx=source.fx or 0.0,
            fy=source.fy or 0.0,
            cx=source.cx or 0.0,
            cy=source.cy or 0.0,
            model=source.model if source.distortion else "none",
            distortion=tuple(source.distortion),
        )
    except ValueError as error:
        raise DataError(place, str(error), "mend the numbers") from None


def _refuse_keypoints_outside(place: str, intrinsics: Intrinsics, detections: Detections) -> None:
    """Refuse a calibration whose picture is too small for the keypoints: it is of another size."""
    xy = detections.xy[~np.isnan(detections.xy[..., 0])]
    outside = ((xy < -0.5) | (xy > [intrinsics.width - 0.5, intrinsics.height - 0.5])).any(axis=-1)
    if len(xy) and outside.mean() > _LARGEST_SHARE_OUTSIDE:
        reach = np.percentile(xy, 99, axis=0)
        raise DataError(
            place,
            f"is for {intrinsics.width}x{intrinsics.height} pictures, but {outside.mean():.0%} of the"
            f" keypoints lie outside (they reach to x = {reach[0]:.0f}, y = {reach[1]:.0f})",
            "give the calibration of these pictures, or their size with keypoints: {image_size: [W, H]}",
        )


def _in_enu(trajectory: Trajectory, axes: Axes) -> Trajectory:
    """The same poses in an ENU world; the axes of the thing itself stay."""
    if axes == "enu":
        return trajectory
    position, quaternion = enu_from_ned(trajectory.position, trajectory.quaternion_xyzw)
    covariance = trajectory.covariance
    if covariance is not None:
        swap = np.eye(6)
        swap[:3, :3] = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
        covariance = carried_covariance(swap, covariance)
    return replace(trajectory, position=position, quaternion_xyzw=quaternion, covariance=covariance)


def _body_in_enu(trajectory: Trajectory, axes: Axes) -> Trajectory:
    """The poses of a body: a log in NED has its body in FRD."""
    in_enu = _in_enu(trajectory, axes)
    if axes == "enu":
        return in_enu
    quaternion, covariance = flu_body_from_frd(in_enu.quaternion_xyzw, in_enu.covariance)
    return replace(in_enu, quaternion_xyzw=quaternion, covariance=covariance)


def _ticks_ns(count: int, fps: Fraction) -> Int64:
    """Exact times of `count` frames from 0, each rounded to a ns; Python's integers cannot overflow here."""
    period = Fraction(1_000_000_000) / fps
    return np.array([round(k * period) for k in range(count)], dtype=np.int64)
