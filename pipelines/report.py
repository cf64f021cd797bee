"""Stage `report`: one self-contained page about a session, and one that compares several sessions."""

import shlex
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from pipelines.geometry.arrays import Int64, Picture, nearest_rows
from pipelines.reporting.chart import MARK, refuse_foreign, write_figures
from pipelines.reporting.content import ReplanContent, SessionContent, StudyContent, estimated_clocks, section
from pipelines.reporting.page import draw_page, draw_session
from pipelines.reporting.pictures import Video
from pipelines.reporting.session_comparison import compare, draw_comparison, labels_of, render_comparison
from pipelines.reporting.studies import draw_study, study_blocks
from pipelines.session.description import Description, read_description
from pipelines.session.errors import DataError
from pipelines.session.maps import load_maps
from pipelines.session.parallel import return_freed_arrays, return_unused
from pipelines.session.records import Occupancy
from pipelines.session.stages import (
    Session,
    Stage,
    StageRecord,
    locked,
    open_session,
    outdated,
    session_name,
    tidy,
    versions_of,
    was_interrupted,
)
from pipelines.session.storage import (
    STUDY_MARK,
    hash_of,
    is_made,
    on_disk,
    read_json,
    refuse_special,
    sha256_of,
    whole_folder,
    write_whole,
)
from pipelines.session.tables import (
    ACTOR,
    ANGLES,
    BODY,
    BODY_SHAPE,
    CAMERA_POSES,
    FRAMES,
    JOINT_ERRORS,
    KEYPOINTS,
    POSES,
    REPLAN,
    SKELETON,
    TRUTH,
    count_rows,
    distinct,
    read_rows,
    read_table,
)
from pipelines.session.urls import is_there
from pipelines.sources.pictures import CameraPictures, open_pictures, refuse_changed_pictures

REPORT = Stage("report", revision=25)
# Figures of another revision are drawn again.
_FIGURES_REVISION = 8


@dataclass(frozen=True)
class Reported:
    """Result of writing a page, or the files of its figures."""

    place: Path  # the page, or the folder of the files
    skipped: bool  # True if nothing had changed
    warnings: Sequence[str] = ()


def report(
    folder: Path,
    output: Path | None = None,
    *,
    studies: Sequence[Path] = (),
    video: Video = "small",
    force: bool = False,
    overwrite: bool = False,
) -> Reported:
    """Write report/index.html of a session, or its page at `output`, if anything changed (or by `force`).

    `studies` are folders of `mocap study` that the page shows as well, `video` how much film it holds (none,
    small or full); `force` writes it anew though nothing changed; `overwrite` replaces a file at
    `output` that is no page of mocap. DataError: not a session, or damaged; a table of it, or pictures, were
    changed; a folder that holds no study; the page cannot be written. BusyError: another process writes the
    session.
    """
    studied = [read_study(study) for study in studies]
    return_freed_arrays()
    if output is not None:
        page = _Page(open_session(folder), studied, video)
        _refuse_foreign(output, overwrite)
        html, warnings = page.render()
        return Reported(output, skipped=not _write_if_changed(output, html), warnings=warnings)
    place = folder / "report" / "index.html"
    if not force and not was_interrupted(folder):
        page = _Page(open_session(folder), studied, video)
        if (done := page.session.finished(REPORT, page.settings, page.inputs)) is not None:
            tidy(folder)
            return Reported(place, skipped=True, warnings=done.warnings)
    with locked(folder) as session:
        page = _Page(session, studied, video)
        run = session.begin(REPORT, settings=page.settings, inputs=page.inputs, force=force)
        if run.finished:
            return Reported(place, skipped=True, warnings=run.record.warnings)
        html, warnings = page.render()
        (run.folder / "index.html").write_text(html, encoding="utf-8")
        record = run.publish(counts={}, warnings=warnings)
    return Reported(place, skipped=False, warnings=record.warnings)


class _Page:
    """The page of a session, and what it depends on."""

    def __init__(self, session: Session, studied: Sequence[StudyContent], video: Video) -> None:
        self.session, self._studied, self._video = session, tuple(studied), video
        folder = session.folder
        self._records = _finished_stages(session)
        self.inputs = {name: it for record in self._records.values() for name, it in record.outputs.items()}
        # The settings of the stages are shown: their keys cover them.
        self.inputs |= {f"key of {name}": record.key for name, record in self._records.items()}
        self._description = read_description(folder)
        _refuse_changed_pictures(folder, self._description)
        self.settings: dict[str, object] = {
            "name": session_name(folder),
            "pictures": _pictures_there(folder, self._description),
            "studies": _named(studied),
            "video": video,
        }

    def render(self) -> tuple[str, list[str]]:
        """Return the page and warnings."""
        folder = self.session.folder
        with ExitStack() as stack:
            pictures, warnings = _open_pictures(folder, self._description, stack)
            page = draw_page(
                replace(_load(folder, self._description, self._records), studies=self._studied),
                read_frame=partial(_read_frame, pictures),
                video=self._video,
            )
        return_unused()  # the tables, before the text of the page takes as much
        return page.render(), warnings


