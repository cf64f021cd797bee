"""Stages over many flights, on Dask; this is the only module above the stages.

A flight is one task. If a worker dies, the next one continues where its stages stopped. Sessions are the same
as those of single runs, byte for byte.
"""

import csv
import io
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.replan import replan
from pipelines.report import report
from pipelines.reporting.page import COLUMNS, FlightRow, render_flights
from pipelines.reporting.wording import cell_text
from pipelines.session.description import read_description
from pipelines.session.errors import BusyError, DataError, MocapError
from pipelines.session.parallel import connected, local_cluster, result_of
from pipelines.session.progress import Progress, Silent
from pipelines.session.registries import need
from pipelines.session.stages import names_of
from pipelines.session.storage import make_folder, on_disk, read_json, url_of, write_whole
from pipelines.session.urls import as_urls, fetched, get, put, session_here

STAGES = ("ingest", "reconstruct", "replan-compare", "report")

# The summary goes there if sessions lie beside their flights.
_FOLDER = "batch"
_TABLE, _PAGE = "summary.csv", "summary.html"
# A worker that lost its scheduler notices that within this time, and releases its session.
MAX_WAIT_FOR_OWNER_S = 30.0

T = TypeVar("T")


@dataclass(frozen=True)
class BatchSettings:
    """Settings for every flight."""

    stages: tuple[str, ...] = STAGES
    reconstruct: ReconstructSettings = field(default_factory=ReconstructSettings)


@dataclass(frozen=True)
class Job:
    """One flight, as a task for a worker."""

    flight: Path  # absolute, because workers have other working directories
    session: Path
    settings: BatchSettings
    force: bool
    workers: int = 1  # blocks of its pictures in parallel; results do not depend on it


@dataclass(frozen=True)
class Outcome(FlightRow):
    """Result of a flight, whose paths are written as seen from the summary once it is back."""

    unchanged: bool = False  # no stage had anything to do
    reported: bool = False  # the session has a report, perhaps of an earlier run
    started: bool = False  # at least one stage was run, or tried


@dataclass(frozen=True)
class Batch:
    """Result of a batch."""

    flights: tuple[Path, ...]
    sessions: tuple[Path, ...]
    rows: tuple[FlightRow, ...]  # one for each flight
    unchanged: int  # flights for which no stage had anything to do
    table: Path
    page: Path


