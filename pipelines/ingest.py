"""Stage `ingest`: everything that `flight.yaml` names, read once, checked, and stored as one session.

Frames get their world times here, poses their world axes, intrinsics the size of the pictures. What is
doubtful is counted and said; what cannot be used is refused with the file at fault. Each camera is a
chunk of its own: an interrupted ingest continues with the cameras that it had not finished.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.cameras import Intrinsics, fit_to_size
from pipelines.geometry.poses import enu_from_ned, gaps, interpolate_poses
from pipelines.session.description import (
    CameraEntry,
    ClockEntry,
    Description,
    FramesEntry,
    Interpolation,
    IntrinsicsEntry,
    KeypointsEntry,
    PosesEntry,
    TruthEntry,
)
from pipelines.session.errors import DataError, NotYetReadError
from pipelines.session.manifest import (
    Axes,
    Camera,
    Flight,
    IntrinsicsSource,
    KeypointSource,
    Truth,
    read_flight,
)
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import CalibratedCamera, Detections, JointMotion, Trajectory
from pipelines.session.registries import (
    FORMATS,
    CalibrationFormat,
    JointFormat,
    KeypointFormat,
    TrajectoryFormat,
    noise_models,
    recognise,
)
from pipelines.session.stages import Stage, StageRecord, locked
from pipelines.session.storage import read_json, sha256_of, write_json
from pipelines.session.tables import (
    CAMERA_POSES,
    FRAMES,
    KEYPOINTS,
    POSES,
    POSES_WITH_COVARIANCE,
    TRUTH,
    write_table,
)
from pipelines.session.tabular import frames_table, keypoints_table, motion_table, pose_table

if TYPE_CHECKING:
    import pandas as pd

INGEST = Stage("ingest", revision=1)

_MOST_FRAMES = 20_000_000  # a week at 30 Hz: more is a frame number misread from a date
_LARGEST_SHARE_OUTSIDE = 0.05  # of keypoints beyond the picture; detectors overshoot the border a little


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
    sources = _hash_sources(flight, flight_path.parent)
    settings = {
        "flight": flight.model_dump(mode="json"),
        "pose_interpolation": interpolation.model_dump(),
    }

    with locked(target, create=True, overwrite=overwrite) as writable:
        run = writable.begin(INGEST, settings=settings, inputs=sources, force=force)
        if run.finished:
            return Ingested(target, run.record, _stored_description(target), skipped=True)

        reader = _Reader(flight, flight_path, interpolation)
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

        description = Description(
            schema_version=1,
            flight=flight.name,
            clock_reference=flight.reference_camera,
            pose_interpolation=interpolation,
            cameras=entries,
            truth=truth,
            sources=sources,
            warnings=warnings,
        )
        write_json(run.folder / "session.json", description.model_dump(mode="json", by_alias=True))
        record = run.publish(counts=_counts(entries), warnings=warnings)
    return Ingested(target, record, description, skipped=False)


def _stored_description(folder: Path) -> Description:
    return Description.model_validate(read_json(folder / "session.json"))


def _refuse_unread_parts(flight: Flight, path: Path) -> None:
    """Refuse, in one line, what is valid in a manifest but has no reader in this version."""
    unread = [
        part
        for part, stated in (("actor", flight.actor), ("actors", flight.actors), ("map", flight.map))
        if stated
    ]
    unread += ["plan"] if flight.plan else []
    for name, camera in flight.cameras.items():
        place = f"cameras.{name}"
        if camera.video:
            unread.append(f"{place}.video")
        if camera.gimbal:
            unread.append(f"{place}.gimbal")
        if camera.pose.of == "body" or camera.mount:
            unread.append(f"{place}.mount")
        unread += [f"{place}.pose.{key}" for key in ("log", "dji", "ulog") if getattr(camera.pose, key)]
        unread += [f"{place}.intrinsics.log"] if camera.intrinsics.log else []
        if camera.frame_times:
            unread += [
                f"{place}.frame_times.{key}"
                for key in ("csv", "log", "srt")
                if getattr(camera.frame_times, key)
            ]
    if unread:
        raise NotYetReadError(
            path,
            f"{', '.join(unread)}: this version has no reader for {'it' if len(unread) == 1 else 'them'} yet",
            "leave it out, or give the same data as TUM, CSV, a calibration file or keypoint files",
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


def _hash_sources(flight: Flight, base: Path) -> dict[str, str]:
    """The sha256 of every file that is read, by the path that the manifest states."""
    stated: list[str] = []
    for camera in flight.cameras.values():
        pose = camera.pose
        stated += [path for path in (pose.tum, pose.csv, pose.static and pose.static.path) if path]
        stated += [camera.intrinsics.path] if camera.intrinsics.path else []
        stated += [camera.keypoints.path] if camera.keypoints else []
    if flight.truth:
        stated += [flight.truth.joints.path] if flight.truth.joints else []
        stated += flight.truth.poses.values()
    return {path: sha256_of(base / path) for path in dict.fromkeys(stated)}


def _counts(entries: Mapping[str, CameraEntry]) -> dict[str, object]:
    return {
        "cameras": len(entries),
        "frames": sum(entry.frames.count for entry in entries.values()),
        "frames_without_pose": sum(entry.poses.frames_without_pose for entry in entries.values()),
        "detections": sum(entry.keypoints.detections for entry in entries.values() if entry.keypoints),
    }


def _check_overlap(flight_path: Path, entries: Mapping[str, CameraEntry]) -> None:
    """Refuse a camera whose frames share no moment with those of any other."""
    for name, entry in entries.items():
        others = [other.frames for key, other in entries.items() if key != name]
        first, last = entry.frames.first_t_ns, entry.frames.last_t_ns
        if others and not any(first <= o.last_t_ns and o.first_t_ns <= last for o in others):
            raise DataError(
                flight_path,
                f"cameras.{name}: its frames ({_span(first, last)}) overlap in time with no other camera's"
                f" ({_span(min(o.first_t_ns for o in others), max(o.last_t_ns for o in others))})",
                "check frame_times.start_ns and clock.offset_s",
            )


class _Reader:
    """Reads the parts of one flight; what it doubts is collected camera by camera."""

    def __init__(self, flight: Flight, flight_path: Path, interpolation: Interpolation) -> None:
        self._flight = flight
        self._flight_path = flight_path
        self._base = flight_path.parent
        self._interpolation = interpolation
        self._calibrations: dict[str, dict[str, CalibratedCamera]] = {}

    def store_camera(self, name: str, folder: Path) -> None:
        """Write the tables of one camera and what is to be said of them."""
        camera = self._flight.cameras[name]
        source = camera.keypoints
        if source is None:
            raise NotYetReadError(self._flight_path, f"cameras.{name} has no keypoints", "give their file")
        warnings: list[str] = []
        detections, detector_format = self._read_keypoints(source)
        intrinsics = self._read_intrinsics(name, camera, detections, warnings)
        frames_t_ns = self._frame_times(name, camera, source, detections)
        trajectory = self._read_trajectory(name, camera, frames_t_ns)
        without_pose = self._frames_without_pose(name, trajectory, camera, frames_t_ns, warnings)
        if camera.pose_noise:
            noise_models(f"{self._flight_path}: cameras.{name}.pose_noise", camera.pose_noise)
        warnings += _loss_warnings(name, "poses", trajectory.dropped)
        warnings += _loss_warnings(name, "keypoints", detections.dropped)

        tables = folder / "tables"
        tables.mkdir()
        write_table(tables / "frames.parquet", frames_table(frames_t_ns), FRAMES)
        write_table(
            tables / "poses.parquet",
            pose_table(trajectory),
            POSES if trajectory.covariance is None else POSES_WITH_COVARIANCE,
        )
        write_table(tables / "keypoints.parquet", keypoints_table(detections, frames_t_ns), KEYPOINTS)
        clock = camera.clock
        entry = CameraEntry(
            intrinsics=IntrinsicsEntry.of(intrinsics),
            frames=FramesEntry(
                count=len(frames_t_ns),
                first_t_ns=int(frames_t_ns[0]),
                last_t_ns=int(frames_t_ns[-1]),
                rate_hz=_rate(frames_t_ns),
            ),
            poses=PosesEntry(
                source=_pose_path(camera),
                static=camera.pose.static is not None,
                count=len(trajectory.t_ns),
                rate_hz=_rate(trajectory.t_ns),
                gaps_ns=[] if camera.pose.static else gaps(trajectory.t_ns, self._max_gap_ns),
                frames_without_pose=without_pose,
                dropped=trajectory.dropped,
            ),
            keypoints=KeypointsEntry(
                source=source.path,
                format=detector_format,
                joints=list(detections.joints),
                detections=len(detections.frame),
                people_at_once=int(np.unique(detections.frame, return_counts=True)[1].max()),
                frames_without_person=len(frames_t_ns) - len(np.unique(detections.frame)),
                dropped=detections.dropped,
            ),
            clock=ClockEntry(
                offset_s=(clock.offset_ns if clock else 0) / 1e9, sigma_s=clock.sigma_s if clock else 0.0
            ),
            pose_noise=camera.pose_noise,
            media=None,
        )
        write_json(folder / "entry.json", {"entry": entry.model_dump(mode="json"), "warnings": warnings})

    def store_truth(self, folder: Path, entries: Mapping[str, CameraEntry]) -> TruthEntry | None:
        """Write what is known to be true and say what it spans."""
        truth = self._flight.truth
        if truth is None:
            return None
        motion = self._read_truth_joints(truth)
        if motion is not None:
            first = min(entry.frames.first_t_ns for entry in entries.values())
            last = max(entry.frames.last_t_ns for entry in entries.values())
            if motion.t_ns[0] > last or motion.t_ns[-1] < first:
                raise DataError(
                    self._base / truth.joints.path if truth.joints else self._flight_path,
                    f"spans {_span(motion.t_ns[0], motion.t_ns[-1])}, the pictures {_span(first, last)}",
                    "check its time base: stamps are world times",
                )
            write_table(folder / "truth.parquet", motion_table(motion), TRUTH)
        if truth.poses:
            write_table(folder / "truth_poses.parquet", self._truth_poses_table(truth), CAMERA_POSES)
        return TruthEntry(
            joints=list(motion.joints) if motion else [],
            people=motion.position.shape[1] if motion else 0,
            first_t_ns=int(motion.t_ns[0]) if motion else 0,
            last_t_ns=int(motion.t_ns[-1]) if motion else 0,
            cameras=list(truth.poses),
        )

    @property
    def _max_gap_ns(self) -> int:
        return round(self._interpolation.max_gap_s * 1e9)

    @property
    def _max_extrapolation_ns(self) -> int:
        return round(self._interpolation.max_extrapolation_s * 1e9)

    def _read_keypoints(self, source: KeypointSource) -> tuple[Detections, str]:
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

    def _read_intrinsics(
        self, name: str, camera: Camera, detections: Detections, warnings: list[str]
    ) -> Intrinsics:
        source = camera.intrinsics
        place = f"{self._flight_path}: cameras.{name}.intrinsics"
        if source.path:
            calibrated = self._calibrated(name, source.path, source.camera)
            if calibrated.intrinsics is None:
                raise DataError(
                    self._base / source.path, "holds poses but no intrinsics", "name another file"
                )
            intrinsics = calibrated.intrinsics
        else:
            intrinsics = _inline_intrinsics(source, place)
        if detections.image_size:
            try:
                intrinsics, note = fit_to_size(intrinsics, *detections.image_size)
            except ValueError as error:
                raise DataError(
                    place, str(error), "give the calibration that belongs to these pictures"
                ) from None
            if note:
                warnings.append(f"{name}: {note}")
        _refuse_keypoints_outside(place, intrinsics, detections)
        return intrinsics

    def _calibrated(self, name: str, path: str, camera: str | None) -> CalibratedCamera:
        """The camera of a calibration file that is asked for, bears this name, or is the only one."""
        if path not in self._calibrations:
            file = self._base / path
            reader = recognise(file, CalibrationFormat, "calibration")
            self._calibrations[path] = reader.read_calibration(file)
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

    def _frame_times(
        self, name: str, camera: Camera, source: KeypointSource, detections: Detections
    ) -> np.ndarray:
        times = camera.frame_times
        if times is None or times.fps is None:
            raise DataError(
                self._flight_path,
                f"cameras.{name}.frame_times: without a video it needs fps",
                "write frame_times: {start: SECONDS, fps: 30}",
            )
        count = int(detections.frames_listed[-1]) + 1
        if count > _MOST_FRAMES:
            raise DataError(
                self._base / source.path,
                f"numbers its frames up to {count - 1}",
                "say with first_frame which number the first frame bears",
            )
        offset_ns = camera.clock.offset_ns if camera.clock else 0
        return times.start_ns + offset_ns + _ticks_ns(count, times.fps)

    def _read_trajectory(self, name: str, camera: Camera, frames_t_ns: np.ndarray) -> Trajectory:
        path = self._base / _pose_path(camera)
        axes: Axes = camera.pose.axes or self._flight.world.frame
        if camera.pose.static:
            calibrated = self._calibrated(name, camera.pose.static.path, camera.pose.static.camera)
            if calibrated.position is None or calibrated.quaternion_xyzw is None:
                raise DataError(path, "holds intrinsics but no camera pose", "name a file with extrinsics")
            still = Trajectory(
                t_ns=frames_t_ns[:1],
                position=calibrated.position[None],
                quaternion_xyzw=calibrated.quaternion_xyzw[None],
            )
            return _in_enu(still, axes)
        kind = "tum" if camera.pose.tum else "csv"
        reader = FORMATS.get(kind)
        if not isinstance(reader, TrajectoryFormat):
            raise DataError(path, f"the format {kind} reads no trajectories")
        trajectory = reader.read_trajectory(path)
        if not len(trajectory.t_ns):
            raise DataError(path, f"holds no usable pose ({_losses(trajectory.dropped)})", "mend the log")
        return _in_enu(trajectory, axes)

    def _frames_without_pose(
        self,
        name: str,
        trajectory: Trajectory,
        camera: Camera,
        frames_t_ns: np.ndarray,
        warnings: list[str],
    ) -> int:
        if camera.pose.static:
            return 0
        position, _ = interpolate_poses(
            trajectory.t_ns,
            trajectory.position,
            trajectory.quaternion_xyzw,
            frames_t_ns,
            max_gap_ns=self._max_gap_ns,
            max_extrapolation_ns=self._max_extrapolation_ns,
        )
        without = int(np.isnan(position[:, 0]).sum())
        if without == len(frames_t_ns):
            raise DataError(
                self._base / _pose_path(camera),
                f"has a pose for none of the {without} frames of camera {name}: frames span"
                f" {_span(frames_t_ns[0], frames_t_ns[-1])}, poses {_span(*trajectory.t_ns[[0, -1]])}"
                f" at {_rate(trajectory.t_ns) or 0:.3g} Hz",
                "check clocks and units, or raise --max-pose-gap",
            )
        if without:
            warnings.append(
                f"{name}: {without} of {len(frames_t_ns)} frames have no pose (no logged pose within"
                f" {self._interpolation.max_gap_s:g} s gaps and {self._interpolation.max_extrapolation_s:g} s"
                " at the ends)"
            )
        return without

    def _read_truth_joints(self, truth: Truth) -> JointMotion | None:
        source = truth.joints
        if source is None:
            return None
        path = self._base / source.path
        axes = source.axes or ("ned" if self._flight.world.frame == "ned" else None)
        reader: object = (
            FORMATS.get(source.format) if source.format else recognise(path, JointFormat, "truth")
        )
        if not isinstance(reader, JointFormat):
            raise DataError(path, f"{source.format} holds no joints", "leave `format:` out")
        motion = reader.read_joints(path, unit=source.unit, axes="z-up" if axes == "ned" else axes)
        if axes == "ned":
            motion = replace(motion, position=motion.position[..., [1, 0, 2]] * [1, 1, -1])
        return motion

    def _truth_poses_table(self, truth: Truth) -> pd.DataFrame:
        import pandas as pd

        tables = []
        for name, stated in truth.poses.items():
            path = self._base / stated
            trajectory = recognise(path, TrajectoryFormat, "camera trajectory").read_trajectory(path)
            table = pose_table(_in_enu(trajectory, self._flight.world.frame))
            tables.append(table.assign(camera=name))
        return pd.concat(tables, ignore_index=True)


def detections_path(camera: Camera) -> str:
    """The path of a camera's keypoints as the manifest states it."""
    return camera.keypoints.path if camera.keypoints else ""