def compare_sessions(
    folders: Sequence[Path], output: Path | None = None, *, overwrite: bool = False
) -> Reported:
    """Write the page that compares every session with the first, by default comparison/index.html."""
    resolved = [folder.resolve() for folder in folders]
    for folder, place in zip(folders, resolved, strict=True):
        if resolved.count(place) > 1:
            raise DataError(folder, "is stated twice", "state every session once", code="stated-twice")
    contents = {label: content_of(folder) for label, folder in zip(_labels(resolved), folders, strict=True)}
    page = output or resolved[0].parent / "comparison" / "index.html"
    html = render_comparison(contents)
    _refuse_foreign(page, overwrite)
    return Reported(page, skipped=not _write_if_changed(page, html))


def _write_if_changed(page: Path, html: str) -> bool:
    """Write a page; return False if it is there already."""
    with on_disk(page):
        if page.is_file() and page.read_bytes() == html.encode():
            return False
        page.parent.mkdir(parents=True, exist_ok=True)
        write_whole(page, html.encode())
    return True


def write_figures_of(
    folders: Sequence[Path],
    target: Path,
    *,
    studies: Sequence[Path] = (),
    overwrite: bool = False,
    force: bool = False,
) -> Reported:
    """Write the figures of a session's page, or of the page that compares several with the first, as files.

    They are PNG, SVG and PDF, their numbers CSV, and figures.json has titles and captions. Figures of an
    earlier run are replaced; with `overwrite` also other things, but never a session. DataError: not a
    session, or damaged; a table of it, or pictures, were changed; the folder cannot be written. BusyError:
    another process writes it.
    """
    with on_disk(target):
        refuse_foreign(target, overwrite=overwrite)
    studied = [read_study(study) for study in studies]
    labels = _labels([folder.resolve() for folder in folders])
    sessions = {
        label: (folder, read_description(folder), _finished_stages(open_session(folder)))
        for label, folder in zip(labels, folders, strict=True)
    }
    (folder, description, _), *others = sessions.values()
    if not others:  # a comparison shows no pictures
        _refuse_changed_pictures(folder, description)
    made_of = {
        "revision": _FIGURES_REVISION,
        "pictures": [_pictures_there(*each[:2]) for each in sessions.values()],
        "sessions": {
            label: {name: record.key for name, record in records.items()}
            for label, (_, _, records) in sessions.items()
        },
        "studies": _named(studied),
    }
    key = hash_of(made_of)
    if not force and is_made(target, key, mark=MARK):
        return Reported(target, skipped=True)
    contents = {label: _load(*each) for label, each in sessions.items()}
    if others:
        figures = draw_comparison(compare(contents))
    else:
        with ExitStack() as stack:
            pictures, _ = _open_pictures(folder, description, stack)
            content = replace(contents[labels[0]], studies=tuple(studied))
            figures = draw_session(content, partial(_read_frame, pictures))
    with whole_folder(target, key, mark=MARK, overwrite=True) as making:
        write_figures(making.folder, figures, contents, key)
        making.publish()
    return Reported(target, skipped=False)


def read_study(folder: Path) -> StudyContent:
    """Read the result of `mocap study` in a folder; DataError: it holds none, or a damaged one."""
    remedy = "name a folder that `mocap study ... -o FOLDER` wrote"
    if not (folder / STUDY_MARK).is_file():
        raise DataError(folder, f"holds no study (no {STUDY_MARK})", remedy, code="wrong-kind")
    metrics = read_json(folder / "metrics.json", remedy)
    try:
        words = ["mocap", "study", *metrics["command"], "-o", folder.resolve().name]
        study = StudyContent(metrics, shlex.join(words), sha256_of(folder / "metrics.json"))
        study_blocks(study, draw_study("study", metrics))
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        problem = "is not the result of a study"
        raise DataError(folder / "metrics.json", problem, remedy, code="wrong-kind") from error
    return study


def _named(studies: Sequence[StudyContent]) -> list[dict[str, object]]:
    """Describe studies for the settings: their command, and the hash of their results."""
    return [{"command": each.command, "metrics.json": each.digest} for each in studies]


def _labels(resolved: Sequence[Path]) -> list[str]:
    return labels_of([(*place.parts[1:-1], session_name(place)) for place in resolved])


