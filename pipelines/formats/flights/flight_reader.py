"""Parts of a flight as a session stores them: tables, their entries in session.json, and doubts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from pipelines.formats.flights.flight_sources import FlightSources, losses, mounted
from pipelines.formats.flights.frame_sources import CameraFrames
from pipelines.formats.flights.pose_doubts import doubts_of_speed, doubts_of_stillness
from pipelines.geometry.cameras import Intrinsics
from pipelines.geometry.clocks import ClockFit
from pipelines.geometry.poses import gaps
from pipelines.session.camera_poses import poses_at
from pipelines.session.description import (
    ActorEntry,
    CameraEntry,
    ClockEntry,
    FramesEntry,
    Interpolation,
    IntrinsicsEntry,
    KeypointsEntry,
    LogClockEntry,
    MapEntry,
    MountEntry,
    OriginEntry,
    PlannedEntry,
    PosesEntry,
    TruthEntry,
)
from pipelines.session.errors import DataError, MocapError
from pipelines.session.manifest import Camera, Flight, PoseSource
from pipelines.session.maps import store_map
from pipelines.session.records import Detections, Int64, JointMotion, Trajectory
from pipelines.session.registries import noise_models
from pipelines.session.storage import write_json
from pipelines.session.tables import (
    ACTOR,
    CAMERA_POSES,
    FRAMES,
    KEYPOINTS,
    PLAN,
    POSES,
    POSES_WITH_COVARIANCE,
    TRUTH,
    actor_table,
    frames_table,
    keypoints_table,
    motion_table,
    pose_table,
    write_table,
)

_MUCH_SHORTER = 0.9  # a video that covers less than this share of its pose log gets a note
_SHORTER_S = 1.0
# Share of a picture's sides. Detectors search the box of a person; most of them pad it to 1.25 of its size.
# If the box is as large as the picture, it then reaches an eighth beyond it: no detector looked further.
_EXTRAPOLATED = 1 / 8
_AHEAD_ROWS = 200_000  # of cameras that are read during hashing: some 70 MB


@dataclass(frozen=True)
class _CameraData:
    """Data of one camera, as read."""

    detections: Detections | None
    detector_format: str
    intrinsics: Intrinsics
    frames: CameraFrames
    trajectory: Trajectory
    notes: list[str]

    @property
    def rows(self) -> int:
        """Approximate number of its rows in all tables."""
        return (
            len(self.frames.t_ns)
            + len(self.trajectory.t_ns)
            + (len(self.detections.frame) if self.detections else 0)
        )


class FlightReader:
    """Reader that stores the parts of one flight and collects doubts as notes.

    It is a context manager that closes the logs.
    """

    def __init__(
        self, flight: Flight, flight_path: Path, session: Path, interpolation: Interpolation
    ) -> None:
        self._flight = flight
        self._flight_path = flight_path
        self._session = session
        self._interpolation = interpolation
        self._notes: list[str] = []
        self._sources = FlightSources(
            flight, flight_path, max_gap_ns=interpolation.max_gap_ns, note=self._notes.append
        )
        self._ahead: dict[str, _CameraData] = {}

    def __enter__(self) -> Self:
        """Return the reader itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the logs."""
        self._sources.__exit__(*exception)

    def read_ahead(self) -> Iterator[str]:
        """Read cameras in advance for `store_camera`, one after the other, up to `_AHEAD_ROWS` rows.

        An error ends it. The same error is raised again when that camera is stored.
        """
        for name in self._flight.cameras:
            if sum(data.rows for data in self._ahead.values()) > _AHEAD_ROWS:
                return
            try:
                self._ahead[name] = self._read_camera(name)
            except (MocapError, OSError):
                self._notes.clear()
                return
            yield name

    def take_notes(self) -> list[str]:
        """Return the notes since the last call, each once."""
        taken = list(dict.fromkeys(self._notes))
        self._notes.clear()
        return taken

    def store_camera(self, name: str, folder: Path) -> None:
        """Write the tables of one camera, its entry and its warnings."""
        camera = self._flight.cameras[name]
        data = self._ahead.pop(name, None) or self._read_camera(name)
        detections, frames, trajectory = data.detections, data.frames, data.trajectory

        tables = folder / "tables"
        tables.mkdir()
        write_table(tables / "frames.parquet", frames_table(frames.frame, frames.t_ns, frames.pts_ns), FRAMES)
        write_table(
            tables / "poses.parquet",
            pose_table(trajectory),
            POSES if trajectory.covariance is None else POSES_WITH_COVARIANCE,
        )
        if detections is not None:
            keypoints = keypoints_table(detections, frames.frame, frames.t_ns)
            write_table(tables / "keypoints.parquet", keypoints, KEYPOINTS)
        entry = CameraEntry(
            intrinsics=IntrinsicsEntry.of(data.intrinsics),
            frames=FramesEntry(
                count=len(frames.t_ns),
                first_t_ns=int(frames.t_ns[0]),
                last_t_ns=int(frames.t_ns[-1]),
                rate_hz=_rate(frames.t_ns),
                dropped=frames.dropped,
            ),
            poses=self._poses_entry(name, camera, trajectory, frames.t_ns),
            keypoints=_keypoints_entry(camera, detections, data.detector_format, len(frames.t_ns)),
            clock=ClockEntry(
                offset_s=camera.clock.offset_ns / 1e9 if camera.clock else 0.0,
                sigma_s=_clock_sigma_s(camera, frames),
            ),
            log_clock=_log_clock_entry(self._sources.log_clock(camera)),
            pose_noise=camera.pose_noise,
            media=self._sources.media(camera, frames, self._session),
        )
        warnings = list(dict.fromkeys(data.notes + self.take_notes()))
        for what, dropped in (
            ("frames", entry.frames.dropped),
            ("poses", entry.poses.dropped),
            ("keypoints", entry.keypoints.dropped if entry.keypoints else {}),
        ):
            warnings += [f"{name}: {what} dropped: {losses(dropped)}"] if dropped else []
        if entry.keypoints and entry.keypoints.adjusted:
            warnings.append(f"{name}: keypoints adjusted: {losses(entry.keypoints.adjusted)}")
        write_json(folder / "entry.json", {"entry": entry.model_dump(mode="json"), "warnings": warnings})

    def _read_camera(self, name: str) -> _CameraData:
        """Read everything about one camera, and check the parts against each other."""
        camera, sources = self._flight.cameras[name], self._sources
        video = sources.video(camera)
        detections, detector_format = None, ""
        if camera.keypoints:
            detections, detector_format = sources.keypoints(camera.keypoints)
        intrinsics = sources.intrinsics(name, camera, video, detections)
        if detections is not None:
            if camera.keypoints:
                detections = unmirrored(detections, camera.keypoints.mirrored, intrinsics.width)
            detections = _near_picture(detections, intrinsics)
        frames = sources.frames(name, camera, video, detections, intrinsics)
        trajectory = sources.trajectory(name, camera, int(frames.t_ns[0]))
        if camera.pose_noise:
            noise_models(f"{self._flight_path}: cameras.{name}.pose_noise", camera.pose_noise)
        if detections is not None:
            detections = _within(detections, frames)
            if not len(detections.frame):
                raise DataError(
                    self._flight_path,
                    f"cameras.{name}: no frame of its keypoints is one of its pictures",
                    "check first_frame and frame_times",
                )
        return _CameraData(detections, detector_format, intrinsics, frames, trajectory, self.take_notes())

    def origin(self) -> OriginEntry | None:
        """Return the world's origin on Earth, if known; note cameras with different height references."""
        found = self._sources.origin()
        if found is None:
            return None
        place = found.place
        return OriginEntry(
            latitude_deg=place.latitude_deg,
            longitude_deg=place.longitude_deg,
            altitude_m=place.altitude_m,
            source=found.source,
        )

    def store_truth(self, folder: Path, entries: Mapping[str, CameraEntry]) -> TruthEntry | None:
        """Write the ground truth, and return its entry with its joints, cameras and time span."""
        truth = self._flight.truth
        if truth is None:
            return None
        motion = self._sources.true_joints(truth.joints) if truth.joints else None
        if motion is not None and truth.joints is not None:
            self._refuse_no_overlap(truth.joints.path, motion.t_ns, entries)
            write_table(folder / "truth.parquet", motion_table(motion), TRUTH)
        missing, dropped = self._note_truth_missing(motion) if motion else (0, {})
        poses_dropped = {}
        if truth.poses:
            import pandas as pd

            tables = []
            for name, stated in truth.poses.items():
                poses = self._sources.true_poses(stated)
                tables.append(pose_table(poses).assign(camera=name))
                if poses.dropped:
                    poses_dropped[name] = poses.dropped
                    self._notes.append(f"{name}: true poses dropped: {losses(poses.dropped)}")
            write_table(folder / "truth_poses.parquet", pd.concat(tables, ignore_index=True), CAMERA_POSES)
        return TruthEntry(
            joints=list(motion.joints) if motion else [],
            people=motion.position.shape[1] if motion else 0,
            first_t_ns=int(motion.t_ns[0]) if motion else 0,
            last_t_ns=int(motion.t_ns[-1]) if motion else 0,
            cameras=list(truth.poses),
            missing=missing,
            dropped=dropped,
            poses_dropped=poses_dropped,
        )

    def _note_truth_missing(self, motion: JointMotion) -> tuple[int, dict[str, int]]:
        """Count the true positions that are missing, and those of them that were dropped; note both."""
        is_missing = np.isnan(motion.position[..., 0])
        missing = int(is_missing.sum())
        if motion.dropped:
            self._notes.append(f"truth: positions dropped: {losses(motion.dropped)}")
        if missing > sum(motion.dropped.values()):
            self._notes.append(f"truth: {missing} of {is_missing.size} positions of joints are missing")
        return missing, motion.dropped

    def store_actor(self, folder: Path, entries: Mapping[str, CameraEntry]) -> ActorEntry | None:
        """Write the actor's logged positions."""
        actor = self._flight.actor
        if actor is None:
            return None
        trajectory = self._sources.actor(actor.log, actor.topic)
        self._refuse_no_overlap(actor.log, trajectory.t_ns, entries)
        write_table(folder / "actor.parquet", actor_table(trajectory), ACTOR)
        if trajectory.dropped:
            self._notes.append(f"actor: dropped: {losses(trajectory.dropped)}")
        return ActorEntry(
            source=actor.log,
            sources=self._sources.files(actor.log),
            topic=actor.topic,
            point=actor.point,
            count=len(trajectory.t_ns),
            dropped=trajectory.dropped,
        )

    def store_map(self, folder: Path, entries: Mapping[str, CameraEntry]) -> MapEntry | None:
        """Write the map of obstacles: one from a file, or those of a log that replaced each other."""
        stated = self._flight.map
        if stated is None:
            return None
        if stated.log:
            logged = self._sources.logged_maps(stated)
            self._refuse_later_map(stated.log, int(logged.from_ns[0]), entries)
            held, dropped = store_map(folder, logged.maps), logged.dropped
        else:
            path = stated.path or ""
            occupancy = self._sources.map(path, stated.resolution_m)
            held, dropped = store_map(folder, [occupancy]), occupancy.dropped
            if self._flight.world.frame == "ned":
                self._notes.append(f"{path}: the map is taken to be in ENU axes although the world is NED")
        if dropped:
            self._notes.append(f"map: dropped: {losses(dropped)}")
        return MapEntry(
            source=stated.log or stated.path or "",
            unknown=stated.unknown,
            resolution_m=held[-1].resolution_m,
            shape=held[-1].shape,
            occupied=held[-1].occupied,
            free=held[-1].free,
            dropped=dropped,
            maps=held,
        )

    def store_plan(self, folder: Path, entries: Mapping[str, CameraEntry]) -> dict[str, PlannedEntry] | None:
        """Write the positions that the on-board planner commanded."""
        plan = self._flight.plan
        if plan is None:
            return None
        import pandas as pd

        tables, found = [], {}
        for name in (camera for camera in self._flight.cameras if camera in plan.cameras):
            stated = plan.files.get(name) or plan.log_of(name)
            sent = self._sources.planned(name, plan)
            self._refuse_no_overlap(stated, sent.t_ns, entries)
            if sent.dropped:
                self._notes.append(f"{name}: commands dropped: {losses(sent.dropped)}")
            tables.append(pose_table(sent).assign(camera=name))
            found[name] = PlannedEntry(source=stated, count=len(sent.t_ns), dropped=sent.dropped)
        write_table(folder / "plan.parquet", pd.concat(tables, ignore_index=True), PLAN)
        return found

    def _refuse_later_map(self, log: str, from_ns: int, entries: Mapping[str, CameraEntry]) -> None:
        first, last = _span_of_pictures(entries)
        if from_ns > last:
            raise DataError(
                f"{self._flight_path}: map.log {log}",
                f"has its first map at {from_ns / 1e9:.3f} s, after the pictures ({span_words(first, last)})",
                "check its clock, or take `stamps: receive`",
            )

    def _poses_entry(
        self, name: str, camera: Camera, trajectory: Trajectory, frames_t_ns: Int64
    ) -> PosesEntry:
        static = camera.pose.static is not None
        poses_t_ns = trajectory.t_ns
        without_pose = 0
        if not static:
            without_pose = self._frames_without_pose(name, camera, trajectory, frames_t_ns)
            doubts = [*doubts_of_speed(trajectory), *doubts_of_stillness(trajectory)]
            self._notes += [f"{name}: {doubt}" for doubt in doubts]
            span, covered = int(np.ptp(poses_t_ns)) / 1e9, int(np.ptp(frames_t_ns)) / 1e9
            if covered < _MUCH_SHORTER * span and span - covered > _SHORTER_S:
                self._notes.append(f"{name}: its pictures cover {covered:.1f} s of {span:.1f} s of poses")
        return PosesEntry(
            source=_pose_source(camera.pose),
            static=static,
            count=len(poses_t_ns),
            rate_hz=_rate(poses_t_ns),
            gaps_ns=[] if static else gaps(poses_t_ns, self._interpolation.max_gap_ns),
            frames_without_pose=without_pose,
            dropped=trajectory.dropped,
            stamps=self._sources.stamps(camera.pose.log) if camera.pose.log else None,
            mount=_mount_entry(camera),
        )

    def _frames_without_pose(
        self, name: str, camera: Camera, trajectory: Trajectory, frames_t_ns: Int64
    ) -> int:
        position, _ = poses_at(trajectory, frames_t_ns, self._interpolation)
        without = int(np.isnan(position[:, 0]).sum())
        if without == len(frames_t_ns):
            frames, poses = (span_words(*t_ns[[0, -1]]) for t_ns in (frames_t_ns, trajectory.t_ns))
            raise DataError(
                self._flight_path.parent / _pose_source(camera.pose),
                f"has a pose for none of the {without} frames of camera {name}: frames span {frames}, poses"
                f" {poses} at {_rate(trajectory.t_ns) or 0:.3g} Hz",
                "check clocks and units, or raise --max-pose-gap",
            )
        if without:
            self._notes.append(
                f"{name}: {without} of {len(frames_t_ns)} frames have no pose (no logged pose within"
                f" {self._interpolation.max_gap_s:g} s gaps and {self._interpolation.max_extrapolation_s:g} s"
                " at the ends)"
            )
        return without

    def _refuse_no_overlap(self, stated: str, t_ns: Int64, entries: Mapping[str, CameraEntry]) -> None:
        first, last = _span_of_pictures(entries)
        if t_ns[0] > last or t_ns[-1] < first:
            raise DataError(
                self._flight_path.parent / stated,
                f"spans {span_words(t_ns[0], t_ns[-1])}, the pictures {span_words(first, last)}",
                "check its time base: stamps are world times",
            )


