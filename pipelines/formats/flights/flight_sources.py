"""Readers of a manifest's sources as records: in world axes (ENU), at world times, for the pictures' size.

Contradictions between two sources show here. They are refused with the name of the faulty file, or noted.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np

from pipelines.formats.flights.calibration_sources import CalibrationSources
from pipelines.formats.flights.flight_logs import FlightLogs
from pipelines.formats.flights.frame_sources import CameraFrames, FrameSources
from pipelines.formats.flights.gimbal_angles import attitudes_at, stated_angles
from pipelines.formats.flights.telemetry_poses import Origin, TelemetryPoses
from pipelines.formats.flights.world_axes import as_stated, body_in_enu, in_enu, in_world, refuse_projected
from pipelines.formats.logs.maps import LoggedMaps
from pipelines.formats.maps.ros_map import FORMAT as ROS_MAP
from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import Intrinsics
from pipelines.geometry.clocks import ClockFit
from pipelines.geometry.mounting import (
    body_from_camera,
    compose_gimbal,
    compose_mount,
)
from pipelines.geometry.poses import mounted_covariance
from pipelines.session.description import MediaEntry
from pipelines.session.errors import DataError
from pipelines.session.manifest import (
    Axes,
    Camera,
    Flight,
    KeypointSource,
    Map,
    Mount,
    Plan,
    TruthJoints,
)
from pipelines.session.records import Detections, JointMotion, Occupancy, Trajectory, VideoIndex
from pipelines.session.registries import (
    FORMATS,
    JointFormat,
    KeypointFormat,
    MapFormat,
    TrajectoryFormat,
    VideoFormat,
    recognise,
)

_FARTHEST_M = 10_000  # in any flight a person's joints are closer to their median than this
_LARGEST_M = 1e8  # metric grids have coordinates up to 1e7


class FlightSources:
    """Reader of the parts of one flight; a context manager that closes the logs.

    Args:
        flight: the manifest.
        manifest: its path.
        max_gap_ns: the longest gap between two logged poses or angles that is interpolated.
        note: receives each choice and each doubt, one line each.
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
        self._calibrations = CalibrationSources(manifest, self._logs, note)
        self._frames = FrameSources(
            manifest, self._logs, self._telemetry, self.trajectory, max_gap_ns=max_gap_ns, note=note
        )

    def __enter__(self) -> Self:
        """Return the sources themselves."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the logs."""
        self._logs.__exit__(*exception)

    def origin(self) -> Origin | None:
        """Return the world's origin on Earth, if known; note cameras with different height references."""
        self._telemetry.doubt_heights()
        return self._telemetry.origin()

    def log_clock(self, camera: Camera) -> ClockFit | None:
        """Return the fit of a drone's log clock to GPS time; None without one."""
        return self._telemetry.fit(camera.pose) if camera.pose.is_telemetry else None

    def stamps(self, log: str) -> str:
        """Return which stamps of a log's messages are used: header or receive."""
        return self._logs.settings(log).stamps

    def files(self, log: str) -> list[str]:
        """Return the files of a log, as the manifest states them."""
        return self._logs.settings(log).path

    # --- keypoints and pictures ------------------------------------------------------------------------

    def keypoints(self, source: KeypointSource) -> tuple[Detections, str]:
        """Read the keypoints that the manifest gives for a camera; return them with their format's name."""
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
        """Return the index of a camera's video file; None if it has none."""
        if camera.video is None or camera.video.path is None:
            return None
        path = self._base / camera.video.path
        return recognise(path, VideoFormat, "video").index(path)

    def intrinsics(
        self, name: str, camera: Camera, video: VideoIndex | None, detections: Detections | None
    ) -> Intrinsics:
        """Return the intrinsics of a camera; see `CalibrationSources`."""
        return self._calibrations.intrinsics(name, camera, video, detections)

    def frames(
        self,
        name: str,
        camera: Camera,
        video: VideoIndex | None,
        detections: Detections | None,
        intrinsics: Intrinsics,
    ) -> CameraFrames:
        """Read the time at which each picture was taken; see `FrameSources`."""
        return self._frames.frames(name, camera, video, detections, intrinsics)

    def media(self, camera: Camera, frames: CameraFrames, session: Path) -> MediaEntry | None:
        """Return the paths of the pictures relative to the session, which moves together with its flight."""
        video = camera.video
        if video is None:
            return None
        stated = self.files(video.log) if video.log else [video.path or ""]
        return MediaEntry(
            paths=[Path(os.path.relpath(self._base / path, session)).as_posix() for path in stated],
            sources=stated,
            topic=frames.topic,
            stamps=self._logs.settings(video.log).stamps if video.log else "header",
        )

    # --- poses -----------------------------------------------------------------------------------------

    def trajectory(self, name: str, camera: Camera, first_frame_ns: int) -> Trajectory:
        """Read world_from_camera over time; a static camera has one row, at its first frame.

        Raises:
            DataError: nothing usable, or the manifest does not state the camera's mount on the body.
        """
        pose = camera.pose
        if pose.static:
            calibrated = self._calibrations.camera(name, pose.static.path, pose.static.camera)
            if calibrated.position is None or calibrated.quaternion_xyzw is None:
                path = self._base / pose.static.path
                raise DataError(path, "holds intrinsics but no camera pose", "name a file with extrinsics")
            still = Trajectory(
                t_ns=np.array([first_frame_ns]),
                position=calibrated.position[None],
                quaternion_xyzw=calibrated.quaternion_xyzw[None],
            )
            return self._local(self._base / pose.static.path, in_enu(still, self._axes(pose.axes)))
        return in_world(self._moving_trajectory(name, camera), pose.world_from_source)

    def _moving_trajectory(self, name: str, camera: Camera) -> Trajectory:
        """Read world_from_camera over time, in the world of its source."""
        pose = camera.pose
        if pose.is_telemetry:
            return self._telemetry.trajectory(name, camera, self._mounted(name, camera.mount))
        if pose.log:
            return self._local(self._logs.paths(pose.log)[0], self._logged_trajectory(name, camera, pose.log))
        stated = pose.tum or pose.csv or ""
        trajectory = as_stated(self._filed_trajectory(stated, "tum" if pose.tum else "csv"), pose)
        if pose.of != "body":
            return self._local(self._base / stated, in_enu(trajectory, self._axes(pose.axes)))
        turned = self._local(self._base / stated, body_in_enu(trajectory, self._axes(pose.axes)))
        return self._on_body(name, camera, turned)

    def _local(self, source: Path | str, trajectory: Trajectory) -> Trajectory:
        """Return the same trajectory; refuse projected coordinates if the world has an origin on Earth."""
        self._refuse_projected(source, trajectory.position)
        return trajectory

    def _refuse_projected(self, source: Path | str, position: Float) -> None:
        if (origin := self._telemetry.origin()) is not None:
            refuse_projected(source, position, origin.place)

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
        trajectory = as_stated(trajectory, pose)
        axes = self._axes(pose.axes, settings.axes)
        turned = in_enu(trajectory, axes) if of_camera else body_in_enu(trajectory, axes)
        moved = in_world(turned, settings.world_from_log)
        return moved if of_camera else self._on_body(name, camera, moved)

    def _mounted(self, name: str, mount: Mount | None) -> tuple[Float, Float]:
        """Return lever arm [3] and rotation [4] of a camera in its body, or in its gimbal if there is one."""
        try:
            return mounted(mount)
        except ValueError as error:
            place = f"{self._manifest}: cameras.{name}.mount"
            raise DataError(place, str(error), "say how the camera sits on the body") from None

    def _on_body(self, name: str, camera: Camera, body: Trajectory) -> Trajectory:
        """Compute the poses of the camera from those of the body that carries it."""
        lever_arm, rotation = self._mounted(name, camera.mount)
        world_from_body = (body.position, body.quaternion_xyzw)
        dropped = dict(body.dropped)
        if camera.gimbal is None:
            position, quaternion = compose_mount(world_from_body, (lever_arm, rotation))
        else:
            position, quaternion, lost = self._on_gimbal(camera, body, lever_arm, rotation)
            dropped |= lost
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
    ) -> tuple[Float, Float, dict[str, int]]:
        """Compute positions and rotations of a camera on a gimbal; also return losses by cause."""
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
        lost = dict(track.dropped)
        if without := int(np.isnan(attitude[:, 0]).sum()):
            lost["pose without gimbal angles"] = without
        return position, quaternion, lost

    # --- actor, map, truth -----------------------------------------------------------------------------

    def actor(self, log: str, topic: str | None) -> Trajectory:
        """Read the actor's logged positions; the rotation has no meaning."""
        if (found := self._logs.positions(log, topic)) is not None:
            track, lost = found
            return replace(self._telemetry.points("actor", log, track), dropped=lost)
        settings = self._logs.settings(log)
        trajectory = self._logs.trajectory(log, topic, None, None, max_gap_ns=self._max_gap_ns)
        return self._local(
            self._logs.paths(log)[0],
            in_world(in_enu(trajectory, self._axes(settings.axes)), settings.world_from_log),
        )

    def planned(self, camera: str, plan: Plan) -> Trajectory:
        """Read the commanded positions of a drone; the rotation has no meaning."""
        if camera in plan.files:
            path = self._base / plan.files[camera]
            filed = recognise(path, TrajectoryFormat, "file of commanded poses").read_trajectory(path)
            return self._local(path, in_enu(filed, self._flight.world.frame))
        log, topic = plan.log_of(camera), plan.topics[camera].topic
        settings = self._logs.settings(log)
        sent = self._logs.commands(log, topic)
        if sent is None:
            sent = self._logs.trajectory(log, topic, None, None, max_gap_ns=self._max_gap_ns)
        return self._local(
            self._logs.paths(log)[0],
            in_world(in_enu(sent, self._axes(settings.axes)), settings.world_from_log),
        )

    def map(self, stated: str, resolution_m: float | None) -> Occupancy:
        """Read the map of obstacles from a file."""
        path = self._base / stated
        occupancy = recognise(path, MapFormat, "map").read_map(path, resolution_m=resolution_m)
        self._refuse_projected(path, occupancy.origin[None])
        return occupancy

    def logged_maps(self, stated: Map) -> LoggedMaps:
        """Read the maps of a log, which replace each other, in ENU axes at world times."""
        settings = self._logs.settings(stated.log or "")
        axes = self._axes(settings.axes)
        found = self._logs.maps(
            stated,
            lambda poses: in_world(in_enu(poses, axes), settings.world_from_log),
            max_gap_ns=self._max_gap_ns,
        )
        for note in found.notes:
            self._note(note)

        def in_place(occupancy: Occupancy) -> Occupancy:
            self._refuse_projected(self._logs.paths(stated.log or "")[0], occupancy.origin[None])
            return occupancy

        return replace(found, maps=map(in_place, found.maps))

    def true_joints(self, source: TruthJoints) -> JointMotion:
        """Read the true joints; drop and count positions too far from the others to be true.

        Raises:
            DataError: the file cannot be used, its axes are unknown, or no position is left.
        """
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
        motion = _without_far_joints(motion)
        if not np.isfinite(motion.position).any():
            lost = f" ({losses(motion.dropped)})" if motion.dropped else ""
            raise DataError(path, f"holds no position of a joint{lost}", "check what wrote it")
        self._refuse_projected(path, motion.position.reshape(-1, 3))
        return replace(motion, t_ns=motion.t_ns + round(source.offset_s * 1e9))

    def true_poses(self, stated: str) -> Trajectory:
        """Read the true poses of one camera."""
        path = self._base / stated
        trajectory = recognise(path, TrajectoryFormat, "camera trajectory").read_trajectory(path)
        return self._local(path, in_enu(trajectory, self._flight.world.frame))