def _refuse_foreign(page: Path, overwrite: bool) -> None:
    """Refuse to replace a file that is no page of mocap; those name their generator near the beginning."""
    if page.is_dir():
        raise DataError(page, "is a folder", "name a file with --output", code="not-a-folder")
    if overwrite or not page.exists():
        return
    refuse_special(page)
    with on_disk(page), page.open("rb") as file:
        is_ours = b'<meta name="generator" content="mocap' in file.read(2048)
    if not is_ours:
        remedy = "choose another place with --output, or write over it with --overwrite"
        raise DataError(page, "is there and is no page of mocap", remedy, code="exists")


def _finished_stages(session: Session) -> dict[str, StageRecord]:
    records = {"ingest": session.ingested()}
    others = {name: session.intact_record(name) for name in ("detect", "reconstruct", "replan", "film")}
    replan, film = others["replan"], others["film"]
    if replan is None or film is None or film.inputs["replan"] != replan.key:
        del others["film"]  # of another comparison
    return records | {name: record for name, record in others.items() if record is not None}


def _refuse_changed_pictures(folder: Path, description: Description) -> None:
    filmed = [name for name, entry in description.cameras.items() if entry.media]
    refuse_changed_pictures(folder, description, filmed)


def _pictures_there(folder: Path, description: Description) -> list[str]:
    """List the cameras whose pictures are still where they were at ingest."""
    media = {name: entry.media for name, entry in description.cameras.items() if entry.media}
    return [name for name, entry in media.items() if all(is_there(folder, path) for path in entry.paths)]


def _open_pictures(
    folder: Path, description: Description, stack: ExitStack
) -> tuple[dict[str, CameraPictures], list[str]]:
    """Open the pictures of every camera that still has them; return a warning for each other camera."""
    opened, warnings = {}, []
    for name, entry in description.cameras.items():
        if entry.media is None:
            continue
        try:
            opened[name] = stack.enter_context(open_pictures(folder, description, name))
        except DataError as error:
            warnings.append(f"{name}: no overlays on its pictures: {error}")
    return opened, warnings


def _read_frame(pictures: dict[str, CameraPictures], camera: str, frame: int) -> Picture | None:
    return pictures[camera].read(frame) if camera in pictures else None


def content_of(folder: Path) -> SessionContent:
    """Load all that the page of a session shows; DataError: not a session, damaged, or a changed table."""
    records = _finished_stages(open_session(folder))
    return _load(folder, read_description(folder), records)


# A page is drawn from 4500 times of one person with 33 joints, or as much of others: more change no
# figure, and take memory.
MAX_ROWS = 150_000
# Arms are drawn from two minutes at 50 Hz, or as many times of a longer flight.
MAX_ARM_TIMES = 6_000


