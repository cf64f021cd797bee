"""Stage `export`: a session's skeleton and cameras in the formats of other programs."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from pipelines.formats.common.exporting import thinned
from pipelines.geometry.arrays import Int64, Picture
from pipelines.reporting.content import MeasuredMotion, estimated_clocks, motion_from_skeleton
from pipelines.reporting.overlays import (
    FilmedCamera,
    angles_at,
    read_filmed,
    refined_poses,
    status_at,
    views_of,
)
from pipelines.reporting.pictures import Label, blank_frame, caption_of, draw_frame
from pipelines.session.description import HIP_ABOVE_POINT_M, Description, Doubt, read_description
from pipelines.session.errors import DataError
from pipelines.session.maps import each_map
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import MovingBody, PlannedArm, Recording
from pipelines.session.registries import Export, ExportWithChoices, find_export
from pipelines.session.stages import StageRecord, open_session, session_name
from pipelines.session.storage import (
    as_data_error,
    make_folder,
    read_json,
    refuse_inside_session,
    remove_tree,
    sha256_of,
    sync,
    working_folder,
    write_json,
)
from pipelines.session.tables import (
    ACTOR,
    ANGLES,
    FRAMES,
    GAIT,
    REPLAN,
    SKELETON,
    load_bodies,
    read_motion,
    read_poses,
    read_table,
    trajectory_from,
)
from pipelines.session.urls import is_there
from pipelines.sources.pictures import open_pictures, refuse_changed_pictures

PICTURES_HZ = 2.0
"""Default number of pictures of a camera in a recording per second."""

# So many views are reprojected at once: a few MB, however long the flight.
_FRAMES_AT_ONCE = 300
_RECORD = "export.json"
_WORK = ".writing"
# A reader of export.json refuses a larger number.
_SCHEMA = 1


@dataclass(frozen=True)
class Exported:
    """Result of an export."""

    folder: Path
    written: list[Path]
    unchanged: list[Path]  # files that existed already with the same bytes


def export(
    folder: Path,
    formats: Sequence[str],
    output: Path | None = None,
    *,
    unit: str | None = None,
    axes: str | None = None,
    time: str | None = None,
    pictures_hz: float = PICTURES_HZ,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Exported:
    """Write a session in other formats, and `export.json` with a description of each file and its notes.

    The default `output` is beside the session, with `.export` for `.session`; files of an earlier export that
    are unchanged are replaced, others with `overwrite`. `unit`, `axes` (z-up, y-up) and `time` (zero: the
    first picture; epoch) are for formats that have a choice; `pictures_hz` of each camera, 0 for none.
    DataError: no such format or choice, nothing to export, changed tables or pictures, or a file would be
    overwritten. BusyError: another process exports to the same folder.
    """
    progress = progress or Silent()
    exports = [find_export(name) for name in dict.fromkeys(formats)]
    asked = {"unit": unit, "axes": axes, "time": time}
    chosen = {format_.name: _chosen(format_, asked) for format_ in exports}
    if output is not None:
        refuse_inside_session(output, "--output")
    recording = load_recording(folder, pictures_hz=pictures_hz)
    target = output or folder.resolve().with_name(f"{session_name(folder)}.export")
    is_new = not target.exists()
    try:
        make_folder(target)
        with _work_in(target) as work:
            made: dict[Path, dict[str, Any]] = {}
            for format_ in exports:
                own = work / format_.name
                own.mkdir()
                notes = _KeptNotes(progress)
                facts: dict[str, Any] = {"unit": "m", "axes": "z-up", **chosen[format_.name]}
                if "time" in facts:
                    facts["zero_ns"] = recording.zero_ns if facts["time"] == "zero" else 0
                wanted = replace(
                    recording,
                    unit=chosen[format_.name].get("unit"),
                    axes=chosen[format_.name].get("axes"),
                    zero_ns=facts.get("zero_ns", 0),
                    progress=notes,
                )
                for path in format_.write(wanted, own):
                    made[path] = {"format": format_.name, **facts, "notes": notes.kept}
            return _move(made, target, overwrite)
    except OSError as error:
        raise as_data_error(error, target) from error
    finally:
        if is_new and target.is_dir() and not any(target.iterdir()):
            target.rmdir()


@dataclass(frozen=True)
class _KeptNotes:
    """Progress that passes everything on and keeps the notes for export.json."""

    whom: Progress
    kept: list[str] = field(default_factory=list)

    def start(self, task: str, total: int) -> None:
        self.whom.start(task, total)

    def advance(self, steps: int = 1) -> None:
        self.whom.advance(steps)

    def note(self, message: str) -> None:
        self.kept.append(message)
        self.whom.note(message)


def _chosen(format_: Export, asked: Mapping[str, str | None]) -> dict[str, str]:
    """Choose unit, axes and time of a format as far as it has a choice: as asked, else its defaults."""
    there = format_.choices if isinstance(format_, ExportWithChoices) else {}
    for what, wanted in asked.items():
        if wanted is not None and wanted not in there.get(what, ()):
            remedy = f"leave --{what} out, or export the others by themselves"
            if what in there:
                remedy = f"there are {', '.join(there[what])}"
            raise DataError(format_.name, f"has no {what} {wanted}", remedy, code="no-such-name")
    return {what: asked[what] or values[0] for what, values in there.items()}


# --- what is exported ----------------------------------------------------------------------------------


def load_recording(folder: Path, *, pictures_hz: float = 0.0) -> Recording:
    """Load skeleton, cameras and maps of a session, with pictures at a rate; DataError if it is damaged."""
    session = open_session(folder)
    description = read_description(folder)
    session.ingested()
    session.intact_record("detect")
    record = session.intact_record("reconstruct")
    table = folder / "reconstruct" / "skeleton.parquet"
    motion = None if record is None else read_motion(table, SKELETON)
    cameras = {name: read_poses(folder / "cameras" / name / "poses.parquet") for name in description.cameras}
    recording = Recording(
        description.flight,
        motion,
        cameras,
        refined={} if record is None else refined_poses(folder, record),
        lenses={name: camera.intrinsics for name, camera in description.cameras.items()},
        maps=lambda: each_map(folder) if description.map else iter(()),
        pictures=_pictures(folder, description, record, pictures_hz),
        angles=lambda: _reconstructed(folder, record, "angles", ANGLES),
        gait=lambda: _reconstructed(folder, record, "gait", GAIT),
        planned=lambda: _planned(folder, session.intact_record("replan")),
        place=description.origin.place if description.origin else None,
        bodies=lambda: _bodies(folder, record),
        doubts=lambda: [doubt.as_warning() for doubt in _doubts(folder, description, record)],
        zero_ns=description.start_ns,
        people=() if motion is None else tuple(description.names_of_people(motion.position.shape[1])),
    )
    if record is None:
        return recording
    drawn = _Overlays(folder, description, record)
    return replace(recording, overlays=partial(drawn.stills, rate_hz=pictures_hz), film=drawn.film)


def _reconstructed(
    folder: Path, record: StageRecord | None, name: str, schema: pa.Schema
) -> pd.DataFrame | None:
    place = f"reconstruct/{name}.parquet"
    return None if record is None or place not in record.outputs else read_table(folder / place, schema)


def _bodies(folder: Path, record: StageRecord | None) -> list[MovingBody]:
    if record is None or "reconstruct/body.parquet" not in record.outputs:
        return []
    place = folder / "reconstruct"
    return load_bodies(place / "body.parquet", place / "body_shape.parquet")


def _doubts(folder: Path, description: Description, record: StageRecord | None) -> list[Doubt]:
    """Return the doubts of the reconstruction, which repeats those of ingest; those alone without one."""
    if record is None:
        return description.doubts
    stored = read_json(folder / "reconstruct" / "metrics.json").get("doubts", [])
    return [Doubt.model_validate(doubt) for doubt in stored]


def _planned(folder: Path, record: StageRecord | None) -> list[PlannedArm]:
    if record is None:
        return []
    actor = read_table(folder / "replan" / "actor.parquet", ACTOR)
    ground_m = float(actor["z"].iloc[0]) - HIP_ABOVE_POINT_M["feet"]
    arms = []
    for name, facts in read_json(folder / "replan" / "metrics.json")["arms"].items():
        if facts["simulated"]:
            table = read_table(folder / "replan" / name / "trajectories.parquet", REPLAN)
            drones = {
                str(drone): trajectory_from(rows) for drone, rows in table.groupby("camera", sort=False)
            }
            counts = {limit: count for limit, count in facts["limit_violations"].items() if count}
            broken = ", ".join(f"{limit} {count} times" for limit, count in counts.items())
            arms.append(PlannedArm(name, drones, ground_m, broken))
    return arms


Stills = Callable[[str], Iterable[tuple[int, Picture]]]


def _pictures(folder: Path, description: Description, record: StageRecord | None, rate_hz: float) -> Stills:
    """Make the function that yields a camera's existing pictures with their world times."""

    def of(camera: str) -> Iterator[tuple[int, Picture]]:
        frames = read_table(folder / "cameras" / camera / "frames.parquet", FRAMES)
        t_ns = frames["t_ns"].to_numpy(np.int64)
        if record is not None:
            clocks = estimated_clocks(read_json(folder / "reconstruct" / "metrics.json"))
            t_ns = t_ns + clocks.get(camera, 0)
        frame = frames["frame"].to_numpy(np.int64)
        for row, picture in _stills(folder, description, camera, frame, thinned(t_ns, rate_hz)):
            yield int(t_ns[row]), picture

    return of


