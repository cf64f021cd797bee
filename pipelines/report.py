"""Stage `report`: one self-contained page about a session."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from pipelines.reporting.content import SessionContent
from pipelines.reporting.page import render_page
from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.stages import Stage, StageRecord, WritableSession, locked
from pipelines.session.storage import read_json
from pipelines.session.tables import FRAMES, KEYPOINTS, POSES, SKELETON, TRUTH, read_table

REPORT = Stage("report", revision=2)


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
        run = session.begin(REPORT, settings={"name": folder.stem}, inputs=inputs, force=force)
        page = folder / "report" / "index.html"
        if run.finished:
            return Reported(page, run.record, skipped=True)
        html = render_page(_load(folder, records), read_frame=None)
        (run.folder / "index.html").write_text(html, encoding="utf-8")
        record = run.publish(counts={}, warnings=[])
    return Reported(page, record, skipped=False)


def _finished_stages(session: WritableSession) -> dict[str, StageRecord]:
    records = {name: session.record(name) for name in ("ingest", "reconstruct")}
    if records["ingest"] is None:
        raise DataError(session.folder, "was never ingested completely", "run `mocap ingest` again")
    return {name: record for name, record in records.items() if record is not None}


def _load(folder: Path, records: dict[str, StageRecord]) -> SessionContent:
    description = read_description(folder)
    reconstructed = "reconstruct" in records
    has_truth = description.truth is not None and bool(description.truth.joints)
    with_keypoints = [name for name, entry in description.cameras.items() if entry.keypoints]
    return SessionContent(
        name=folder.stem,
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
        keypoints={
            name: read_table(folder / "cameras" / name / "keypoints.parquet", KEYPOINTS)
            for name in with_keypoints
        },
        stages={name: asdict(record) for name, record in records.items()},
    )