def _keypoints_entry(
    camera: Camera, detections: Detections | None, detector_format: str, frames: int
) -> KeypointsEntry | None:
    if camera.keypoints is None or detections is None:
        return None
    return KeypointsEntry(
        source=camera.keypoints.path,
        format=detector_format,
        joints=list(detections.joints),
        detections=len(detections.frame),
        people_at_once=int(np.unique(detections.frame, return_counts=True)[1].max()),
        frames_without_person=frames - len(np.unique(detections.frame)),
        dropped=detections.dropped,
        adjusted=detections.adjusted,
    )


def unmirrored(detections: Detections, mirrored: bool | str, width: int) -> Detections:
    """Undo that keypoints were found in mirrored pictures.

    Args:
        detections: as the file has them.
        mirrored: True, or of what: "x" alone counts from the right, or "names" alone have left for right.
        width: of the pictures, px.
    """
    if mirrored in (True, "x"):
        xy = detections.xy.copy()
        xy[..., 0] = width - 1 - xy[..., 0]
        detections = replace(detections, xy=xy)
    if mirrored in (True, "names"):
        order = [detections.joints.index(_other_side(name, detections.joints)) for name in detections.joints]
        detections = replace(
            detections, xy=detections.xy[:, order], confidence=detections.confidence[:, order]
        )
    return detections