@dataclass(frozen=True)
class _Overlays:
    """Pictures of a session with its skeleton drawn into them."""

    folder: Path
    description: Description
    record: StageRecord  # of the reconstruction

    @cached_property
    def _drawn(self) -> tuple[MeasuredMotion, dict[str, FilmedCamera]]:
        """The motion and the cameras, loaded when the first picture is requested."""
        frames = {
            name: read_table(self.folder / "cameras" / name / "frames.parquet", FRAMES)
            for name, entry in self.description.cameras.items()
            if entry.media is not None
        }
        skeleton = read_table(self.folder / "reconstruct" / "skeleton.parquet", SKELETON)
        filmed = read_filmed(self.folder, self.description, self.record, frames)
        return motion_from_skeleton(skeleton), filmed

    def stills(self, camera: str, rate_hz: float) -> Iterator[tuple[int, Picture]]:
        """Yield the pictures of a camera that can be decoded, at a rate; none at a rate of 0."""
        if not rate_hz or self.description.cameras[camera].media is None:
            return
        motion, cameras = self._drawn
        filmed = cameras[camera]
        rows = thinned(filmed.frame_t_ns, rate_hz)
        status = status_at(motion, filmed.frame_t_ns[rows])
        views = views_of(filmed, rows, motion, status, self.description.start_ns)
        place = {row: k for k, row in enumerate(rows.tolist())}
        for row, picture in _stills(self.folder, self.description, camera, filmed.frame, rows):
            view, of_joints = views[place[row]], status[place[row]]
            caption = caption_of(view, of_joints, str(self.record.settings["method"]))
            yield int(filmed.frame_t_ns[row]), draw_frame(picture, view, caption)

    def film(
        self, camera: str, angles: Sequence[str], progress: Progress
    ) -> tuple[Int64, Iterator[Picture]] | None:
        """Return the times of all pictures of a camera, and these; None without pictures."""
        media = self.description.cameras[camera].media
        if media is None:
            return None
        if gone := [path for path in media.paths if not is_there(self.folder, path)]:
            place = (self.folder / gone[0]).resolve()
            progress.note(f"{camera}: no overlay, its pictures are not there any more ({place})")
            return None
        refuse_changed_pictures(self.folder, self.description, [camera])
        t_ns = self._drawn[1][camera].frame_t_ns
        return t_ns, self._film(camera, angles, progress)

    def _film(self, camera: str, angles: Sequence[str], progress: Progress) -> Iterator[Picture]:
        motion, cameras = self._drawn
        filmed, method = cameras[camera], str(self.record.settings["method"])
        table = read_table(self.folder / "reconstruct" / "angles.parquet", ANGLES) if angles else None
        size, undecoded = (filmed.intrinsics.height, filmed.intrinsics.width), 0
        count = len(filmed.frame)
        progress.start(f"Drawing {camera}", count)
        with open_pictures(self.folder, self.description, camera) as source:
            for first in range(0, count, _FRAMES_AT_ONCE):
                rows = np.arange(first, min(first + _FRAMES_AT_ONCE, count))
                t_ns = filmed.frame_t_ns[rows]
                status = status_at(motion, t_ns)
                views = views_of(filmed, rows, motion, status, self.description.start_ns)
                labels = _labels(motion, table, angles, t_ns)
                for view, of_joints, own in zip(views, status, labels, strict=True):
                    picture = source.read(view.frame)
                    if picture is None:
                        undecoded += 1
                        picture = blank_frame(size[1], size[0], f"frame {view.frame} cannot be decoded")
                    size = picture.shape[0], picture.shape[1]
                    yield draw_frame(picture, view, caption_of(view, of_joints, method), own)
                    progress.advance()
        if undecoded:
            progress.note(f"{camera}: {undecoded} of {count} pictures cannot be decoded and are grey")


