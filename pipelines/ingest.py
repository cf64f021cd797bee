"""Stage `ingest`: everything that `flight.yaml` names, read once, checked, and stored as one session.

Frames get their world times here, poses their world axes, intrinsics the size of the pictures. What is
doubtful is counted and said; what cannot be used is refused with the file at fault. Each camera is a
chunk of its own: an interrupted ingest continues with the cameras that it had not finished.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Self

import numpy as np

from pipelines.formats.flights.flight_sources import CameraFrames, FlightSources, losses, source_files
from pipelines.formats.logs.mcap_checksums import OTHER_CHECKSUM, CheckedHash, stated_checksum
from pipelines.geometry.cameras import Intrinsics
from pipelines.geometry.clocks import ClockFit
from pipelines.geometry.poses import gaps, interpolate_poses
from pipelines.session.description import (
    ActorEntry,
    CameraEntry,
    ClockEntry,
    Description,
    FramesEntry,
    Interpolation,
    IntrinsicsEntry,
    KeypointsEntry,
    LogClockEntry,
    MapEntry,
    OriginEntry,
    PlannedEntry,
    PosesEntry,
    TruthEntry,
)
from pipelines.session.errors import DataError, MocapError, NotYetReadError
from pipelines.session.manifest import Camera, Flight, PoseSource, read_flight
from pipelines.session.maps import store_map
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import Detections, Int64, Trajectory
from pipelines.session.registries import noise_models
from pipelines.session.stages import Stage, StageRecord, locked
from pipelines.session.storage import read_json, sha256_of, write_json
from pipelines.session.tables import (
    ACTOR,
    CAMERA_POSES,
    FRAMES,
    KEYPOINTS,
    PLAN,
    POSES,
    POSES_WITH_COVARIANCE,
    TRUTH,
    write_table,
)
from pipelines.session.tabular import actor_table, frames_table, keypoints_table, motion_table, pose_table

INGEST = Stage("ingest", revision=1)

_MUCH_SHORTER = 0.9  # a video that covers less than this share of its pose log is worth a word
_SHORTER_S = 1.0
_HASHERS = 4
_AHEAD_ROWS = 200_000  # of cameras read while their sources are hashed: some 70 MB
_FASTEST_MPS = 100.0  # no camera that films a person flies faster
_FROZEN_S, _FROZEN_POSES = 1.0, 10  # a pose that stays the same for longer, and for as many messages


@dataclass(frozen=True)
class Ingested:
    """What an ingest left behind."""

    folder: Path
    record: StageRecord
    description: Description
    skipped: bool  # nothing had changed


def ingest(
    flight_path: Path,
    session: Path | None = None,
    *,
    max_pose_gap_s: float = 0.5,
    max_extrapolation_s: float = 0.1,
    strict: bool = False,
    overwrite: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> Ingested:
    """Read a flight into a session.

    Args:
        flight_path: the manifest.
        session: where to; by default `<name of the manifest>.session` beside it.
        max_pose_gap_s: frames between two logged poses further apart than this have no pose.
        max_extrapolation_s: frames further than this before or after all logged poses have none.
        strict: refuse a flight of which anything could not be read or used.
        overwrite: take a target that holds something else.
        force: read everything again although nothing changed.
        progress: who watches.

    Raises:
        DataError: something cannot be used; the session stays as it was.
        BusyError: another process writes the session.
    """
    progress = progress or Silent()
    flight = read_flight(flight_path)
    _refuse_unread_parts(flight, flight_path)
    target = session or flight_path.with_suffix(".session")
    _refuse_other_flight(target, flight, overwrite)
    interpolation = Interpolation(max_gap_s=max_pose_gap_s, max_extrapolation_s=max_extrapolation_s)
    settings = {
        "flight": flight.model_dump(mode="json"),
        "cameras": list(flight.cameras),  # their order decides between equals
        "pose_interpolation": interpolation.model_dump(),
        "flight_from_session": Path(os.path.relpath(flight_path.parent, target)).as_posix(),  # for media
    }

    with _Reader(flight, flight_path, target, interpolation) as reader:
        # Where nothing can be skipped, what is hashed is read at the same time.
        meanwhile = reader.read_ahead() if force or _is_new(target) else iter(())
        sources, damage = _hash_sources(flight, flight_path.parent, progress, meanwhile)
        with locked(target, create=True, overwrite=overwrite) as writable:
            run = writable.begin(INGEST, settings=settings, inputs=sources, force=force)
            if run.finished:
                stored_description = _stored_description(target)
                if strict:
                    _refuse_losses(flight_path, stored_description)
                return Ingested(target, run.record, stored_description, skipped=True)

            progress.start("Reading cameras", len(flight.cameras))
            entries: dict[str, CameraEntry] = {}
            warnings: list[str] = []
            for name in flight.cameras:
                chunk = run.chunk(name, partial(reader.store_camera, name))
                shutil.copytree(chunk / "tables", run.folder / "cameras" / name)
                stored = read_json(chunk / "entry.json")
                entries[name] = CameraEntry.model_validate(stored["entry"])
                warnings += stored["warnings"]
                progress.advance()
            _check_overlap(flight_path, entries)
            truth = reader.store_truth(run.folder, entries)
            actor = reader.store_actor(run.folder, entries)
            map_ = reader.store_map(run.folder, entries)
            plan = reader.store_plan(run.folder, entries)
            origin = reader.origin()
            warnings += reader.take_notes()
            warnings += [f"{path}: {losses(causes)}: copy it again" for path, causes in damage.items()]

            description = Description(
                schema_version=1,
                flight=flight.name,
                simulated=flight.simulated,
                clock_reference=flight.reference_camera,
                pose_interpolation=interpolation,
                origin=origin,
                cameras=entries,
                actor=actor,
                map=map_,
                truth=truth,
                plan=plan,
                sources=sources,
                damage=damage,
                warnings=warnings,
            )
            if strict:
                _refuse_losses(flight_path, description)
            write_json(run.folder / "session.json", description.model_dump(mode="json", by_alias=True))
            record = run.publish(counts=_counts(entries), warnings=warnings)
    return Ingested(target, record, description, skipped=False)


def _stored_description(folder: Path) -> Description:
    return Description.model_validate(read_json(folder / "session.json"))


def _refuse_losses(flight_path: Path, description: Description) -> None:
    """Refuse, in one line, a flight of which something was dropped: all of it, by part and cause."""
    parts = {
        f"{name}: {what}": dropped
        for name, camera in description.cameras.items()
        for what, dropped in (
            ("frames", camera.frames.dropped),
            ("poses", camera.poses.dropped),
            ("keypoints", camera.keypoints.dropped if camera.keypoints else {}),
        )
    }
    parts |= description.damage
    parts["actor"] = description.actor.dropped if description.actor else {}
    parts["map"] = description.map.dropped if description.map else {}
    parts |= {f"{name}: plan": sent.dropped for name, sent in (description.plan or {}).items()}
    lost = [f"{part}: {losses(dropped)}" for part, dropped in parts.items() if dropped]
    if lost:
        raise DataError(
            flight_path,
            f"is not whole, and --strict was given ({'; '.join(lost)})",
            "copy what is damaged again, or ingest without --strict",
        )


def _refuse_unread_parts(flight: Flight, path: Path) -> None:
    """Refuse, in one line, what is valid in a manifest but has no reader in this version."""
    if flight.actors:
        raise NotYetReadError(
            path,
            "actors: this version has no reader for it yet",
            "leave it out, or give the same data in a format of `mocap info --help`",
        )


def _refuse_other_flight(target: Path, flight: Flight, overwrite: bool) -> None:
    existing = target / "session.json"
    if overwrite or not existing.is_file():
        return
    try:
        held = read_json(existing).get("flight", flight.name)
    except DataError:
        return  # a damaged session is simply written anew
    if held != flight.name:
        raise DataError(
            target,
            f"holds the flight {held!r}, not {flight.name!r}",
            "choose another place with --output, or replace it with --overwrite",
        )


def _is_new(target: Path) -> bool:
    """Whether no ingest was finished or interrupted here."""
    return not any((target / entry).exists() for entry in (INGEST.name, ".partial"))


def _hash_sources(
    flight: Flight, base: Path, progress: Progress, meanwhile: Iterator[object]
) -> tuple[dict[str, str], dict[str, dict[str, int]]]:
    """The sha256 of every file that is read, by the path that the manifest states, and what is damaged.

    Args:
        flight: the manifest.
        base: the folder that its paths are relative to.
        progress: who watches.
        meanwhile: steps to take until all is hashed.
    """
    stated: list[str] = []

    def take(*paths: str | None) -> None:
        stated.extend(path for path in paths if path)

    def take_log(log: str | None) -> None:
        if log:
            take(*(flight.logs[log].path if log in flight.logs else [log]))

    for camera in flight.cameras.values():
        pose, times, video = camera.pose, camera.frame_times, camera.video
        take(pose.tum, pose.csv, pose.static.path if pose.static else None, camera.intrinsics.path)
        take(camera.keypoints.path if camera.keypoints else None)
        gimbal_log = camera.gimbal.log if camera.gimbal else None
        for log in (pose.log, pose.dji, pose.ulog, pose.ardupilot, camera.intrinsics.log, gimbal_log):
            take_log(log)
        if times:
            take(times.csv, times.srt)
            for log in (times.log, times.ulog, times.ardupilot):
                take_log(log)
        if video:
            take(video.path)
            take_log(video.log)
    if flight.actor:
        take_log(flight.actor.log)
    if flight.map:
        take(flight.map.path)
        take_log(flight.map.log)
    if flight.plan:
        for name in flight.plan.topics:
            take_log(flight.plan.log_of(name))
        take(*flight.plan.files.values())
    if flight.truth:
        take(flight.truth.joints.path if flight.truth.joints else None, *flight.truth.poses.values())
    unique = list(dict.fromkeys(stated))
    progress.start("Hashing sources", len(unique))
    hashes, damage = {}, {}
    with ThreadPoolExecutor(_HASHERS) as pool:  # hashing releases the interpreter: long logs side by side
        hashing = {path: pool.submit(_hash_of, base / path) for path in unique}
        try:
            while not all(digest.done() for digest in hashing.values()) and next(meanwhile, None):
                pass
            for path, digest in hashing.items():
                hashes[path], differing = digest.result()
                if differing:
                    damage[path] = {OTHER_CHECKSUM: differing}
                progress.advance()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return hashes, damage


def _hash_of(path: Path) -> tuple[str, int]:
    """The sha256 of a source, and how many of its files are not what their own checksum says.

    A floor plan's YAML is hashed together with the picture that it names.
    """
    hashes: list[CheckedHash] = []

    def hash_for(file: Path) -> CheckedHash:
        hashes.append(CheckedHash(stated_checksum(file)))
        return hashes[-1]

    digests = [sha256_of(file, hash_for) for file in source_files(path)]
    digest = digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()
    return digest, sum(each.differs for each in hashes)


def _counts(entries: Mapping[str, CameraEntry]) -> dict[str, object]:
    return {
        "cameras": len(entries),
        "frames": sum(entry.frames.count for entry in entries.values()),
        "frames_without_pose": sum(entry.poses.frames_without_pose for entry in entries.values()),
        "detections": sum(entry.keypoints.detections for entry in entries.values() if entry.keypoints),
    }


def _check_overlap(flight_path: Path, entries: Mapping[str, CameraEntry]) -> None:
    """Refuse cameras whose frames share no moment with the others', not even by way of a third camera."""
    ordered = sorted(entries, key=lambda name: entries[name].frames.first_t_ns)
    reached_ns = entries[ordered[0]].frames.last_t_ns
    for place, name in enumerate(ordered):
        frames = entries[name].frames
        if frames.first_t_ns > reached_ns:
            # The smaller side is the odd one out.
            late = 2 * place >= len(ordered)
            odd, rest = (ordered[place:], ordered[:place]) if late else (ordered[:place], ordered[place:])
            raise DataError(
                flight_path,
                f"cameras.{', '.join(odd)}: frames ({_span_of(odd, entries)}) overlap in time with no other"
                f" camera's ({_span_of(rest, entries)})",
                "check frame_times.start and clock.offset_s",
            )
        reached_ns = max(reached_ns, frames.last_t_ns)


