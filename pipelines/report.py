"""Stage `report`: one self-contained page about a session."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from pipelines.formats.pictures import Picture, Pictures, open_pictures
from pipelines.reporting.content import ReplanContent, SessionContent, section
from pipelines.reporting.page import render_page
from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.maps import load_maps
from pipelines.session.stages import Stage, StageRecord, WritableSession, locked, session_name
from pipelines.session.storage import read_json
from pipelines.session.tables import (
    ACTOR,
    COST_MAP,
    FRAMES,
    KEYPOINTS,
    POSES,
    REPLAN,
    SKELETON,
    TRUTH,
    read_table,
)

REPORT = Stage("report", revision=3)


@dataclass(frozen=True)
class Reported:
    """Where the page is."""

    page: Path
    record: StageRecord
    skipped: bool  # nothing had changed


def report(folder: Path, *, force: bool = False) -> Reported:
    """Write report/index.html of a session.

    Args:
        folder: the session.
        force: do it again although nothing changed.

    Raises:
        DataError: not a session, or damaged.
        BusyError: another process writes the session.
    """
    with locked(folder) as session:
        records = _finished_stages(session)
        inputs = {name: digest for record in records.values() for name, digest in record.outputs.items()}
        inputs |= {
            f"key of {name}": record.key for name, record in records.items()
        }  # their settings are shown
        settings = {"name": session_name(folder), "pictures": _pictures_there(folder)}
        run = session.begin(REPORT, settings=settings, inputs=inputs, force=force)
        page = folder / "report" / "index.html"
        if run.finished:
            return Reported(page, run.record, skipped=True)
        with ExitStack() as stack:
            pictures, warnings = _open_pictures(folder, stack)
            html = render_page(_load(folder, records), read_frame=partial(_read_frame, pictures))
        (run.folder / "index.html").write_text(html, encoding="utf-8")
        record = run.publish(counts={}, warnings=warnings)
    return Reported(page, record, skipped=False)


def _finished_stages(session: WritableSession) -> dict[str, StageRecord]:
    records = {name: session.record(name) for name in ("ingest", "detect", "reconstruct", "replan")}
    if records["ingest"] is None:
        raise DataError(session.folder, "was never ingested completely", "run `mocap ingest` again")
    return {name: record for name, record in records.items() if record is not None}


def _pictures_there(folder: Path) -> list[str]:
    """The cameras whose pictures are still where they were."""
    cameras = read_description(folder).cameras
    media = {name: entry.media for name, entry in cameras.items() if entry.media}
    return [name for name, entry in media.items() if all((folder / path).exists() for path in entry.paths)]


def _open_pictures(folder: Path, stack: ExitStack) -> tuple[dict[str, Pictures], list[str]]:
    """The pictures of every camera that still has them; missing ones cost overlays only, and are said."""
    opened, warnings = {}, []
    for name, entry in read_description(folder).cameras.items():
        if entry.media is None:
            continue
        try:
            opened[name] = stack.enter_context(open_pictures(entry.media, folder))
        except DataError as error:
            warnings.append(f"{name}: no overlays on its pictures: {error}")
    return opened, warnings


def _read_frame(pictures: dict[str, Pictures], camera: str, frame: int) -> Picture | None:
    return pictures[camera].read(frame) if camera in pictures else None


def _load(folder: Path, records: dict[str, StageRecord]) -> SessionContent:
    description = read_description(folder)
    reconstructed = "reconstruct" in records
    has_truth = description.truth is not None and bool(description.truth.joints)
    keypoints = {
        name: read_table(folder / "cameras" / name / "keypoints.parquet", KEYPOINTS)
        for name, entry in description.cameras.items()
        if entry.keypoints
    }
    if "detect" in records:
        keypoints |= {
            name: read_table(folder / "detect" / name / "keypoints.parquet", KEYPOINTS)
            for name in records["detect"].counts["cameras"]
            if name not in keypoints
        }
    return SessionContent(
        name=session_name(folder),
        session=description.model_dump(mode="json", by_alias=True),
        skeleton=read_table(folder / "reconstruct" / "skeleton.parquet", SKELETON) if reconstructed else None,
        metrics=read_json(folder / "reconstruct" / "metrics.json") if reconstructed else None,
        truth=read_table(folder / "truth.parquet", TRUTH) if has_truth else None,
        poses={
            name: read_table(folder / "cameras" / name / "poses.parquet", POSES)
            for name in description.cameras
        },
        frames={
            name: read_table(folder / "cameras" / name / "frames.parquet", FRAMES)
            for name in description.cameras
        },
        keypoints=keypoints,
        stages={name: asdict(record) for name, record in records.items()},
        replan=_load_replan(folder, records["replan"]) if "replan" in records else None,
    )


def _load_replan(folder: Path, record: StageRecord) -> ReplanContent:
    place = folder / "replan"
    metrics = read_json(place / "metrics.json")
    costs = place / "cost_map.parquet"
    return ReplanContent(
        metrics=metrics,
        arms={
            arm: read_table(place / arm / "trajectories.parquet", REPLAN)
            for arm in section(metrics, "arms")
            if f"replan/{arm}/trajectories.parquet" in record.outputs
        },
        actor=read_table(place / "actor.parquet", ACTOR),
        cost_map=read_table(costs, COST_MAP) if costs.exists() else None,
        map=max(load_maps(folder), key=lambda one: one.from_ns, default=None),
    )
