"""Stage `ingest`: read everything that `flight.yaml` names once, check it, and store it as one session.

Doubtful data are counted and reported, unusable data refused with the file at fault. Each camera is a chunk
of its own: an interrupted ingest continues with the cameras that it had not finished.
"""

import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipelines.drafting.found import GIMBAL, is_called
from pipelines.formats.common.files import leads_out
from pipelines.formats.logs.messages import kind_of
from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.reconstruction.doubts.logs import doubt_of_unit, doubts_of_logs, doubts_of_places
from pipelines.reconstruction.picture_map import PictureMap
from pipelines.session.camera_poses import noise_models
from pipelines.session.description import (
    ActorEntry,
    CameraEntry,
    Description,
    Doubt,
    Interpolation,
    MapEntry,
    OriginEntry,
    PlannedEntry,
    TruthEntry,
    assumptions_as_warnings,
    read_description,
)
from pipelines.session.errors import DataError
from pipelines.session.manifest import Axes, CameraSources, Manifest, read_flight, shape_file
from pipelines.session.maps import store_map
from pipelines.session.people import joint_called
from pipelines.session.progress import Progress, Silent
from pipelines.session.recognition import recognise
from pipelines.session.records import Detections, JointMotion, Occupancy, Topic, Trajectory, VideoIndex
from pipelines.session.registries import MapFormat
from pipelines.session.stages import Stage, StageRecord, locked, note_sources, usable_record
from pipelines.session.storage import hash_of, read_json, sha256_of, write_json
from pipelines.session.tables import (
    ACTOR,
    BODY,
    BODY_SHAPE,
    CAMERA_POSES,
    PLAN,
    TRUTH,
    actor_table,
    join_tables,
    motion_table,
    pose_table,
    read_parts,
    read_poses,
    read_table,
    write_table,
)
from pipelines.session.urls import as_urls, located, media_path, named
from pipelines.sources.attitudes import (
    MAP_FILES,
    FilmOfCamera,
    TurnedByPictures,
    UnposedCamera,
    posed_by_people,
    turned_by_pictures,
)
from pipelines.sources.attitudes import load_map as load_picture_map
from pipelines.sources.attitudes import store_map as store_picture_map
from pipelines.sources.cameras import FlightCameras
from pipelines.sources.files import FlightFiles, fetch_sources, hash_sources, refuse_written, source_stamps
from pipelines.sources.keypoints import (
    doubt_numbers,
    in_pixels,
    near_picture,
    unmirrored,
    within,
    without_repeats,
    without_zeros,
)
from pipelines.sources.logs import FlightLogs, maps_of_log
from pipelines.sources.parts import (
    CameraData,
    CameraFrames,
    camera_entry,
    refuse_no_overlap,
    span_of_pictures,
    span_words,
    store_camera,
)
from pipelines.sources.pictures import open_files
from pipelines.sources.poses import FlightPoses
from pipelines.sources.world import losses

INGEST = Stage("ingest", revision=22)

OF_ONE_CAMERA = (
    "one camera gives a rough estimate: how far away people are is told by their stature alone; a second"
    " drone across would measure it (mocap reconstruct says how many mm it would gain)"
)


