"""How a stage's files take the place of earlier ones, in one piece whatever is killed when.

A stage writes into `<stage>.new/`. Its `stage.json`, written last and synced, is the point of no return:
without it the folder is thrown away, with it publication is carried to its end, by whoever opens the
session next.
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
"""What a stage publishes beside its own folder instead of inside it; these names are its own."""

_SHOWN_BY = {"reconstruct": ("overlay",)}
"""Stages that show a stage's result and nothing else: they go with the result that they show."""


def new_folder(folder: Path, stage: str) -> Path:
    """Where a stage writes until it is published."""
    return folder / f"{stage}.new"


def _old(folder: Path, stage: str) -> Path:
    # Hidden: a user may well keep a copy of a result as `reconstruct.old`, and that is not ours to remove.
    return folder / f".{stage}.old"


def is_interrupted(folder: Path) -> bool:
    """Whether something in a session is published halfway."""
    return any(
        (new_folder(folder, stage) / "stage.json").exists() or _old(folder, stage).exists()
        for stage in STAGES
    )


def repair(folder: Path) -> None:
    """Finish what was published halfway, remove what was not."""
    for stage in STAGES:
        if usable_record(new_folder(folder, stage) / "stage.json") is not None:
            roll_forward(folder, stage)
        remove_tree(new_folder(folder, stage))
        _settle_old(folder, stage)
    remove_tree(folder / "run.json.new")


def roll_forward(folder: Path, stage: str) -> None:
    """Publish a complete `<stage>.new`.

    Every step can be taken again, and the renaming of the stage's folder, with its record, comes last: a kill
    between any two steps is mended by doing it all once more.
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
    """The stages that show another result than this one; those of a later version are not ours to judge."""
    gone = []
    for name in _SHOWN_BY.get(record.stage, ()):
        with suppress(NewerSchemaError):
            shown = usable_record(folder / name / "stage.json")
            if shown is not None and shown.inputs.get(record.stage) != record.key:
                gone.append(name)
    return gone


def _settle_old(folder: Path, stage: str) -> None:
    """Remove what was replaced, or put it back where its successor has been removed by hand meanwhile."""
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
    """Remove the finished parts of a stage that no run will ask for."""
    partial = folder / ".partial"
    for chunks in sorted(partial.glob(f"{stage}-*")):
        remove_tree(chunks)
    if partial.is_dir() and not any(partial.iterdir()):
        partial.rmdir()