def batch(
    flights: Sequence[Path],
    output: Path | None = None,
    settings: BatchSettings | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    force: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Batch:
    """Run the stages over many flights, and write a summary; a flight that fails does not stop the others.

    By default sessions lie beside manifests, and the summary in `batch/` of the working directory. `workers`
    are processes of one flight each, one per core by default; `scheduler` the address of a Dask cluster with
    the same folders. `overwrite` replaces files of the summary's names that are of no batch. DataError: Dask
    is not installed, no scheduler answers, sessions would have one name, or the summary cannot be written.
    """
    settings, progress = settings or BatchSettings(), progress or Silent()
    unknown = [stage for stage in settings.stages if stage not in STAGES]
    if unknown:
        problem, remedy = "no such stage", f"there are {', '.join(STAGES)}"
        raise DataError(f"--stages {unknown[0]}", problem, remedy, code="no-such-name")
    need("distributed", "batch")
    flights = list({path.resolve(): path for path in flights}.values())
    folder = output or Path(_FOLDER)
    _refuse_foreign(folder, overwrite)
    workers = workers or os.cpu_count() or 1
    for_each = 1 if scheduler else max(1, workers // max(len(flights), 1))
    sessions = [flight.with_suffix(".session") for flight in flights]
    if output is not None:
        sessions = [output / f"{name}.session" for name in names_of(flights)]
    jobs = [
        Job(_absolute(flight), _absolute(session), settings, force, for_each)
        for flight, session in zip(flights, sessions, strict=True)
    ]
    outcomes = dict(_outcomes(jobs, workers, scheduler, progress))
    rows = tuple(_row(folder, job, outcomes[k]) for k, job in enumerate(jobs))
    _store(folder, rows)
    unchanged = sum(outcome.unchanged for outcome in outcomes.values())
    return Batch(tuple(flights), tuple(sessions), rows, unchanged, folder / _TABLE, folder / _PAGE)


def run_flight(job: Job) -> Outcome:
    """Run all stages of one flight, and upload its session if that lies at a URL; raise no error."""
    outcome = Outcome()
    try:
        with ExitStack() as stack:
            folder = _wait_while_locked(lambda: stack.enter_context(session_here(job.session, create=True)))
            flight = url_of(job.flight)
            here = fetched(flight, fresh=True) if flight else job.flight
            outcome = _run_stages(replace(job, flight=here, session=folder))
    except MocapError as error:  # of a store: before the first stage, or in the upload after the last
        stage = job.settings.stages[-1 if outcome.started else 0]
        outcome = replace(outcome, failed_stage=stage, error=" ".join(str(error).split()))
    return outcome


def _run_stages(job: Job) -> Outcome:
    failed: dict[str, str] = {}  # the first error, by its stage
    finished: list[str] = []
    unchanged = True
    for stage in (stage for stage in STAGES if stage in job.settings.stages):
        if failed and not (stage == "report" and _is_ingested(job, failed)):
            continue
        try:
            unchanged &= _wait_while_locked(partial(_run, stage, job))
            finished.append(stage)
        except MocapError as error:
            failed = failed or {stage: str(error)}
        except Exception as error:  # a bug of mocap in one flight must not stop the others
            line = f"{job.flight}: a bug of mocap stopped {stage} ({type(error).__name__}: {error})"
            failed = failed or {stage: line}
    outcome = Outcome()
    try:
        if _is_ingested(job, failed):
            outcome = _summed_up(job.session, finished)
    except MocapError as error:
        failed = failed or {"report": str(error)}
    return replace(
        outcome,
        failed_stage=next(iter(failed), None),
        error=next((" ".join(line.split()) for line in failed.values()), None),
        unchanged=unchanged and not failed,
        reported=(job.session / "report" / "index.html").is_file(),
        started=True,
    )


def _is_ingested(job: Job, failed: Mapping[str, str]) -> bool:
    return (job.session / "session.json").is_file() and "ingest" not in failed


def _run(stage: str, job: Job) -> bool:
    match stage:
        case "ingest":
            make_folder(job.session.parent)
            return ingest(job.flight, job.session, force=job.force).skipped
        case "reconstruct":
            settings, workers = job.settings.reconstruct, job.workers
            return reconstruct(job.session, settings, workers=workers, force=job.force).skipped
        case "replan-compare":
            return replan(job.session, force=job.force).skipped
        case _:
            return report(job.session, force=job.force).skipped


def _wait_while_locked(call: Callable[[], T]) -> T:
    """Call a function; if a session is locked, wait a while for an abandoned worker that is still ending."""
    until_s = time.monotonic() + MAX_WAIT_FOR_OWNER_S
    while True:
        try:
            return call()
        except BusyError:
            if time.monotonic() > until_s:
                raise
            time.sleep(0.5)


def _summed_up(session: Path, stages: Sequence[str]) -> Outcome:
    """Read the flight's name, and the figures and warnings of its finished stages."""
    description = read_description(session)
    found: dict[str, object] = {}
    warnings = list(description.warnings)
    doubts: list[dict[str, Any]] = [doubt.as_json() for doubt in description.doubts]
    for stage, folder in (("reconstruct", "reconstruct"), ("replan-compare", "replan")):
        if stage not in stages:
            continue
        metrics = read_json(session / folder / "metrics.json")
        warnings += read_json(session / folder / "stage.json").get("warnings", [])
        if stage == "reconstruct":
            found |= {name: metrics.get(name) for name in ("reconstructed_share", "mpjpe_mm", "pa_mpjpe_mm")}
            found["reprojection_px"] = metrics["reprojection_px"]["median"]
            doubts = metrics.get("doubts", [])
        else:
            found |= {f"tilt_deg_{name}": arm["tilt_deg"]["mean"] for name, arm in metrics["arms"].items()}
    figures = {name: float(value) for name, value in found.items() if isinstance(value, int | float)}
    return Outcome(
        name=description.flight,
        figures=figures,
        warnings=tuple(dict.fromkeys(warnings)),
        doubt=doubts[0]["code"] if doubts else None,
    )


def _outcomes(
    jobs: Sequence[Job], workers: int, scheduler: str | None, progress: Progress
) -> Iterator[tuple[int, Outcome]]:
    """Yield the number and outcome of every job, in the order in which they end."""
    progress.start("Flights", len(jobs))
    on_dask = connected(scheduler, progress) if scheduler else local_cluster(min(workers, len(jobs)))
    with on_dask as client, client.get_executor(pure=False) as executor:
        numbers = {executor.submit(run_flight, job): number for number, job in enumerate(jobs)}
        for future in as_completed(numbers):
            number = numbers[future]
            try:
                outcome: Outcome = result_of(future, jobs[number].flight)
            except MocapError as error:  # of the cluster, because a job itself raises nothing
                outcome = Outcome(error=str(error))
            if outcome.error is not None:
                progress.note(f"failed: {_as_here(outcome.error)}")
            progress.advance()
            yield number, outcome


def _absolute(path: Path) -> Path:
    if url_of(path):
        return path
    return Path(os.path.abspath(path))  # noqa: PTH100  # links stay: media are named relative to the session


def _refuse_foreign(folder: Path, overwrite: bool) -> None:
    """Refuse to replace a table that is not the summary of a batch."""
    table = folder / _TABLE
    with on_disk(table):
        if overwrite:
            return
        if url := url_of(table):
            first = (get(url) or ",".join(COLUMNS).encode()).decode("utf-8", "replace")
        elif not table.exists():
            return
        else:
            with table.open(encoding="utf-8", errors="replace") as file:
                first = file.readline()
    if not first.startswith(",".join(COLUMNS[:4])):
        problem = "is not the summary of a batch"
        raise DataError(table, problem, "choose another --output, or give --overwrite", code="exists")


def _row(folder: Path, job: Job, outcome: Outcome) -> FlightRow:
    report = _from(folder, job.session / "report" / "index.html") if outcome.reported else None
    error = None if outcome.error is None else _as_here(outcome.error)
    return replace(outcome, flight=_from(folder, job.flight), error=error, report=report)


def _as_here(line: str) -> str:
    """Make the paths in a line relative, as in the messages of a single run."""
    return as_urls(line).replace(f"{Path.cwd()}{os.sep}", "")


def _from(folder: Path, path: Path) -> str:
    if url_of(folder) or url_of(path):
        return url_of(path) or path.as_posix()
    return Path(os.path.relpath(path, folder)).as_posix()


def _store(folder: Path, rows: Sequence[FlightRow]) -> None:
    arms = list(dict.fromkeys(name for row in rows for name in row.arms))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(map(cell_text, [*COLUMNS, *arms, "warnings", "report"]))
    writer = csv.writer(text, lineterminator="\n", quoting=csv.QUOTE_NONNUMERIC)
    for row in rows:
        cells = [*row.cells(), *(row.figures.get(arm) for arm in arms), len(row.warnings), row.report]
        writer.writerow(map(cell_text, cells))
    with on_disk(folder):
        for name, content in {_TABLE: text.getvalue(), _PAGE: render_flights(rows)}.items():
            encoded = content.encode("utf-8", "replace")
            if url := url_of(folder / name):
                put(url, encoded)
                continue
            make_folder(folder)
            write_whole(folder / name, encoded)