@dataclass(frozen=True)
class Ingested:
    """Result of an ingest."""

    folder: Path
    record: StageRecord
    description: Description
    skipped: bool  # True if nothing had changed


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
    """Read a flight into a session, by default `<name of the manifest>.session` beside it.

    Frames have no pose between two further apart than `max_pose_gap_s`, or further than `max_extrapolation_s`
    before or after all. `strict` refuses a flight of which anything could not be used, or that is doubted;
    `overwrite` writes also to a target that holds something else; `force` reads all anew. DataError:
    something cannot be used, or was changed while it was read; the session stays as it was. BusyError:
    another process writes the session.
    """
    progress = progress or Silent()
    flight = read_flight(flight_path)
    fetch_sources(flight, flight_path.parent, progress)
    _refuse_ways_out(flight, flight_path)
    target = session or flight_path.with_suffix(".session")
    _refuse_other_flight(target, flight, overwrite)
    interpolation = Interpolation(max_gap_s=max_pose_gap_s, max_extrapolation_s=max_extrapolation_s)
    settings = {
        "flight": flight.model_dump(mode="json"),
        "cameras": list(flight.cameras),  # their order breaks ties
        "pose_interpolation": interpolation.model_dump(),
        "flight_from_session": media_path(flight_path.parent, "", target),
    }

    with _FlightReader(flight, flight_path, target, interpolation) as reader:
        reader.refuse_unfit()
        stamps = source_stamps(flight, flight_path.parent)
        check_sources = partial(refuse_written, flight, flight_path.parent, stamps)
        sources = hash_sources(flight, flight_path.parent, progress)
        reader.hashes, reader.progress, reader.force = sources, progress, force
        reader.check_sources = check_sources
        with locked(target, create=True, overwrite=overwrite) as writable:
            run = writable.begin(INGEST, settings=settings, inputs=sources, force=force)
            if run.finished:
                note_sources(target, sources, stamps)
                stored_description = read_description(target)
                if strict:
                    _refuse_unsound(flight_path, stored_description)
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
            actors = reader.store_actors(run.folder, entries)
            map_ = reader.store_map(run.folder, entries)
            plan = reader.store_plan(run.folder, entries)
            origin = reader.origin()
            unused = reader.unused_gimbals()
            check_sources()
            warnings += reader.take_notes()
            warnings += assumptions_as_warnings(flight.assumptions)
            if len(entries) == 1:
                warnings.append(OF_ONE_CAMERA)

            tables = {name: run.folder / "cameras" / name / "poses.parquet" for name in entries}
            tracks = {name: read_poses(path) for name, path in tables.items()}
            units = {name: camera.pose.unit for name, camera in flight.cameras.items()}
            if of_unit := doubt_of_unit(tracks, units):
                doubts = [of_unit]  # every other place follows from it
            else:
                doubts = doubts_of_logs({name: (entry, tracks[name]) for name, entry in entries.items()})
                doubts += doubts_of_places(tracks, reader.map_box)
            doubts += reader.poses.map_doubts + unused
            warnings += [doubt.as_warning() for doubt in doubts]

            description = Description(
                schema_version=1,
                flight=flight.name,
                simulated=flight.simulated,
                clock_reference=flight.reference_camera,
                pose_interpolation=interpolation,
                origin=origin,
                cameras=entries,
                actor=actors[0] if actors else None,
                actors=actors if flight.actors else [],
                stature_m=flight.stature_m,
                map=map_,
                truth=truth,
                plan=plan,
                sources=sources,
                assumptions=flight.assumptions,
                doubts=doubts,
                warnings=warnings,
            )
            if strict:
                _refuse_unsound(flight_path, description)
            write_json(run.folder / "session.json", description.model_dump(mode="json", by_alias=True))
            record = run.publish(counts=_counts(entries), warnings=warnings)
            note_sources(target, sources, stamps)
    return Ingested(target, record, description, skipped=False)


