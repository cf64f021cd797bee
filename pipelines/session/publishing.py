"""Replacement of a stage's files by new ones, complete or not at all, even if the process is killed.

A stage writes into `<stage>.new/`. Its `stage.json`, written last and synced, is the point of no return.
Without it, the folder is removed. With it, publication is completed by the next process that opens the
session.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from pipelines.session.stage_records import STAGES, NewerSchemaError, StageRecord, read_record, usable_record
from pipelines.session.storage import remove_tree, sync_folder

AT_ROOT = {
    "ingest": (
        "cameras",
        "actor.parquet",
        "map",
        "plan.parquet",
        "truth.parquet",
        "truth_poses.parquet",
        "session.json",
    )
}
"""Names that a stage publishes beside its own folder instead of inside it; only that stage writes them."""

_SHOWN_BY = {"reconstruct": ("overlay",)}
"""Stages that only show another stage's result; they are removed when that result is replaced."""


def new_folder(folder: Path, stage: str) -> Path:
    """Return the folder in which a stage writes until it is published."""
    return folder / f"{stage}.new"


def _old(folder: Path, stage: str) -> Path:
    # Hidden, because a user may keep a copy of a result as `reconstruct.old`, which must not be removed.
    return folder / f".{stage}.old"


def is_interrupted(folder: Path) -> bool:
    """Return True if the publication of a stage was interrupted."""
    return any(
        (new_folder(folder, stage) / "stage.json").exists() or _old(folder, stage).exists()
        for stage in STAGES
    )


def repair(folder: Path) -> None:
    """Complete interrupted publications, and remove the folders of stages that did not reach theirs."""
    for stage in STAGES:
        if usable_record(new_folder(folder, stage) / "stage.json") is not None:
            roll_forward(folder, stage)
        remove_tree(new_folder(folder, stage))
        _settle_old(folder, stage)
    remove_tree(folder / "run.json.new")


def roll_forward(folder: Path, stage: str) -> None:
    """Publish a complete `<stage>.new`.

    Every step can be repeated, and the stage's folder, with its record, is renamed last. After a kill between
    any two steps, doing all of them again completes the publication.
    """
    new, old = new_folder(folder, stage), _old(folder, stage)
    record = read_record(new / "stage.json")
    published = {name.partition("/")[0] for name in record.outputs}
    remove_partials(folder, stage)
    old.mkdir(exist_ok=True)
    for entry in AT_ROOT.get(stage, ()):
        is_in_place = entry in published and not (new / entry).exists()
        if not is_in_place:
            _move(folder / entry, old / entry)
            _move(new / entry, folder / entry)
    for shown in outdated(folder, record):
        _move(folder / shown, old / shown)
    _move(folder / stage, old / stage)
    new.rename(folder / stage)
    sync_folder(old)
    sync_folder(folder)
    remove_tree(old)


def outdated(folder: Path, record: StageRecord) -> list[str]:
    """List the stages that show a result other than this one; those of a later version are left alone."""
    gone = []
    for name in _SHOWN_BY.get(record.stage, ()):
        with suppress(NewerSchemaError):
            shown = usable_record(folder / name / "stage.json")
            if shown is not None and shown.inputs.get(record.stage) != record.key:
                gone.append(name)
    return gone


def _settle_old(folder: Path, stage: str) -> None:
    """Remove replaced files, or put them back if the user has removed their successor since."""
    old = _old(folder, stage)
    if old.exists() and not (folder / stage).exists():
        for entry in sorted(old.iterdir()):
            if not (folder / entry.name).exists():
                entry.rename(folder / entry.name)
    remove_tree(old)


def _move(source: Path, target: Path) -> None:
    if source.exists():
        source.rename(target)


def remove_partials(folder: Path, stage: str) -> None:
    """Remove the stored finished parts of a stage, which no run needs any more."""
    partial = folder / ".partial"
    for chunks in sorted(partial.glob(f"{stage}-*")):
        remove_tree(chunks)
    if partial.is_dir() and not any(partial.iterdir()):
        partial.rmdir()