def _span_of(names: Sequence[str], entries: Mapping[str, CameraEntry]) -> str:
    frames = [entries[name].frames for name in names]
    return _span(min(f.first_t_ns for f in frames), max(f.last_t_ns for f in frames))


@dataclass(frozen=True)
class _CameraData:
    """What was read of one camera."""

    detections: Detections | None
    detector_format: str
    intrinsics: Intrinsics
    frames: CameraFrames
    trajectory: Trajectory
    notes: list[str]

    @property
    def rows(self) -> int:
        """About how many rows it will have in all tables."""
        return (
            len(self.frames.t_ns)
            + len(self.trajectory.t_ns)
            + (len(self.detections.frame) if self.detections else 0)
        )


class _Reader:
    """Reads and stores the parts of one flight; what is doubted is collected as notes.

    A context manager that closes the logs.
    """

    def __init__(
        self, flight: Flight, flight_path: Path, session: Path, interpolation: Interpolation
    ) -> None:
        self._flight = flight
        self._flight_path = flight_path
        self._session = session
        self._interpolation = interpolation
        self._max_gap_ns = round(interpolation.max_gap_s * 1e9)
        self._notes: list[str] = []
        self._sources = FlightSources(
            flight, flight_path, max_gap_ns=self._max_gap_ns, note=self._notes.append
        )
        self._ahead: dict[str, _CameraData] = {}

    def __enter__(self) -> Self:
        """The reader itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the logs."""
        self._sources.__exit__(*exception)

    def read_ahead(self) -> Iterator[str]:
        """Read one camera after the other for `store_camera` to take, up to some amount of memory.

        A fault ends it, and shows again when that camera is stored.
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
        """What was noted since the last time this was asked."""
        taken = list(dict.fromkeys(self._notes))
        self._notes.clear()
        return taken

    def store_camera(self, name: str, folder: Path) -> None:
        """Write the tables of one camera and what is to be said of them."""
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
                sigma_s=camera.clock.sigma_s if camera.clock else frames.start_sigma_s,
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
        write_json(folder / "entry.json", {"entry": entry.model_dump(mode="json"), "warnings": warnings})

    def _read_camera(self, name: str) -> _CameraData:
        """Everything that is read of one camera, checked against each other."""
        camera, sources = self._flight.cameras[name], self._sources
        video = sources.video(camera)
        detections, detector_format = None, ""
        if camera.keypoints:
            detections, detector_format = sources.keypoints(camera.keypoints)
        intrinsics = sources.intrinsics(name, camera, video, detections)
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
        """Where on Earth the world lies, and what is doubtful about heights counted from there."""
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
        """Write what is known to be true and say what it spans."""
        truth = self._flight.truth
        if truth is None:
            return None
        motion = self._sources.true_joints(truth.joints) if truth.joints else None
        if motion is not None and truth.joints is not None:
            self._refuse_no_overlap(truth.joints.path, motion.t_ns, entries)
            write_table(folder / "truth.parquet", motion_table(motion), TRUTH)
        if truth.poses:
            import pandas as pd

            tables = [
                pose_table(self._sources.true_poses(stated)).assign(camera=name)
                for name, stated in truth.poses.items()
            ]
            write_table(folder / "truth_poses.parquet", pd.concat(tables, ignore_index=True), CAMERA_POSES)
        return TruthEntry(
            joints=list(motion.joints) if motion else [],
            people=motion.position.shape[1] if motion else 0,
            first_t_ns=int(motion.t_ns[0]) if motion else 0,
            last_t_ns=int(motion.t_ns[-1]) if motion else 0,
            cameras=list(truth.poses),
        )

    def store_actor(self, folder: Path, entries: Mapping[str, CameraEntry]) -> ActorEntry | None:
        """Write where the actor was, as logged."""
        actor = self._flight.actor
        if actor is None:
            return None
        trajectory = self._sources.actor(actor.log, actor.topic)
        self._refuse_no_overlap(actor.log, trajectory.t_ns, entries)
        write_table(folder / "actor.parquet", actor_table(trajectory), ACTOR)
        return ActorEntry(
            source=actor.log, point=actor.point, count=len(trajectory.t_ns), dropped=trajectory.dropped
        )

    def store_map(self, folder: Path, entries: Mapping[str, CameraEntry]) -> MapEntry | None:
        """Write what stands around: one map, or those of a log that replaced each other.

        What is said of several is said of the last one.
        """
        stated = self._flight.map
        if stated is None:
            return None
        if stated.log:
            logged = self._sources.logged_maps(stated)
            self._refuse_later_map(stated.log, int(logged.from_ns[0]), entries)
            occupancy, dropped = store_map(folder, logged.maps), logged.dropped
        else:
            path = stated.path or ""
            occupancy = store_map(folder, [self._sources.map(path, stated.resolution_m)])
            dropped = occupancy.dropped
            if self._flight.world.frame == "ned":
                self._notes.append(f"{path}: the map is taken to be in ENU axes although the world is NED")
        if dropped:
            self._notes.append(f"map: dropped: {losses(dropped)}")
        known = occupancy.probability[~np.isnan(occupancy.probability)]
        return MapEntry(
            source=stated.log or stated.path or "",
            unknown=stated.unknown,
            resolution_m=occupancy.resolution_m,
            shape=list(occupancy.probability.shape),
            occupied=int((known >= 0.5).sum()),
            free=int((known < 0.5).sum()),
            dropped=dropped,
        )

    def store_plan(self, folder: Path, entries: Mapping[str, CameraEntry]) -> dict[str, PlannedEntry] | None:
        """Write where the on-board planner sent the drones."""
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
        last = max(entry.frames.last_t_ns for entry in entries.values())
        if from_ns > last:
            first = min(entry.frames.first_t_ns for entry in entries.values())
            raise DataError(
                f"{self._flight_path}: map.log {log}",
                f"has its first map at {from_ns / 1e9:.3f} s, after the pictures ({_span(first, last)})",
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
            self._doubt_speed(name, trajectory)
            self._notes += [f"{name}: {doubt}" for doubt in doubts_of_stillness(trajectory)]
            span, covered = int(np.ptp(poses_t_ns)) / 1e9, int(np.ptp(frames_t_ns)) / 1e9
            if covered < _MUCH_SHORTER * span and span - covered > _SHORTER_S:
                self._notes.append(f"{name}: its pictures cover {covered:.1f} s of {span:.1f} s of poses")
        return PosesEntry(
            source=_pose_source(camera.pose),
            static=static,
            count=len(poses_t_ns),
            rate_hz=_rate(poses_t_ns),
            gaps_ns=[] if static else gaps(poses_t_ns, self._max_gap_ns),
            frames_without_pose=without_pose,
            dropped=trajectory.dropped,
            stamps=self._sources.stamps(camera.pose.log) if camera.pose.log else None,
        )

    def _doubt_speed(self, name: str, trajectory: Trajectory) -> None:
        step_s = np.diff(trajectory.t_ns) / 1e9
        speed = np.linalg.norm(np.diff(trajectory.position, axis=0), axis=1) / step_s
        too_fast = speed > _FASTEST_MPS
        if too_fast.any():
            first_s = int(trajectory.t_ns[np.argmax(too_fast)] - trajectory.t_ns[0]) / 1e9
            self._notes.append(
                f"{name}: its poses jump {int(too_fast.sum())} times, by up to {speed.max():.3g} m/s"
                f" (first after {first_s:.2f} s)"
            )

    def _frames_without_pose(
        self, name: str, camera: Camera, trajectory: Trajectory, frames_t_ns: Int64
    ) -> int:
        position, _ = interpolate_poses(
            trajectory.t_ns,
            trajectory.position,
            trajectory.quaternion_xyzw,
            frames_t_ns,
            max_gap_ns=self._max_gap_ns,
            max_extrapolation_ns=round(self._interpolation.max_extrapolation_s * 1e9),
        )
        without = int(np.isnan(position[:, 0]).sum())
        if without == len(frames_t_ns):
            raise DataError(
                self._flight_path.parent / _pose_source(camera.pose),
                f"has a pose for none of the {without} frames of camera {name}: frames span"
                f" {_span(frames_t_ns[0], frames_t_ns[-1])}, poses {_span(*trajectory.t_ns[[0, -1]])}"
                f" at {_rate(trajectory.t_ns) or 0:.3g} Hz",
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
        first = min(entry.frames.first_t_ns for entry in entries.values())
        last = max(entry.frames.last_t_ns for entry in entries.values())
        if t_ns[0] > last or t_ns[-1] < first:
            raise DataError(
                self._flight_path.parent / stated,
                f"spans {_span(t_ns[0], t_ns[-1])}, the pictures {_span(first, last)}",
                "check its time base: stamps are world times",
            )


def doubts_of_stillness(trajectory: Trajectory) -> list[str]:
    """Where poses that otherwise change are the same to the last bit for over a second, in one line or none.

    No drone is so still, but the estimator may have frozen. The poses stay in use: nothing but their
    sameness is against them, and a camera on the ground is as still in a log without noise.
    """
    pose = np.concatenate([trajectory.position, trajectory.quaternion_xyzw], axis=1)
    changes = np.flatnonzero((np.diff(pose, axis=0) != 0).any(axis=1))
    first, last = np.append(0, changes + 1), np.append(changes, len(pose) - 1)
    lasts_s = (trajectory.t_ns[last] - trajectory.t_ns[first]) / 1e9
    count = last - first + 1
    frozen = (lasts_s > _FROZEN_S) & (count >= _FROZEN_POSES)
    if not frozen.any() or len(first) == 1:
        return []
    after_s = int(trajectory.t_ns[first[np.argmax(frozen)]] - trajectory.t_ns[0]) / 1e9
    return [
        f"its poses stand still {frozen.sum()} times, for up to {lasts_s.max():.3g} s ({count[frozen].sum()}"
        f" poses in all, first after {after_s:.2f} s): was its estimator frozen?"
    ]


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
    )


def _within(detections: Detections, frames: CameraFrames) -> Detections:
    """The detections of frames that there are; the others are counted."""
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


def _log_clock_entry(fit: ClockFit | None) -> LogClockEntry | None:
    return None if fit is None else LogClockEntry(**asdict(fit))


def _pose_source(pose: PoseSource) -> str:
    drones_own = pose.dji or pose.ulog or pose.ardupilot
    return pose.tum or pose.csv or drones_own or (pose.static.path if pose.static else pose.log) or ""


def _rate(t_ns: Int64) -> float | None:
    return 1e9 * (len(t_ns) - 1) / float(t_ns[-1] - t_ns[0]) if len(t_ns) > 1 else None


def _span(first_ns: int, last_ns: int) -> str:
    return f"{first_ns / 1e9:.3f} to {last_ns / 1e9:.3f} s"