def _labels(
    motion: MeasuredMotion, table: pd.DataFrame | None, angles: Sequence[str], t_ns: Int64
) -> list[list[Label]]:
    """Write every angle of every person at [N] times, beside its joint."""
    if table is None:
        return [[] for _ in t_ns]
    values = [angles_at(motion, table, name, t_ns) for name in angles]
    return [
        [
            (person, _joint_of(name), _angle_text(name, *value[k, person].tolist()))
            for name, value in zip(angles, values, strict=True)
            for person in range(motion.position.shape[1])
        ]
        for k in range(len(t_ns))
    ]


def _joint_of(name: str) -> str:
    """Return the joint beside which an angle of `ANGLES` is written; of the trunk it is `hip`."""
    joint = name.rpartition("_")[0]
    return {"trunk": "hip", "left_forearm": "left_wrist", "right_forearm": "right_wrist"}.get(joint, joint)


def _angle_text(name: str, value_deg: float, sigma_deg: float) -> str:
    """Write an angle in ASCII, which is all that OpenCV's letters have."""
    words = name.replace("_", " ")
    if not np.isfinite(value_deg):
        return f"{words}: undetermined"
    spread = f" +/- {sigma_deg:.0f}" if np.isfinite(sigma_deg) else ""
    return f"{words} {round(value_deg)}{spread} deg"  # round: no minus before 0


