"""Poses of cameras and positions of people, from files, logs and drones' own logs, all in one world.

A drone's own log has its position and the attitudes of its body and gimbal separately, each at its own rate.
They are joined here, in ENU axes about one origin on Earth.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from pipelines.formats.common.rows import METRES, median_step_ns
from pipelines.formats.drone_logs.telemetry_rows import turned_as_stated
from pipelines.formats.logs.positions import FIXES, read_pair, read_positions
from pipelines.formats.maps.voxel_grids import placed
from pipelines.geometry.arrays import ClockFit, Float, Int64, Place
from pipelines.geometry.geodesy import enu_from_enu, enu_from_geodetic
from pipelines.geometry.mounting import attitude_in_enu, compose_gimbal, level_heading
from pipelines.geometry.poses import (
    compose,
    interpolate_points,
    interpolate_rotations,
    mounted_covariance,
    multiply,
    quaternion_from_matrix,
    rotate,
)
from pipelines.session.description import Doubt, OriginEntry
from pipelines.session.errors import DataError
from pipelines.session.manifest import (
    ActorSource,
    Axes,
    CameraSources,
    FiledPose,
    FrameTimes,
    GimbalSource,
    LoggedAngles,
    LoggedPose,
    Manifest,
    Mount,
    Placement,
    PlanSource,
    PoseSource,
)
from pipelines.session.recognition import recognise
from pipelines.session.records import AttitudeTrack, Occupancy, PositionTrack, Telemetry, Trajectory
from pipelines.session.registries import (
    AttitudeFormat,
    CalibrationFormat,
    TelemetryChoice,
    TelemetryFormat,
    TrajectoryFormat,
    TriggerFormat,
)
from pipelines.session.urls import located
from pipelines.sources.files import FlightFiles
from pipelines.sources.logs import FlightLogs
from pipelines.sources.parts import CameraFrames
from pipelines.sources.world import (
    LEVEL,
    Projection,
    as_stated,
    in_enu,
    in_world,
    is_usable,
    losses,
    mounted,
    moved,
    refuse_projected,
    turn_of,
    upright,
    world_times,
)

_FIXED = "fixed angles"

# Datums of one continent, as ETRS89 and WGS84, differ by less.
SAME_PLACE_M = 1.0

# Receivers without corrections are off by this (docs/flight.md, Poses).
USUAL_SATELLITE_SIGMA_M = 1.5

_ABOVE_TAKE_OFF = ("take-off", "stated")
ADD_ANGLES = (
    "add attitude: pictures to pose, and the film says how the camera turned; or"
    " gimbal: {file, topic, relative_to: world} with the angles of another log, or"
    " gimbal: {yaw_deg: 90, pitch_deg: -30} if the camera never turned"
)
_ADD_MOUNT = (
    "say how the camera sits on the body, mount: {looks: forward, down_deg: 0}, add a gimbal, or add"
    " attitude: pictures to pose if you do not know"
)


Track = TypeVar("Track", PositionTrack, AttitudeTrack)


class FlightPoses:
    """Reader of the poses of one flight in the world's axes, at its times; `note` receives each choice."""

    def __init__(
        self,
        flight: Manifest,
        manifest: Path,
        logs: FlightLogs,
        files: FlightFiles,
        *,
        max_gap_ns: int,
        note: Callable[[str], None],
    ) -> None:
        self._flight = flight
        self._manifest = manifest
        self._base = manifest.parent
        self._logs = logs
        self._files = files
        self._max_gap_ns = max_gap_ns
        self._note = note
        self._origin: OriginEntry | None = None
        self._telemetry: dict[str, Telemetry] = {}
        self._upright = upright(flight.world)
        crs = flight.world.crs
        self._projection = Projection(crs, f"{manifest}: world.crs") if crs else None
        self.map_doubts: list[Doubt] = []

    # --- cameras ---------------------------------------------------------------------------------------

    def trajectory(self, name: str, camera: CameraSources, frames: CameraFrames) -> Trajectory:
        """Read world_from_camera over time; a static camera has one row, at the first of its frames.

        With `attitude: pictures` rotations are there to be compared, NaN for none. DataError: nothing usable,
        or the manifest does not state the camera's mount on the body.
        """
        pose = camera.pose
        if pose.by_pictures:
            return self._places(name, camera)
        if self.is_still(camera):
            source, still = self._stated_poses(name, camera)
            first_ns = int(frames.t_ns[0])
            placed = in_world(self._local(source, still), pose.world_from_source)
            return replace(placed, t_ns=np.array([first_ns]))
        angles = self._stated_angles(name, camera.gimbal)
        if self._is_joined(pose):
            return in_world(self._joined_trajectory(name, camera, angles), pose.world_from_source)
        source, stated = self._stated_poses(name, camera)
        of_camera = self._is_of_camera(camera)
        if of_camera and self._is_log(pose) and pose.of is None and self._logged(pose).child is None:
            self._note(
                f"{name}: poses in {pose.file} are taken as the camera's (say `of: body` with a mount if not)"
            )
        # The lever arm of the mount is in metres: positions are scaled before it is added.
        local = moved(self._local(source, stated), scale=pose.world_from_source.scale)
        if not of_camera:
            local = self._on_body(name, camera, local, angles)
        return in_world(local, pose.world_from_source.model_copy(update={"scale": 1.0}))

    def _stated_poses(self, name: str, camera: CameraSources) -> tuple[Path, Trajectory]:
        """Read poses of a camera or of its body, in ENU axes, but not yet out of a map projection."""
        pose = camera.pose
        path = self._files.path(pose.file)
        if self.is_still(camera):
            calibrated = self._files.camera(name, "pose", pose)
            if calibrated.position is None or calibrated.quaternion_xyzw is None:
                problem = "holds intrinsics but no camera pose"
                raise DataError(path, problem, "name a file with extrinsics", code="no-poses")
            still = Trajectory(
                t_ns=np.zeros(1, dtype=np.int64),
                position=calibrated.position[None],
                quaternion_xyzw=calibrated.quaternion_xyzw[None],
            )
            return path, self._enu(moved(still, scale=METRES[pose.unit or "m"]), pose.axes)
        of_body = not self._is_of_camera(camera)
        if self._is_log(pose):
            settings, options = self._logs.settings(pose.file), self._logged(pose)
            logged = self._logs.trajectory(
                pose.file, pose.topic, options.parent, options.child, max_gap_ns=self._max_gap_ns
            )
            logged = as_stated(logged, pose, options)
            axes = pose.axes or self._logs.axes(pose.file, pose.topic, options.parent)
            turned = self._enu(logged, axes, of_body=of_body)
            return path, in_world(turned, settings.world_from_source)
        filed = as_stated(self._filed_trajectory(pose), pose, self._files.options("pose", pose, FiledPose))
        return path, self._enu(filed, pose.axes, of_body=of_body)

    # --- kinds of sources ------------------------------------------------------------------------------

    def is_still(self, camera: CameraSources) -> bool:
        """Return True for a camera that stands still, whose pose is in a calibration."""
        pose = camera.pose
        return bool(pose.file) and isinstance(self._files.format_of("pose", pose), CalibrationFormat)

    def _is_log(self, pose: PoseSource) -> bool:
        return self._files.is_log("pose", pose)

    def _logged(self, pose: PoseSource) -> LoggedPose:
        return self._files.options("pose", pose, LoggedPose)

    def _is_joined(self, pose: PoseSource) -> bool:
        """Return True if position and attitude come separately: a drone's own log, or several topics."""
        if self._is_log(pose):
            return pose.attitude is not None and self._logged(pose).parent is None
        return bool(pose.file) and isinstance(self._files.format_of("pose", pose), TelemetryFormat)

    def refuse_unfit(self) -> None:
        """Refuse, with a DataError, poses, mounts and gimbals that do not go together."""
        for name, camera in self._flight.cameras.items():
            place = f"{self._manifest}: cameras.{name}"
            for problem, remedy in (*self._unfit_pose(camera), *self._unfit_gimbal(camera)):
                raise DataError(place, problem, remedy, code="wrong-option")

    def _unfit_pose(self, camera: CameraSources) -> Iterator[tuple[str, str]]:
        pose, is_log = camera.pose, self._is_log(camera.pose)
        if not pose.file:
            return
        title = self._files.format_of("pose", pose).title
        if pose.attitude and not is_log and (self.is_still(camera) or not pose.by_pictures):
            yield f"pose: attitude: no option of this file ({title})", "leave it out"
        if self.is_still(camera):
            if pose.of == "body" or camera.is_carried:
                yield "pose: a still camera's pose is its own", "leave `of: body` and the mount out"
        elif self._is_joined(pose):
            if pose.unit:
                yield f"pose: unit: a file of this kind ({title}) states its own", "leave it out"
            if pose.axes and not is_log:
                yield f"pose: axes: a file of this kind ({title}) states its own", "leave them out"
        elif camera.is_carried and pose.of != "body" and not is_log:
            yield "a mount or gimbal needs the pose of the body", "add `of: body` to `pose`"
        if is_log:
            framed = self._logged(pose).parent is not None
            if pose.attitude and framed and not pose.by_pictures:
                yield "pose: attitude: has no use beside frames", "leave one of them out"
            if pose.attitude and not (pose.topic or framed):
                yield "pose: attitude: needs the topic of the positions", "add topic: TOPIC"

    def _unfit_gimbal(self, camera: CameraSources) -> Iterator[tuple[str, str]]:
        gimbal = camera.gimbal
        if gimbal is None:
            return
        if gimbal.is_of_pose and not self._is_joined(camera.pose):
            remedy = "add file and topic, or constant angles {yaw_deg: 90, pitch_deg: -30}"
            yield "gimbal: does not say where its angles are", remedy
        if self._files.is_log("gimbal", gimbal) and gimbal.topic is None:
            yield "gimbal: lacks the topic of its angles", "add topic: TOPIC, and what they are relative_to"

    def _is_of_camera(self, camera: CameraSources) -> bool:
        """Return True if stated poses are those of the camera, not of the body that carries it."""
        if camera.pose.of is None and self._is_log(camera.pose):
            return not camera.is_carried
        return camera.pose.of != "body"

    def _enu(self, trajectory: Trajectory, *stated: Axes | None, of_body: bool = False) -> Trajectory:
        """Convert poses to east, north, up: from the axes that are stated for them, else from the world's."""
        turned = in_enu(trajectory, self._axes(*stated), of_body=of_body)
        return turned if any(stated) else in_world(turned, self._upright)

    def _filed_trajectory(self, pose: PoseSource) -> Trajectory:
        path = self._files.path(pose.file)
        reader = recognise(path, TrajectoryFormat, "trajectory", name=pose.format)
        trajectory = reader.read_trajectory(path)
        if not len(trajectory.t_ns):
            problem = f"holds no usable pose ({losses(trajectory.dropped)})"
            raise DataError(path, problem, "mend the log", code="no-poses")
        return trajectory

    def _mounted(self, name: str, mount: Mount | None) -> tuple[Float, Float]:
        try:
            return mounted(mount)
        except ValueError as error:
            place = f"{self._manifest}: cameras.{name}.mount"
            problem = str(error)
            raise DataError(place, problem, "say how the camera sits on the body", code="bad-value") from None

    def _on_body(
        self, name: str, camera: CameraSources, body: Trajectory, angles: AttitudeTrack | None
    ) -> Trajectory:
        """Compute the poses of the camera from those of the body that carries it, and of its gimbal."""
        lever_arm, rotation = self._mounted(name, camera.mount)
        world_from_body = (body.position, body.quaternion_xyzw)
        dropped = dict(body.dropped)
        if angles is None:
            position, quaternion = compose(world_from_body, (lever_arm, rotation))
        else:
            position, quaternion, lost = self._on_gimbal(angles, body, lever_arm, rotation)
            dropped |= lost
        known = ~np.isnan(quaternion[:, 0])
        if not known.any():
            problem = f"cameras.{name}: its gimbal's angles and the poses of its body share no time"
            raise DataError(self._manifest, problem, "check the clocks of the two logs", code="no-overlap")
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
            body_xyzw=body.quaternion_xyzw[known] if angles is not None else None,
        )

    def _on_gimbal(
        self, track: AttitudeTrack, body: Trajectory, lever_arm: Float, rotation: Float
    ) -> tuple[Float, Float, dict[str, int]]:
        """Compute positions and rotations of a camera on a gimbal; also return losses by cause."""
        attitude = self._at(track, body.t_ns)
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

    def _stated_angles(self, name: str, gimbal: GimbalSource | None) -> AttitudeTrack | None:
        """Return the attitude of a gimbal by the source that the manifest names; None for the pose's own."""
        if gimbal is None or gimbal.is_of_pose:
            return None
        relative_to = gimbal.relative_to or "world"
        if gimbal.is_fixed:
            angles = np.array([[gimbal.yaw_deg or 0.0, gimbal.pitch_deg or 0.0, gimbal.roll_deg]])
            turned = turned_as_stated(angles, relative_to=relative_to)
            return AttitudeTrack(_FIXED, np.zeros(1, dtype=np.int64), turned, relative_to)
        if not self._files.is_log("gimbal", gimbal):
            return self._angles_alone(name, gimbal)
        log, topic = gimbal.file, gimbal.topic or ""
        options = self._files.options("gimbal", gimbal, LoggedAngles)
        logged = self._logs.attitudes(log, topic, order=options.order, units=options.units)
        axes = self._axes(gimbal.axes, self._logs.settings(log).axes)
        turned = attitude_in_enu(logged.quaternion_xyzw, relative_to=relative_to, axes=axes)
        if relative_to == "world" and not (gimbal.axes or self._logs.settings(log).axes):
            turned = multiply(turn_of(self._upright), turned)
        lost = {f"gimbal angles: {cause}": count for cause, count in logged.dropped.items()}
        return AttitudeTrack(topic, logged.t_ns, turned, relative_to, dropped=lost)

    def _angles_alone(self, name: str, gimbal: GimbalSource) -> AttitudeTrack:
        """Read the camera's attitudes from a log whose positions are not used."""
        stated = gimbal.file
        path, place = self._one_file(stated), f"{self._manifest}: cameras.{name}.gimbal"
        reader = recognise(path, AttitudeFormat, "source of angles", name=gimbal.format)
        found = reader.read_attitudes(path)
        if gimbal.yaw_deg is not None:
            problem = "yaw_deg: the angles of this file know where north is"
            raise DataError(place, problem, "leave it out", code="wrong-option")
        if found.clock == "the video's start":
            problem = "has angles that count from its own start, and is not the camera's video"
            raise DataError(path, problem, "name that video, if they are in it", code="clock-unknown")
        track = replace(
            found.camera, t_ns=self._world_times(stated, found.camera.t_ns, int(found.camera.t_ns[0]))
        )
        track = _turned_as_named(place, stated, track, gimbal)
        for note in found.notes:
            self._note(note)
        self._note(f"{name}: its camera is turned by {track.name} of {stated}, by {found.clock}")
        lost = {f"gimbal angles: {cause}": count for cause, count in track.dropped.items()}
        return replace(track, dropped=lost)

    def _at(self, track: AttitudeTrack, t_ns: Int64) -> Float:
        """Interpolate attitudes [N, 4] at given times, NaN outside the track; fixed angles always hold."""
        if track.name == _FIXED:
            return np.repeat(track.quaternion_xyzw, len(t_ns), axis=0)
        return interpolate_rotations(track.t_ns, track.quaternion_xyzw, t_ns, max_gap_ns=self._max_gap_ns)

    def _axes(self, *stated: Axes | None) -> Axes:
        return next((axes for axes in stated if axes), self._flight.world.frame)

    def _local(self, source: Path | str, trajectory: Trajectory) -> Trajectory:
        """Return the trajectory in the world, out of the CRS of a map projection if one is stated."""
        origin = self.origin()
        if self._projection is not None and origin is not None:
            trajectory = self._projection.trajectory(source, trajectory, origin.place)
        self.refuse_projected(source, trajectory.position, self._projection)
        return trajectory

    def joints(self, source: Path, position: Float, *, own_axes: bool) -> Float:
        """Return positions [..., 3] of people in the world; errors as for poses."""
        level = np.tile(LEVEL, (position.size // 3, 1))
        points = Trajectory(np.zeros(len(level), np.int64), position.reshape(-1, 3), level)
        placed = self._local(source, points if own_axes else in_world(points, self._upright))
        return placed.position.reshape(position.shape)

    def map(self, source: Path, grid: Occupancy, crs: str | None) -> Occupancy:
        """Return a map in the world; `crs` is the stated one of its coordinates, else its own counts."""
        origin = self.origin()
        if self._upright != Placement():
            scale = self._upright.scale
            grid = replace(grid, origin=scale * grid.origin, resolution_m=scale * grid.resolution_m)
            grid = placed(str(source), grid, (np.zeros(3), turn_of(self._upright)))
        stated = Projection(crs, f"{self._manifest}: map.crs") if crs else None
        own = None
        if grid.crs and origin is not None:
            own = Projection(grid.crs, str(source)) if is_usable(grid.crs) else None
            if own is None:
                self._note(f"{source}: its own CRS is not used: it is no projected or geographic one")
        projection = stated or own or self._projection
        if own is not None and stated is None:
            self._note(f"{source}: placed on Earth by the CRS in it, {own.name}")
        if projection is not None:
            if origin is None:
                problem = "places the map on Earth, and nothing says where the world's origin is"
                remedy = "write world.origin (latitude_deg, longitude_deg, altitude_m) or world.crs"
                raise DataError(f"{self._manifest}: map.crs", problem, remedy, code="place-unknown")
            if stated is not None and own is not None:
                self._compare_crs(source, grid, stated, own, origin.place)
            grid, error_m = projection.map(source, grid, origin.place)
            if error_m > grid.resolution_m / 2:
                self._note(
                    f"{source}: the scale of {projection.name} is not applied to voxels, {error_m:.2g} m at"
                    " its corners: crop it"
                )
        self.refuse_projected(source, grid.origin[None], projection)
        return grid

    def _compare_crs(
        self, source: Path, grid: Occupancy, stated: Projection, own: Projection, origin: Place
    ) -> None:
        centre = (grid.origin + np.array(grid.probability.shape) * grid.resolution_m / 2)[None]
        try:
            places = [each.points(source, centre, origin)[0] for each in (stated, own)]
            apart_m = float(np.linalg.norm(places[0] - places[1]))
        except DataError:  # outside one of them
            apart_m = np.inf
        if apart_m > SAME_PLACE_M:
            self.map_doubts.append(
                Doubt(
                    code="origin",
                    cameras=[],
                    what=f"the map's file names {own.name}, flight.yaml {stated.name}, which is used",
                    evidence={"apart_m": round(apart_m, 1)} if np.isfinite(apart_m) else {},
                    remedy=f"map.crs: {own.name}",
                )
            )

    def refuse_projected(
        self, source: Path | str, position: Float, projection: Projection | None = None
    ) -> None:
        """Refuse positions [N, 3] far from the world's origin on Earth; `projection` placed them already."""
        if (origin := self.origin()) is not None:
            refuse_projected(source, position, origin.place, projection.name if projection else "")

    # --- people, commands, truth -----------------------------------------------------------------------

    def actor(self, name: str, actor: ActorSource) -> Trajectory:
        """Read the logged positions of the actor, or of one of several; the rotation has no meaning."""
        log, topic = actor.file, actor.topic
        with self._logs.open(log) as opened:
            if topic is not None and opened.type_of(topic) in FIXES:
                dropped: dict[str, int] = {}
                track = read_positions(
                    opened.recording, opened.source, topic, opened.settings.stamps, dropped
                )
                track = replace(track, t_ns=opened.world_times(track.t_ns))
                dropped = dict(Counter(dropped) + opened.lost)
                return replace(self._points(name or "actor", log, track), dropped=dropped)
        return self._of_log(log, self._logs.trajectory(log, topic, None, None, max_gap_ns=self._max_gap_ns))

    def _of_log(self, log: str, trajectory: Trajectory) -> Trajectory:
        settings = self._logs.settings(log)
        turned = in_world(self._enu(trajectory, settings.axes), settings.world_from_source)
        return self._local(self._logs.paths(log)[0], turned)

    def planned(self, plan: PlanSource) -> Trajectory:
        """Read the commanded positions of a drone; the rotation has no meaning."""
        log, topic = plan.file, plan.topic
        reader = self._files.format_of("plan", plan)
        if isinstance(reader, TrajectoryFormat):
            path = self._files.path(log)
            return self._local(path, self._enu(reader.read_trajectory(path)))
        sent = self._logs.commands(log, topic)
        if sent is None:
            sent = self._logs.trajectory(log, topic, None, None, max_gap_ns=self._max_gap_ns)
        return self._of_log(log, sent)

    def true_poses(self, stated: str) -> Trajectory:
        """Read the true poses of one camera."""
        path = located(self._base, stated)
        trajectory = recognise(path, TrajectoryFormat, "camera trajectory").read_trajectory(path)
        return self._local(path, self._enu(trajectory))

    # --- drones' own logs ------------------------------------------------------------------------------

    def _read(self, pose: PoseSource) -> Telemetry:
        """Read a drone's own log, at world times; each log is read once."""
        key = pose.model_dump_json(exclude={"of"})
        if key not in self._telemetry:
            reader = self._files.format_of("pose", pose)
            if isinstance(reader, TelemetryFormat):
                choice = self._files.options("pose", pose, TelemetryChoice)
                found = reader.read_telemetry(self._one_file(pose.file), choice)
            else:
                found = self._logged_telemetry(pose)
            since_ns = int(found.position.t_ns[0])

            def clocked(track: Track) -> Track:
                return replace(track, t_ns=self._world_times(pose.file, track.t_ns, since_ns))

            self._telemetry[key] = replace(
                found,
                position=clocked(found.position),
                body=None if found.body is None else clocked(found.body),
                gimbal=None if found.gimbal is None else clocked(found.gimbal),
            )
        return self._telemetry[key]

    def _logged_telemetry(self, pose: PoseSource) -> Telemetry:
        """Read telemetry from a topic of positions, and one of attitudes if named, at the log's own times."""
        with self._logs.open(pose.file) as opened:
            recording, source, stamps = opened.recording, opened.source, opened.settings.stamps
            axes = self._axes(pose.axes, opened.settings.axes)
            attitude = None if pose.by_pictures else pose.attitude
            found = read_pair(recording, source, pose.topic or "", attitude, axes, stamps)
            if not (pose.axes or opened.settings.axes):
                turn, track, body = turn_of(self._upright), found.position, found.body
                if not track.on_earth:
                    track = replace(track, values=self._upright.scale * rotate(turn, track.values))
                if body is not None:
                    body = replace(body, quaternion_xyzw=multiply(turn, body.quaternion_xyzw))
                found = replace(found, position=track, body=body)
            return replace(found, dropped=dict(Counter(found.dropped) + opened.lost))

    def log_clock(self, camera: CameraSources) -> ClockFit | None:
        """Return the fit of a drone's log clock to GPS time; None without one."""
        return self._read(camera.pose).fit if self._is_joined(camera.pose) else None

    def triggers(self, camera: CameraSources) -> Int64 | None:
        """Read a drone's own log's trigger times of pictures, at world times; None if it is none."""
        times, choice = camera.frame_times or FrameTimes(), TelemetryChoice()
        stated, reader = times.file, self._files.format_of("frame_times", times)
        if not isinstance(reader, TriggerFormat):
            return None
        if camera.pose.file == stated and self._is_joined(camera.pose):
            choice = self._files.options("pose", camera.pose, TelemetryChoice)
        t_ns = reader.picture_times(self._one_file(stated), choice)
        return self._world_times(stated, t_ns, int(t_ns[0]))

    def _one_file(self, stated: str) -> Path:
        paths = self._logs.paths(stated)
        if len(paths) != 1:
            problem = f"logs.{stated}: a drone's own log is one file"
            raise DataError(self._manifest, problem, "name one", code="ambiguous")
        return paths[0]

    def _world_times(self, stated: str, t_ns: Int64, since_ns: int) -> Int64:
        """Convert a log's times to world times by its stated clock; the drift counts from `since_ns`."""
        return world_times(self._logs.settings(stated).clock, t_ns, since_ns)

    # --- the origin ------------------------------------------------------------------------------------

    def origin(self) -> OriginEntry | None:
        """Return the world's origin: the stated one, else the first position on Earth of the first camera.

        Its height is 0 if that camera's heights count from the take-off or are stated. None without either.
        """
        if self._origin is not None:
            return self._origin
        if stated := self._flight.world.origin:
            self._origin = OriginEntry(**stated.model_dump(), source="world.origin")
            return self._origin
        for camera in self._flight.cameras.values():
            if not self._is_joined(camera.pose):
                continue
            track = self._read(camera.pose).position
            first = track.origin or (_first_place(track) if track.on_earth else None)
            if first is not None:
                self._origin = OriginEntry(**asdict(first), source=camera.pose.file)
                return self._origin
        if self._projection is not None:  # the first position of the first camera
            name, camera = next(iter(self._flight.cameras.items()))
            source, poses = self._stated_poses(name, camera)
            first = self._projection.first_place(source, poses.position)
            self._origin = OriginEntry(**asdict(first), source=source.name)
        return self._origin

    def doubt_heights(self) -> None:
        """Note cameras whose heights have different references."""
        kinds = {
            name: self._read(camera.pose).position.height
            for name, camera in self._flight.cameras.items()
            if self._is_joined(camera.pose) and self._read(camera.pose).position.on_earth
        }
        if len(set(kinds.values())) > 1:
            said = ", ".join(f"{name}: {height}" for name, height in kinds.items())
            self._note(f"heights are counted from different things ({said}): expect metres between them")

    def _in_world(self, name: str, track: PositionTrack) -> tuple[Float, Float]:
        """Return positions [N, 3] m in the world, and the rotation of the track's own ENU in it [4]."""
        origin = self.origin()
        if not track.on_earth and (track.origin is None or origin is None):
            if origin is not None:
                self._note(
                    f"{name}: its {track.name} counts from a place that its log does not state: taken for the"
                    " world's origin (else say world_from_source under `logs`)"
                )
            return track.values, LEVEL
        if origin is None:
            raise AssertionError("a track on Earth gives the origin")
        if not track.on_earth and track.origin is not None:
            rotation, position = enu_from_enu(track.origin, origin.place)
            turned = quaternion_from_matrix(rotation)
            return compose((position, turned), (track.values, LEVEL))[0], turned
        latitude, longitude, height = track.values.T
        if track.height in _ABOVE_TAKE_OFF:  # z counts from the take-off, at any height on Earth
            height = height + origin.place.altitude_m
        return enu_from_geodetic(latitude, longitude, height, origin.place), LEVEL

    def _points(self, name: str, log: str, track: PositionTrack) -> Trajectory:
        """Return positions without a rotation in the world, as a trajectory; its rotation has no meaning."""
        if self.origin() is None:
            problem = f"{name}: {log} says where it was on Earth, and no camera does"
            remedy = "write world: {origin: {latitude_deg: ..., longitude_deg: ..., altitude_m: ...}}"
            raise DataError(self._manifest, problem, remedy, code="place-unknown")
        values, _ = self._in_world(name, track)
        still = np.tile(LEVEL, (len(values), 1))
        return in_world(Trajectory(track.t_ns, values, still), self._logs.settings(log).world_from_source)

    # --- poses of cameras ------------------------------------------------------------------------------

    def _joined_trajectory(
        self, name: str, camera: CameraSources, angles: AttitudeTrack | None
    ) -> Trajectory:
        """Compute world_from_camera over time from a drone's own log, and the stated angles of its gimbal."""
        stated = camera.pose.file
        telemetry = self._read(camera.pose)
        for note in telemetry.notes:
            self._note(note)
        gimbal = angles or self._gimbal(name, camera, telemetry)
        self._refuse_unturned(name, camera, telemetry, gimbal)
        track, body = telemetry.position, telemetry.body
        values, turn = self._in_world(name, track)
        self._doubt(name, track)
        # The stamps with the highest rate; positions win a tie.
        others = [part.t_ns for part in (gimbal or body,) if part is not None]
        t_ns = min([track.t_ns, *others], key=lambda stamps: median_step_ns(stamps) or np.inf)
        position = interpolate_points(track.t_ns, values, t_ns, max_gap_ns=self._max_gap_ns)
        if body is not None:
            quaternion = self._at(body, t_ns)
        elif gimbal is not None:
            quaternion = level_heading(self._at(gimbal, t_ns))  # the heading is all that is known of it
            if camera.mount is not None and any(camera.mount.translation):
                self._note(f"{name}: {stated} does not say how its body was turned: taken as level")
        else:
            raise AssertionError("refused above")
        if gimbal is not None and gimbal.relative_to == "world":
            gimbal = replace(gimbal, quaternion_xyzw=multiply(turn, gimbal.quaternion_xyzw))
        placed, turned = ~np.isnan(position[:, 0]), ~np.isnan(quaternion[:, 0])
        known = placed & turned
        if not known.any():
            problem = (
                f"cameras.{name}: its positions and attitudes share no time (or are further apart than"
                f" {self._max_gap_ns / 1e9:g} s)"
            )
            remedy = "check the clocks of the two logs, or raise --max-pose-gap"
            raise DataError(self._manifest, problem, remedy, code="no-overlap")
        causes = {
            "attitude without a position": int(np.count_nonzero(~placed)),
            "position without an attitude": int(np.count_nonzero(placed & ~turned)),
        }
        dropped = dict(telemetry.dropped) | {cause: count for cause, count in causes.items() if count}
        carrier = Trajectory(t_ns[known], position[known], multiply(turn, quaternion[known]), dropped=dropped)
        poses = replace(self._on_body(name, camera, carrier, gimbal), body_xyzw=None)
        return in_world(poses, self._logs.settings(stated).world_from_source)

    def _places(self, name: str, camera: CameraSources) -> Trajectory:
        """Return the places of a camera whose film says how it turned; rotations are NaN if not logged."""
        pose = camera.pose
        if self._is_joined(pose):
            telemetry = self._read(pose)
            for note in telemetry.notes:
                self._note(note)
            values, turn = self._in_world(name, telemetry.position)
            rotation = np.full((len(values), 4), np.nan)
            logged = Trajectory(telemetry.position.t_ns, values, rotation, dropped=dict(telemetry.dropped))
            gimbal = telemetry.gimbal
            if gimbal is not None and gimbal.relative_to == "world":
                gimbal = replace(gimbal, quaternion_xyzw=multiply(turn, gimbal.quaternion_xyzw))
                logged = replace(logged, quaternion_xyzw=self._on_gimbal(gimbal, logged, *mounted(None))[1])
            placed = in_world(logged, self._logs.settings(pose.file).world_from_source)
        else:
            placed = self._local(*self._stated_poses(name, camera))
            if not self._is_of_camera(camera):
                placed = replace(placed, quaternion_xyzw=np.full_like(placed.quaternion_xyzw, np.nan))
        return replace(in_world(placed, pose.world_from_source), covariance=None)

    def satellite_sigma_m(self, camera: CameraSources) -> float | None:
        """Return the standard deviation of a satellite receiver's positions; None for other positions."""
        if not self._is_joined(camera.pose):
            return None
        track = self._read(camera.pose).position
        if not (track.on_earth or track.origin is not None):
            return None
        return USUAL_SATELLITE_SIGMA_M if track.accuracy_m is None else max(track.accuracy_m)

    def _gimbal(self, name: str, camera: CameraSources, telemetry: Telemetry) -> AttitudeTrack | None:
        """Return the angles of the drone's own log, unless the body's attitudes are asked for."""
        gimbal, own = camera.gimbal, telemetry.gimbal
        if gimbal is None:
            if own is None or camera.pose.of == "body":
                return None
            self._note(f"{name}: its camera is turned by {own.name} of {camera.pose.file}")
            return own
        if own is None:
            problem = f"cameras.{name}.gimbal: {camera.pose.file} holds no gimbal angles"
            remedy = "name the log and topic that do, or fixed angles"
            raise DataError(self._manifest, problem, remedy, code="no-attitude")
        place = f"{self._manifest}: cameras.{name}.gimbal"
        turned = _turned_as_named(place, camera.pose.file, own, gimbal)
        self._note(
            f"{name}: its camera is turned by {own.name} of {camera.pose.file},"
            f" relative to the {turned.relative_to} as stated"
        )
        return turned

    def _refuse_unturned(
        self, name: str, camera: CameraSources, telemetry: Telemetry, gimbal: AttitudeTrack | None
    ) -> None:
        place = f"{self._manifest}: cameras.{name}"
        stated = camera.pose.file
        if telemetry.body is None and gimbal is None:
            problem = f"{stated} says where the drone was but not how it was turned"
            raise DataError(place, problem, ADD_ANGLES, code="no-attitude")
        if telemetry.body is None and gimbal is not None and gimbal.relative_to != "world":
            problem = (
                f"its gimbal's angles are relative to the {gimbal.relative_to}, but {stated} does not say how"
                " the body turned"
            )
            raise DataError(place, problem, "give angles relative to the world", code="no-attitude")
        if gimbal is None and camera.mount is None:
            raise DataError(place, f"{stated} holds no gimbal angles", _ADD_MOUNT, code="no-attitude")

    def _doubt(self, name: str, track: PositionTrack) -> None:
        if len(track.t_ns) < 2:
            return
        step_s = (median_step_ns(track.t_ns) or 0.0) / 1e9
        if step_s * 1e9 > self._max_gap_ns:
            self._note(
                f"{name}: {track.name} comes every {step_s:.3g} s, further apart than what is bridged"
                f" ({self._max_gap_ns / 1e9:g} s): raise --max-pose-gap above {step_s:.3g}"
            )
        if (track.values[:, :2] == track.values[0, :2]).all():
            where = "0" if not track.values[0, :2].any() else "the same"
            self._note(
                f"{name}: the horizontal position of {track.name} is {where} throughout: it had no fix, or"
                " never moved"
            )


def _turned_as_named(place: str, source: str, track: AttitudeTrack, gimbal: GimbalSource) -> AttitudeTrack:
    """Return logged angles of a gimbal relative to what the manifest names, by default what the log means."""
    meant = gimbal.relative_to or "world"
    if gimbal.relative_to is None or (meant == track.relative_to and meant not in track.stated):
        return track
    if meant not in track.stated:
        problem = f"{track.name} of {source} cannot be taken relative to the {meant}"
        raise DataError(place, problem, f"write relative_to: {track.relative_to}", code="wrong-option")
    turned = attitude_in_enu(track.stated[meant], relative_to=meant, axes="ned")
    return replace(track, quaternion_xyzw=turned, relative_to=meant)


def _first_place(track: PositionTrack) -> Place:
    latitude, longitude, height = track.values[0].tolist()
    return Place(latitude, longitude, 0.0 if track.height in _ABOVE_TAKE_OFF else height)