def _pose_path(camera: Camera) -> str:
    pose = camera.pose
    return pose.tum or pose.csv or (pose.static.path if pose.static else "")


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
            readout_s=source.readout_s,
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
    if axes == "enu":
        return trajectory
    position, quaternion = enu_from_ned(trajectory.position, trajectory.quaternion_xyzw)
    covariance = trajectory.covariance
    if covariance is not None:
        swap = np.eye(6)
        swap[:3, :3] = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]  # the rotation part stays in the camera
        covariance = swap @ covariance @ swap.T
    return replace(trajectory, position=position, quaternion_xyzw=quaternion, covariance=covariance)


def _ticks_ns(count: int, fps: Fraction) -> np.ndarray:
    """Exact times of `count` frames from 0, each rounded to a ns; Python's integers cannot overflow here."""
    period = Fraction(1_000_000_000) / fps
    return np.array([round(k * period) for k in range(count)], dtype=np.int64)


def _rate(t_ns: np.ndarray) -> float | None:
    return 1e9 * (len(t_ns) - 1) / float(t_ns[-1] - t_ns[0]) if len(t_ns) > 1 else None


def _span(first_ns: int, last_ns: int) -> str:
    return f"{first_ns / 1e9:.3f} to {last_ns / 1e9:.3f} s"


def _losses(dropped: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {cause}" for cause, count in dropped.items()) or "it is empty"


def _loss_warnings(name: str, what: str, dropped: Mapping[str, int]) -> Sequence[str]:
    return [f"{name}: {what} dropped: {_losses(dropped)}"] if dropped else []