class _FlightReader(AbstractContextManager["_FlightReader"]):
    """Reader that stores the parts of one flight, collects doubts as notes, and closes its logs."""

    def __init__(
        self, flight: Manifest, flight_path: Path, session: Path, interpolation: Interpolation
    ) -> None:
        base, gap_ns, note = flight_path.parent, interpolation.max_gap_ns, self._take_note
        self._flight = flight
        self._flight_path = flight_path
        self._session = session
        self._interpolation = interpolation
        self._notes: list[str] = []
        self._logs = FlightLogs(flight, base, note)
        self._files = FlightFiles(flight, flight_path)
        self.poses = FlightPoses(flight, flight_path, self._logs, self._files, max_gap_ns=gap_ns, note=note)
        self._cameras = FlightCameras(flight_path, self._logs, self._files, self.poses.triggers, note)
        self.hashes: Mapping[str, str] = {}  # SHA-256 of the sources by their names in the manifest
        self.progress: Progress = Silent()
        # Raises an error if they were changed meanwhile.
        self.check_sources: Callable[[], None] = lambda: None
        self.force = False  # maps of pictures of an earlier ingest are not used
        self.map_box: tuple[Float, Float] | None = None  # of the first map, once it is stored

    def __exit__(self, *exception: object) -> None:
        self._logs.__exit__(*exception)

    def refuse_unfit(self) -> None:
        """Refuse files, options and mounts that do not belong where they stand."""
        self._files.refuse_other_options()
        self.poses.refuse_unfit()

    def _take_note(self, line: str) -> None:
        self._notes.append(as_urls(line))

    def take_notes(self) -> list[str]:
        """Return the notes since the last call, each once."""
        taken = list(dict.fromkeys(self._notes))
        self._notes.clear()
        return taken

    def store_camera(self, name: str, folder: Path) -> None:
        """Write the tables of one camera, its entry and its warnings."""
        camera = self._flight.cameras[name]
        (folder / "tables").mkdir()
        data = self._read_camera(name, folder / "tables")
        store_camera(data, folder / "tables")
        entry = camera_entry(
            name, camera, data, self._interpolation, self._flight_path.parent, self._take_note
        )
        warnings = list(dict.fromkeys(data.notes + self.take_notes()))
        write_json(folder / "entry.json", {"entry": entry.model_dump(mode="json"), "warnings": warnings})
        self.check_sources()

    def _gimbal_axes(self, camera: CameraSources) -> Axes:
        gimbal = camera.gimbal
        if gimbal is None:
            return self._flight.world.frame
        if gimbal.is_fixed:
            return "ned"
        return gimbal.axes or self._logs.settings(gimbal.file).axes or self._flight.world.frame

    def _read_camera(self, name: str, folder: Path) -> CameraData:
        """Read all about one camera, and check the parts; a map of its pictures goes to the folder."""
        camera, video, detections, detector_format, intrinsics, frames = self._filmed(name)
        pose_noise, turned = camera.pose_noise, None
        if pose_noise:
            noise_models(f"{self._flight_path}: cameras.{name}.pose_noise", pose_noise)
        if not camera.pose.file:
            turned = self._posed_by_people[name]
        else:
            trajectory = self.poses.trajectory(name, camera, frames)
            if camera.pose.by_pictures:
                turned = self._turned_by_pictures(name, camera, frames, intrinsics, trajectory)
        picture_map = None
        if turned is not None:
            trajectory, intrinsics, pose_noise = turned.trajectory, turned.intrinsics, turned.pose_noise
            picture_map = turned.entry
            store_picture_map(turned.map, folder)
        if detections is not None:
            numbers = doubt_numbers(detections, frames, from_video=video is not None)
            if camera.keypoints and "first_frame" not in camera.keypoints.model_fields_set and numbers:
                self._take_note(f"{name}: {numbers}")
            detections = within(detections, frames)
            if not len(detections.frame):
                problem = f"cameras.{name}: no frame of its keypoints is one of its pictures"
                remedy = "check first_frame and frame_times"
                raise DataError(self._flight_path, problem, remedy, code="no-overlap")
            detections, repeats = without_repeats(detections, frames)
            for repeat in repeats:
                self._take_note(f"{name} {repeat}: they are left out")
        pose, logged = camera.pose, self._files.is_log("pose", camera.pose)
        axes = pose.axes or self._logs.settings(pose.file).axes or self._flight.world.frame
        return CameraData(
            detections,
            detector_format,
            intrinsics,
            frames,
            trajectory,
            media=self._cameras.media(camera, frames, self._session),
            log_clock=self.poses.log_clock(camera),
            still=self.poses.is_still(camera),
            notes=self.take_notes(),
            pose_noise=pose_noise,
            stamps=self._logs.settings(pose.file).stamps if logged else None,
            axes=(axes, self._gimbal_axes(camera)),
            picture_map=picture_map,
        )

    def _filmed(
        self, name: str
    ) -> tuple[CameraSources, VideoIndex | None, Detections | None, str, Intrinsics, CameraFrames]:
        """Read a camera's pictures, keypoints (and their format), lens and times."""
        camera = self._flight.cameras[name]
        video = self._files.video(camera)
        detections, detector_format = None, ""
        if camera.keypoints:
            detections, detector_format = self._files.keypoints(camera.keypoints)
        intrinsics = self._cameras.intrinsics(name, camera, video, detections)
        if detections is not None:
            if camera.keypoints:
                detections = without_zeros(detections)
                detections = in_pixels(detections, intrinsics, camera.keypoints.file)
                detections = unmirrored(detections, camera.keypoints.mirrored, intrinsics)
            detections = near_picture(detections, intrinsics)
        frames = self._cameras.frames(name, camera, video, detections)
        return camera, video, detections, detector_format, intrinsics, frames

    @cached_property
    def _posed_by_people(self) -> dict[str, TurnedByPictures]:
        """Poses of all cameras by their films alone, where no log has any."""
        noted, films = len(self._notes), {}
        for name in self._flight.cameras:
            camera, _, detections, _, intrinsics, frames = self._filmed(name)
            films[name] = UnposedCamera(
                self._film(camera, frames),
                frames,
                intrinsics,
                detections,
                camera.intrinsics.assumed,
                partial(self._kept_map, name),
            )
        del self._notes[noted:]  # each camera is read again, and noted then
        return posed_by_people(
            f"{self._flight_path}: cameras", films, self._flight.stature_m, self._take_note, self.progress
        )

    def _film(self, camera: CameraSources, frames: CameraFrames) -> FilmOfCamera:
        """Return the pictures from which a camera is mapped."""
        video = camera.video
        if video is None:
            raise AssertionError("the manifest refuses it")
        paths = self._flight.paths_of(video.file)
        files = [located(self._flight_path.parent, path) for path in paths]
        stamps = self._logs.settings(video.file).stamps if frames.topic else "header"
        return FilmOfCamera(
            hash_of([[self.hashes[path] for path in paths], frames.topic, stamps]),
            partial(open_files, files, frames.topic, stamps),
        )

    def _kept_map(self, name: str, key: str) -> PictureMap | None:
        """Return a camera's map of an earlier ingest, if it is that of this key."""
        before = usable_record(self._session / INGEST.name / "stage.json")
        if self.force or before is None:
            return None
        for stored in (f"cameras/{name}/{file}" for file in MAP_FILES):
            path = self._session / stored
            if not path.is_file() or before.outputs.get(stored) != sha256_of(path):
                return None
        entry = read_description(self._session).cameras[name].picture_map
        if entry is None or entry.key != key:
            return None
        return load_picture_map(self._session / "cameras" / name, entry)

    def _turned_by_pictures(
        self,
        name: str,
        camera: CameraSources,
        frames: CameraFrames,
        intrinsics: Intrinsics,
        places: Trajectory,
    ) -> TurnedByPictures:
        """Find the attitudes of a camera by its film, from the map of an earlier ingest if it has one."""
        return turned_by_pictures(
            f"{self._flight_path}: cameras.{name}",
            name,
            self._film(camera, frames),
            frames,
            intrinsics,
            places,
            refine_focal=camera.intrinsics.assumed,
            pose_noise=camera.pose_noise,
            satellite_sigma_m=self.poses.satellite_sigma_m(camera),
            kept=partial(self._kept_map, name),
            note=self._take_note,
            progress=self.progress,
        )

    def origin(self) -> OriginEntry | None:
        """Return the world's origin on Earth, if known; note cameras with different height references."""
        self.poses.doubt_heights()
        return self.poses.origin()

    def store_truth(self, folder: Path, entries: Mapping[str, CameraEntry]) -> TruthEntry | None:
        """Write the ground truth, and return its entry with its joints, cameras and time span."""
        truth = self._flight.truth
        if truth is None:
            return None
        base = self._flight_path.parent
        motion = self._files.true_joints(truth) if truth.file else None
        if motion is not None and truth.file:
            place = located(base, truth.file)
            own_axes = truth.axes is not None or truth.up is not None
            position = self.poses.joints(place, motion.position, own_axes=own_axes)
            motion = replace(motion, position=position)
            refuse_no_overlap(named(base, truth.file), motion.t_ns, entries)
            write_table(folder / "truth.parquet", motion_table(motion), TRUTH)
        missing, dropped = self._note_truth_missing(motion) if motion else (0, {})
        poses_dropped = {}
        if truth.poses:
            tables = []
            for name, stated in truth.poses.items():
                poses = self.poses.true_poses(stated)
                tables.append(pose_table(poses).assign(camera=name))
                if poses.dropped:
                    poses_dropped[name] = poses.dropped
                    self._notes.append(f"{name}: true poses dropped: {losses(poses.dropped)}")
            write_table(folder / "truth_poses.parquet", pd.concat(tables, ignore_index=True), CAMERA_POSES)
        if truth.body:
            self._store_true_bodies(folder, truth.body)
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

    def _store_true_bodies(self, folder: Path, stated: str) -> None:
        place = located(self._flight_path.parent, stated)

        def moved(part: pd.DataFrame) -> pd.DataFrame:
            centre = part[["x", "y", "z"]].to_numpy(np.float64)
            part[["x", "y", "z"]] = self.poses.joints(place, centre, own_axes=False)
            return part

        parts = (moved(part) for part in read_parts(place, BODY) if len(part))
        join_tables(folder / "truth_body.parquet", parts, BODY)
        shape = located(self._flight_path.parent, shape_file(stated))
        write_table(folder / "truth_body_shape.parquet", read_table(shape, BODY_SHAPE), BODY_SHAPE)

    def _note_truth_missing(self, motion: JointMotion) -> tuple[int, dict[str, int]]:
        """Count the true positions that are missing, and those of them that were dropped; note both."""
        is_missing = np.isnan(motion.position[..., 0])
        missing = int(is_missing.sum())
        if motion.dropped:
            self._notes.append(f"truth: positions dropped: {losses(motion.dropped)}")
        if missing > sum(motion.dropped.values()):
            self._notes.append(f"truth: {missing} of {is_missing.size} positions of joints are missing")
        if not any(map(joint_called, motion.joints)):
            named = ", ".join(motion.joints[:5])
            self._notes.append(f"truth: no name of its joints is known ({named}): no error is measured")
        elif not {"hip"} & set(motion.joints) and not {"left_hip", "right_hip"} <= set(motion.joints):
            self._notes.append(
                "truth: has no hip, nor left_hip and right_hip: errors relative to the root are not measured"
            )
        return missing, motion.dropped

    def store_actors(self, folder: Path, entries: Mapping[str, CameraEntry]) -> list[ActorEntry]:
        """Write the logged positions of people."""
        found, tracks = [], []
        for name, actor in self._flight.logged_people.items():
            trajectory = self.poses.actor(name, actor)
            refuse_no_overlap(named(self._flight_path.parent, actor.file), trajectory.t_ns, entries)
            if trajectory.dropped:
                self._notes.append(f"{name or 'actor'}: dropped: {losses(trajectory.dropped)}")
            tracks.append(trajectory)
            found.append(
                ActorEntry(
                    name=name,
                    source=actor.file,
                    sources=self._logs.settings(actor.file).file,
                    topic=actor.topic,
                    point=actor.point,
                    weight=actor.weight,
                    count=len(trajectory.t_ns),
                    dropped=trajectory.dropped,
                )
            )
        if tracks:
            write_table(folder / "actor.parquet", actor_table(tracks), ACTOR)
        return found

    def store_map(self, folder: Path, entries: Mapping[str, CameraEntry]) -> MapEntry | None:
        """Write the map of obstacles: one from a file, or those of a log that replaced each other."""
        stated = self._flight.map
        if stated is None:
            return None
        if self._files.is_log("map", stated):
            logged = maps_of_log(
                self._flight,
                stated,
                self._logs,
                max_gap_ns=self._interpolation.max_gap_ns,
                note=self._take_note,
            )
            self._refuse_later_map(stated.file, int(logged.from_ns[0]), entries)
            log = self._logs.paths(stated.file)[0]
            held, dropped = store_map(folder, self._near_origin(log, logged.maps)), logged.dropped
        else:
            path, file = stated.file, self._files.path(stated.file)
            reader = recognise(file, MapFormat, "map", name=stated.format)
            occupancy = reader.read_map(file, resolution_m=stated.resolution_m)
            held, dropped = store_map(folder, self._near_origin(file, [occupancy])), occupancy.dropped
            if occupancy.crs and not (stated.crs or self.poses.origin()):
                named = " ".join(occupancy.crs.split())[:60]
                self._notes.append(f"{path}: its coordinates, of {named}, are taken to be the world's")
            if self._flight.world.frame == "ned":
                self._notes.append(f"{path}: the map is taken to be in ENU axes although the world is NED")
        if dropped:
            self._notes.append(f"map: dropped: {losses(dropped)}")
        return MapEntry(
            source=stated.file,
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
        if not plan:
            return None
        tables, found = [], {}
        for name in (camera for camera in self._flight.cameras if camera in plan):
            stated = plan[name].file
            sent = self.poses.planned(plan[name])
            refuse_no_overlap(named(self._flight_path.parent, stated), sent.t_ns, entries)
            if sent.dropped:
                self._notes.append(f"{name}: commands dropped: {losses(sent.dropped)}")
            tables.append(pose_table(sent).assign(camera=name))
            found[name] = PlannedEntry(source=stated, count=len(sent.t_ns), dropped=sent.dropped)
        write_table(folder / "plan.parquet", pd.concat(tables, ignore_index=True), PLAN)
        return found

    def _refuse_later_map(self, log: str, from_ns: int, entries: Mapping[str, CameraEntry]) -> None:
        first, last = span_of_pictures(entries)
        if from_ns > last:
            problem = (
                f"has its first map at {from_ns / 1e9:.3f} s, after the pictures ({span_words(first, last)})"
            )
            remedy = "check its clock, or take `stamps: receive`"
            raise DataError(f"{self._flight_path}: map.file {log}", problem, remedy, code="no-overlap")

    def unused_gimbals(self) -> list[Doubt]:
        """Doubt cameras that are fixed to a body where their log holds angles of a gimbal that nobody names.

        Of other logs, where the gimbal may be of another flight or held still, there is a note.
        """

        def path(log: str) -> str:
            return self._flight.paths_of(log)[0]

        cameras = self._flight.cameras
        fixed = [name for name, camera in cameras.items() if camera.mount is not None and not camera.gimbal]
        gimbals = [camera.gimbal for camera in cameras.values() if camera.gimbal and camera.gimbal.file]
        used = {(path(gimbal.file), gimbal.topic) for gimbal in gimbals}
        found: dict[str, tuple[str, Topic]] = {}
        for log in self._files.logs() if fixed else ():
            with self._logs.open(log) as opened:
                topics = [topic for topic in opened.recording.topics if _is_of_gimbal(topic)]
            free = [each for each in topics if not used & {(path(log), each.name), (path(log), None)}]
            for name in fixed:
                is_own = path(cameras[name].pose.file) == path(log)
                its = [topic for topic in free if name in topic.name]
                its = its or (free if len(free) == 1 and (is_own or name in log) else [])
                if its and is_own:
                    found[name] = (log, max(its, key=lambda topic: kind_of(topic) == "angles"))
                elif its:
                    unsaid = f"{log} holds angles of a gimbal that nothing uses: {its[0].name}"
                    self._notes.append(f"{name}: {unsaid}; if they turn it, say `gimbal`")
        if not found:
            return []
        names = ", ".join(topic.name for _, topic in found.values())
        unread = sorted({topic.type for _, topic in found.values() if kind_of(topic) != "angles"})
        hint = f" ({', '.join(unread)} is not read: write it as QuaternionStamped)" if unread else ""
        lines = (
            f"cameras.{name}.gimbal: {{file: {log}, topic: {topic.name}, relative_to: world}}"
            for name, (log, topic) in found.items()
        )
        what = f"logs hold the angles of a gimbal that nothing uses: {names}{hint}"
        remedy = "" if unread else "; ".join(lines)
        return [Doubt(code="unused", cameras=list(found), what=what, evidence={}, remedy=remedy)]

    def _near_origin(self, source: Path, maps: Iterable[Occupancy]) -> Iterator[Occupancy]:
        """Yield maps in the world; errors as in `FlightPoses.map`."""
        stated = self._flight.map
        for occupancy in maps:
            placed = self.poses.map(source, occupancy, stated.crs if stated else None)
            high = placed.origin + np.array(placed.probability.shape) * placed.resolution_m
            self.map_box = self.map_box or (placed.origin, high)
            yield placed


# Types of messages with angles, or their topics, are called so. Gimbals also have states and switches.
_ANGLES = re.compile(r"Mount|Joint|Vector3|(?i:angle|attitude|orientation)")


def _is_of_gimbal(topic: Topic) -> bool:
    """Test by its name if a topic holds the angles of a gimbal, of a type that is read or not."""
    if kind_of(topic) is None:
        named = _ANGLES.search(f"{topic.name} {topic.type}")
        return named is not None and is_called(topic.name, frozenset({"gimbal", "ptz"}))
    return kind_of(topic) == "angles" and is_called(topic.name, GIMBAL)


def _refuse_unsound(flight_path: Path, description: Description) -> None:
    """Refuse a flight of which anything was dropped, in one line by part and cause, or that is doubted."""
    lost = list(_losses_in(description.model_dump(), ""))
    if lost:
        problem = f"is not whole, and --strict was given ({'; '.join(lost)})"
        remedy = "copy what is damaged again, or ingest without --strict"
        raise DataError(flight_path, problem, remedy, code="losses")
    for doubt in description.doubts:
        raise DataError(flight_path, f"is doubted: {doubt.what} ({doubt.code})", doubt.remedy, code="doubted")


def _losses_in(part: Mapping[str, Any], place: str) -> Iterator[str]:
    """Yield each part of a description of which something was dropped, with the causes."""
    for key, value in part.items():
        if key == "dropped" and value:
            yield f"{place}: {losses(value)}"
        elif key == "poses_dropped":
            yield from (f"{name}: true poses: {losses(dropped)}" for name, dropped in value.items())
        elif isinstance(value, dict) and not (key == "actor" and part["actors"]):
            yield from _losses_in(value, f"{place}.{key}" if place else key)
        elif key == "actors":
            for actor in value:
                yield from _losses_in(actor, actor["name"] or "actor")


def _refuse_ways_out(flight: Manifest, path: Path) -> None:
    """Refuse relative paths out of the manifest's folder: a flight that was sent reads its own files."""
    ways_out = [stated for stated in flight.files if leads_out(stated)]
    if ways_out:
        problem = f"leads out of its folder ({', '.join(ways_out)})"
        remedy = "write such paths in full, from the root on, or put the files beside the manifest"
        raise DataError(path, problem, remedy, code="outside-folder")


def _refuse_other_flight(target: Path, flight: Manifest, overwrite: bool) -> None:
    existing = target / "session.json"
    if overwrite or not existing.is_file():
        return
    try:
        held = read_json(existing).get("flight", flight.name)
    except DataError:
        return  # a damaged session is written again
    if held != flight.name:
        problem = f"holds the flight {held!r}, not {flight.name!r}"
        remedy = "choose another place with --output, or replace it with --overwrite"
        raise DataError(target, problem, remedy, code="exists")


def _counts(entries: Mapping[str, CameraEntry]) -> dict[str, object]:
    return {
        "cameras": len(entries),
        "frames": sum(entry.frames.count for entry in entries.values()),
        "frames_without_pose": sum(entry.poses.frames_without_pose for entry in entries.values()),
        "detections": sum(entry.keypoints.detections for entry in entries.values() if entry.keypoints),
    }


def _check_overlap(flight_path: Path, entries: Mapping[str, CameraEntry]) -> None:
    """Refuse cameras whose frames overlap in time with no others, not even through a third camera."""
    ordered = sorted(entries, key=lambda name: entries[name].frames.first_t_ns)
    reached_ns = entries[ordered[0]].frames.last_t_ns
    for place, name in enumerate(ordered):
        frames = entries[name].frames
        if frames.first_t_ns > reached_ns:
            # The smaller side is the odd one out.
            late = 2 * place >= len(ordered)
            odd, rest = (ordered[place:], ordered[:place]) if late else (ordered[:place], ordered[place:])
            problem = (
                f"cameras.{', '.join(odd)}: frames ({_span_of(odd, entries)}) overlap in time with no other"
                f" camera's ({_span_of(rest, entries)})"
            )
            remedy = "check frame_times.start and clock.offset_s"
            raise DataError(flight_path, problem, remedy, code="no-overlap")
        reached_ns = max(reached_ns, frames.last_t_ns)


def _span_of(names: Sequence[str], entries: Mapping[str, CameraEntry]) -> str:
    frames = [entries[name].frames for name in names]
    return span_words(min(f.first_t_ns for f in frames), max(f.last_t_ns for f in frames))