def _other_side(name: str, joints: tuple[str, ...]) -> str:
    """Return the name of the same joint on the other side; its own if there is none."""
    other = {"left": "right", "right": "left"}.get(name.partition("_")[0])
    opposite = f"{other}_{name.partition('_')[2]}" if other else name
    return opposite if opposite in joints else name


def _near_picture(detections: Detections, intrinsics: Intrinsics) -> Detections:
    """Drop and count keypoints further outside the picture than a detector may extrapolate."""
    size = np.array([intrinsics.width, intrinsics.height])
    margin = _EXTRAPOLATED * size
    with np.errstate(invalid="ignore"):
        beyond = (detections.xy < -0.5 - margin) | (detections.xy > size - 0.5 + margin)
    far = np.asarray(beyond.any(axis=-1))
    if not far.any():
        return detections
    lost = {"keypoints far outside the picture": int(far.sum())}
    xy = np.where(far[..., None], np.nan, detections.xy)
    confidence = np.where(far, 0.0, detections.confidence)
    seen = np.isfinite(xy).any(axis=(1, 2))
    if not seen.all():
        lost["people far outside the picture"] = int((~seen).sum())
    return replace(
        detections,
        frame=detections.frame[seen],
        person=detections.person[seen],
        xy=xy[seen],
        confidence=confidence[seen],
        dropped=dict(Counter(detections.dropped) + Counter(lost)),
    )