def _stills(
    folder: Path, description: Description, camera: str, frame: Int64, rows: Int64
) -> Iterator[tuple[int, Picture]]:
    """Yield row and picture of those that can be decoded; none of a camera whose pictures are gone."""
    media = description.cameras[camera].media
    if media is None or not len(rows) or any(not (folder / path).exists() for path in media.paths):
        return
    with open_pictures(folder, description, camera) as pictures:
        for row in rows.tolist():
            picture = pictures.read(int(frame[row]))
            if picture is not None:
                yield row, picture


# --- where it goes -------------------------------------------------------------------------------------


@contextmanager
def _work_in(target: Path) -> Iterator[Path]:
    """Make a working folder in the target, empty at first and removed at the end; it has one user."""
    with working_folder(target / _WORK, target) as work:
        _clear(work)
        try:
            yield work
        finally:
            _clear(work)


def _clear(work: Path) -> None:
    """Remove what killed exports left behind."""
    for path in [each for each in work.iterdir() if each.is_dir()]:
        remove_tree(path)


def _move(made: Mapping[Path, dict[str, Any]], target: Path, overwrite: bool) -> Exported:
    """Move finished files to the target: all of them, or none if one of the old files may not be replaced."""
    record = target / _RECORD
    ours = _earlier(record)
    unchanged: list[tuple[Path, Path]] = []
    written: list[tuple[Path, Path]] = []
    for path, facts in made.items():
        place = target / path.name
        facts["sha256"] = sha256_of(path)
        there = sha256_of(place) if place.is_file() else None
        own = there is not None and there == ours.get(path.name, {}).get("sha256")
        if place.exists() and there != facts["sha256"] and not own and not overwrite:
            problem = "exists and was not exported so"
            raise DataError(place, problem, "choose another --output, or add --overwrite", code="exists")
        (unchanged if there == facts["sha256"] else written).append((path, place))
    for path, _ in written:
        sync(path)
    for path, place in written:
        path.replace(place)
    files = ours | {path.name: facts for path, facts in made.items()}
    write_json(record, {"schema": _SCHEMA, "files": {name: files[name] for name in sorted(files)}})
    return Exported(target, [place for _, place in written], [place for _, place in unchanged])


def _earlier(record: Path) -> dict[str, dict[str, Any]]:
    """Read which files earlier exports wrote into a folder, by name; empty if the record cannot be read."""
    try:
        files = read_json(record).get("files") if record.is_file() else {}
    except DataError:
        return {}
    named = files.items() if isinstance(files, dict) else ()
    return {name: facts for name, facts in named if isinstance(facts, dict)}