def _without_far_joints(motion: JointMotion) -> JointMotion:
    """Set positions to NaN that are incomplete, or too far from the median of all to be true."""
    position = np.where(np.isfinite(motion.position).all(axis=-1, keepdims=True), motion.position, np.nan)
    known = position[~np.isnan(position[..., 0])]
    if not len(known):
        return replace(motion, position=position)
    with np.errstate(over="ignore", invalid="ignore"):  # 1e308 is infinitely far from its negative
        far = (np.abs(position - np.median(known, axis=0)) > _FARTHEST_M).any(axis=-1)
        far |= (np.abs(position) > _LARGEST_M).any(axis=-1)
    if not far.any():
        return replace(motion, position=position)
    cause = f"position more than {_FARTHEST_M // 1000} km from the others"
    return replace(
        motion,
        position=np.where(far[..., None], np.nan, position),
        dropped=motion.dropped | {cause: int(far.sum())},
    )


def source_files(path: Path) -> list[Path]:
    """Return a source and the files that it refers to: a floor plan is a YAML and a picture."""
    if path.suffix.lower() in {".yaml", ".yml"} and ROS_MAP.recognises(path):
        return [path, *ROS_MAP.pictures(path)]
    return [path]


def losses(dropped: dict[str, int]) -> str:
    """Format the losses by cause, in words."""
    return ", ".join(f"{count} {cause}" for cause, count in dropped.items()) or "it is empty"


def mounted(mount: Mount | None) -> tuple[Float, Float]:
    """Return lever arm [3] and rotation [4] of a camera in its body, or in its gimbal if there is one."""
    if mount is None:  # the manifest's checks guarantee a gimbal in this case
        return np.zeros(3), body_from_camera("forward")
    if mount.body_from_camera is not None:
        stated = mount.body_from_camera
        return np.array(stated.translation), np.array(stated.rotation_xyzw)
    return np.array(mount.translation), body_from_camera(mount.looks or "forward", mount.down_deg)