class _Shown:
    """The times of a long flight that its page shows, every k-th, and what was recorded about them."""

    def __init__(self, folder: Path, t_ns: Int64, rows: int, metrics: Mapping[str, object] | None) -> None:
        self.every = max(-(-max(rows, len(t_ns)) // MAX_ROWS), 1)
        self._folder = folder
        self._t_ns = t_ns[:: self.every]
        self._offset_ns = estimated_clocks(metrics or {})
        self._frames: dict[str, pd.DataFrame] = {}

    def table(self, name: str, schema: pa.Schema) -> pd.DataFrame:
        """Read the rows of a table that were written at these times."""
        path = self._folder / name
        if self.every == 1:
            return read_table(path, schema)
        return _rows(path, schema, "t_ns", self._t_ns)

    def about(self, name: str, schema: pa.Schema) -> pd.DataFrame:
        """Read the rows of a table of other times that lie next to these."""
        path = self._folder / name
        if self.every == 1 or not len(stamps := distinct(path, "t_ns")):
            return read_table(path, schema)
        after = np.searchsorted(stamps, self._t_ns).clip(0, len(stamps) - 1)
        next_to = np.concatenate([after, (after - 1).clip(0), (0, len(stamps) - 1)])
        return _rows(path, schema, "t_ns", stamps[np.unique(next_to)])

    def frames(self, camera: str) -> pd.DataFrame:
        """Read the frames of a camera that are nearest to these times."""
        table = read_table(self._folder / "cameras" / camera / "frames.parquet", FRAMES)
        if self.every == 1 or not len(table):
            return table
        stamps = table["t_ns"].to_numpy(np.int64) + self._offset_ns.get(camera, 0)
        rows = np.unique(np.concatenate([nearest_rows(stamps, self._t_ns), (0, len(stamps) - 1)]))
        return table.iloc[rows].reset_index(drop=True)

    def keypoints(self, stage: str, camera: str) -> pd.DataFrame:
        """Read the keypoints in these frames."""
        path = self._folder / stage / camera / "keypoints.parquet"
        if self.every == 1:
            return read_table(path, KEYPOINTS)
        shown = self.frames(camera)["frame"].to_numpy(np.int64)
        return _rows(path, KEYPOINTS, "frame", shown)


def _rows(path: Path, schema: pa.Schema, name: str, chosen: Int64) -> pd.DataFrame:
    table = read_rows(path, schema, name, chosen)
    return_unused()
    return table


def _times(folder: Path, description: Description, *, reconstructed: bool) -> Int64:
    if reconstructed:
        return distinct(folder / "reconstruct" / "skeleton.parquet", "t_ns")
    camera = max(description.cameras, key=lambda name: description.cameras[name].frames.count)
    return distinct(folder / "cameras" / camera / "frames.parquet", "t_ns")


def _load(folder: Path, description: Description, records: dict[str, StageRecord]) -> SessionContent:
    reconstructed = "reconstruct" in records
    metrics = read_json(folder / "reconstruct" / "metrics.json") if reconstructed else None
    rows = count_rows(folder / "reconstruct" / "skeleton.parquet") if reconstructed else 0
    shown = _Shown(folder, _times(folder, description, reconstructed=reconstructed), rows, metrics)
    found_by = {name: "cameras" for name, entry in description.cameras.items() if entry.keypoints}
    detected = records["detect"].counts["cameras"] if "detect" in records else ()
    found_by |= {name: "detect" for name in detected if name not in found_by}
    outputs = records["reconstruct"].outputs if reconstructed else {}
    angles, errors = "reconstruct/angles.parquet", "reconstruct/joint_errors.parquet"
    bodies, shapes = "reconstruct/body.parquet", "reconstruct/body_shape.parquet"
    maps = load_maps(folder) if description.map else []
    return SessionContent(
        name=session_name(folder),
        session=description,
        every=shown.every,
        skeleton=shown.table("reconstruct/skeleton.parquet", SKELETON) if reconstructed else None,
        metrics=metrics,
        truth=shown.about("truth.parquet", TRUTH) if description.has_true_joints else None,
        poses={name: shown.about(f"cameras/{name}/poses.parquet", POSES) for name in description.cameras},
        frames={name: shown.frames(name) for name in description.cameras},
        keypoints={name: shown.keypoints(stage, name) for name, stage in found_by.items()},
        stages={name: asdict(record) for name, record in records.items()},
        replan=_load_replan(folder, records, maps) if "replan" in records else None,
        refined=_by_camera(shown, "reconstruct/cameras.parquet", records.get("reconstruct")),
        angles=shown.table(angles, ANGLES) if angles in outputs else None,
        joint_errors=read_table(folder / errors, JOINT_ERRORS) if errors in outputs else None,
        bodies=shown.table(bodies, BODY) if bodies in outputs else None,
        shapes=read_table(folder / shapes, BODY_SHAPE) if shapes in outputs else None,
        made_by=versions_of(folder),
        outdated=tuple(outdated(records, description.recorded)),
    )


def _by_camera(shown: _Shown, name: str, record: StageRecord | None) -> dict[str, pd.DataFrame]:
    """Split a table of poses by camera; empty if the stage of this record wrote none."""
    if record is None or name not in record.outputs:
        return {}
    table = shown.about(name, CAMERA_POSES).sort_values(["camera", "t_ns"])
    return {str(name): own[POSES.names].reset_index(drop=True) for name, own in table.groupby("camera")}


def _thinned(path: Path, schema: pa.Schema) -> pd.DataFrame:
    """Read a table of a comparison, of a long one every k-th time."""
    stamps = distinct(path, "t_ns")
    every = max(-(-len(stamps) // MAX_ARM_TIMES), 1)
    return read_table(path, schema) if every == 1 else _rows(path, schema, "t_ns", stamps[::every])


def _load_replan(folder: Path, records: dict[str, StageRecord], maps: list[Occupancy]) -> ReplanContent:
    place, record = folder / "replan", records["replan"]
    metrics = read_json(place / "metrics.json")
    return ReplanContent(
        metrics=metrics,
        arms={
            arm: _thinned(place / arm / "trajectories.parquet", REPLAN)
            for arm in section(metrics, "arms")
            if f"replan/{arm}/trajectories.parquet" in record.outputs
        },
        actor=_thinned(place / "actor.parquet", ACTOR),
        map=max(maps, key=lambda one: one.from_ns, default=None),
        filmed=read_json(folder / "film" / "metrics.json") if "film" in records else {},
    )