def _within(detections: Detections, frames: CameraFrames) -> Detections:
    """Keep the detections in frames that have a time; count the others."""
    known = np.isin(detections.frame, frames.frame)
    if known.all():
        return detections
    lost = {"detections in frames without a time": int((~known).sum())}
    return replace(
        detections,
        frame=detections.frame[known],
        person=detections.person[known],
        xy=detections.xy[known],
        confidence=detections.confidence[known],
        dropped=detections.dropped | lost,
    )


def _clock_sigma_s(camera: Camera, frames: CameraFrames) -> float:
    """Return the clock sigma of the manifest; one estimated by motion comes before the manifest's default."""
    clock = camera.clock
    if clock is None or (frames.start_sigma_s and "sigma_s" not in clock.model_fields_set):
        return frames.start_sigma_s
    return clock.sigma_s


def _log_clock_entry(fit: ClockFit | None) -> LogClockEntry | None:
    return None if fit is None else LogClockEntry(**asdict(fit))


def _pose_source(pose: PoseSource) -> str:
    drones_own = pose.dji or pose.ulog or pose.ardupilot
    return pose.tum or pose.csv or drones_own or (pose.static.path if pose.static else pose.log) or ""


def _rate(t_ns: Int64) -> float | None:
    return 1e9 * (len(t_ns) - 1) / float(t_ns[-1] - t_ns[0]) if len(t_ns) > 1 else None


def _span_of_pictures(entries: Mapping[str, CameraEntry]) -> tuple[int, int]:
    """Return the first and the last frame time of all cameras, ns."""
    frames = [entry.frames for entry in entries.values()]
    return min(each.first_t_ns for each in frames), max(each.last_t_ns for each in frames)


def span_words(first_ns: int, last_ns: int) -> str:
    """Format a time span for messages."""
    return f"{first_ns / 1e9:.3f} to {last_ns / 1e9:.3f} s"


def _mount_entry(camera: Camera) -> MountEntry | None:
    """Describe how a camera is fixed to the body whose poses are logged; None where it is not fixed."""
    if camera.mount is None or camera.gimbal is not None:
        return None
    translation, rotation_xyzw = mounted(camera.mount)
    return MountEntry(translation=tuple(translation.tolist()), rotation_xyzw=tuple(rotation_xyzw.tolist()))
