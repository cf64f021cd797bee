"""From the folder of a flight to its report: draft the manifest, then run every stage."""

from dataclasses import dataclass
from pathlib import Path

from pipelines.draft import draft, leave_out, must_be_drafted
from pipelines.drafting.manifest_text import one_line
from pipelines.drafting.matching import Answer, Ask, Question, leave_open
from pipelines.ingest import OF_ONE_CAMERA, Ingested, ingest
from pipelines.reconstruct import Reconstructed, reconstruct
from pipelines.replan import replan
from pipelines.report import report
from pipelines.session.errors import DataError
from pipelines.session.progress import Progress, Silent

MANIFEST = "flight.yaml"


@dataclass(frozen=True)
class Ran:
    """The results of all stages of a flight."""

    manifest: Path
    assumed: list[str]  # keys that the manifest assumes, as the report lists them
    session: Path
    reconstructed: Reconstructed
    page: Path
    warnings: list[str]


def run(folder: Path, *, ask: Ask = leave_open, workers: int = 1, progress: Progress | None = None) -> Ran:
    """Draft the manifest of a folder if it has none, then ingest, reconstruct, replan and report the flight.

    Planners are compared where the flight has a map and somebody who was logged. What is finished is skipped.
    `folder` may be the manifest, too; `ask` decides what no file tells (see `draft`). DataError: the folder
    holds no flight, something is missing that only the user knows, or a stage cannot do its work.
    """
    progress = progress or Silent()
    manifest, _ = drafted(folder, ask=ask, progress=progress)
    ingested, left_out = _ingested(manifest, progress)
    session, description = ingested.folder, ingested.description
    reconstructed = reconstruct(session, workers=workers, progress=progress)
    if description.map is not None and description.actor is not None:
        try:
            progress.note(f"planners: {replan(session, progress=progress).metrics['verdict']}")
        except DataError as error:
            progress.note(f"planners were not compared: {error}")
    page = report(session).place
    warnings = dict.fromkeys([*left_out, *description.warnings, *reconstructed.record.warnings])
    warnings.pop(OF_ONE_CAMERA, None)  # the verdict says it, with numbers
    return Ran(manifest, description.assumptions, session, reconstructed, page, list(warnings))


def _ingested(manifest: Path, progress: Progress) -> tuple[Ingested, list[str]]:
    """Ingest a flight without cameras of a draft whose films do not say how they turned; say which."""
    left_out: list[str] = []
    while True:
        try:
            return ingest(manifest, progress=progress), left_out
        except DataError as error:
            if error.code != "no-attitude" or not leave_out(manifest, str(error)):
                raise
            left_out.append(f"left out: {error}")


def drafted(folder: Path, *, ask: Ask, progress: Progress) -> tuple[Path, list[str]]:
    """Return a folder's manifest, and what a draft assumes; DataError: no flight, or it lacks something."""
    manifest = folder if folder.suffix in {".yaml", ".yml"} else folder / MANIFEST
    if folder.is_file() and manifest != folder:
        problem = "is no folder and no flight.yaml"
        raise DataError(folder, problem, "name the folder that holds the flight's files", code="wrong-kind")
    if not must_be_drafted(manifest):
        return manifest, []
    open_keys: set[str] = set()

    def note_and_ask(question: Question) -> Answer | None:
        answer = ask(question)
        open_keys.update([question.key] if answer is None else [])
        return answer

    place = manifest.parent if manifest.exists() else folder
    found = draft([place], manifest, overwrite=True, ask=note_and_ask, progress=progress)
    progress.note(f"{manifest}: drafted, with {len(found.cameras)} cameras")
    for path, reason in found.left_out.items():
        if "; " in reason:  # it can be mended, unlike files of other kinds
            progress.note(f"{path}: {reason}")
    if found.missing:
        problem = f"was drafted and lacks {'; '.join(map(one_line, found.missing))}"
        answered = all(any(f"{key}: " in remark for key in open_keys) for remark in found.missing)
        likely = ", or let --yes take the likely answers" if answered else ""
        remedy = "add files that have it, or write it where comments mark the place, and run the same command"
        raise DataError(manifest, problem, f"{remedy} again{likely}", code="incomplete")
    return manifest, found.assumed
