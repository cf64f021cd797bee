"""Records of a session's stages: `stage.json`, of what each was made, and `run.json`, when and how long.

`run.json` is the only file that differs from run to run: it holds run times, the versions of libraries, and
the stamps of sources.
"""

import platform
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pipelines.session.errors import DataError
from pipelines.session.storage import hash_of, read_json, write_json

SCHEMA = 1
"""Version of session.json and stage.json. Older ones are read, newer ones refused."""

STAGES = ("ingest", "detect", "background", "reconstruct", "replan", "film", "report")
"""The stages in the order in which they may run."""

COMMANDS = {
    "ingest": "mocap ingest",
    "detect": "mocap reconstruct",
    "background": "mocap reconstruct",
    "reconstruct": "mocap reconstruct",
    "replan": "mocap replan-compare",
    "film": "mocap replan-compare --render 5",
    "report": "mocap report",
}
"""The command that makes each stage."""


class NewerSchemaError(DataError):
    """Error for a file that a later version of this program wrote."""

    code = "newer-schema"


@dataclass(frozen=True)
class Stage:
    """One of the stages of a session.

    Args:
        name: its folder in the session.
        revision: a number that is increased when the same inputs and settings give other results than before.
    """

    name: str
    revision: int

    def __post_init__(self) -> None:
        if self.name not in STAGES:
            raise ValueError(f"{self.name} is not a stage of a session")


@dataclass(frozen=True)
class StageRecord:
    """The content of a finished stage's `stage.json`."""

    stage: str
    revision: int
    key: str
    settings: dict[str, Any]
    inputs: dict[str, str]  # name to sha256
    outputs: dict[str, str]  # path relative to the session, to sha256
    counts: dict[str, Any]
    warnings: list[str]


def key_of(stage: Stage, settings: Mapping[str, object], inputs: Mapping[str, str]) -> str:
    """Compute the SHA-256 of everything that determines a stage's result: equal keys, equal bytes."""
    ingredients = {
        "stage": stage.name,
        "revision": stage.revision,
        "settings": settings,
        "inputs": inputs,
    }
    return hash_of(ingredients)


def outdated(records: Mapping[str, StageRecord], recorded: Mapping[str, str]) -> list[str]:
    """The stages, by name, of which something that they were made of has changed since.

    Args:
        records: the finished stages of a session, by name. Inputs that none of them made do not count.
        recorded: the hashes of the recordings that were ingested (`Description.recorded`).
    """
    made = {**recorded, **{stage: record.key for stage, record in records.items()}}
    for record in records.values():
        made |= record.outputs
    return [
        stage
        for stage, record in records.items()
        if stage != "ingest"
        and any(made.get(name, digest) != digest for name, digest in record.inputs.items())
    ]


def read_record(path: Path) -> StageRecord:
    """Read a `stage.json`.

    Raises:
        DataError: it is damaged or of a later version.
    """
    remedy = "run the stage again with --force"
    document = read_json(path, remedy)
    refuse_newer(path, document, remedy)
    kinds = {
        "stage": str,
        "revision": int,
        "key": str,
        "settings": dict,
        "inputs": dict,
        "outputs": dict,
        "counts": dict,
        "warnings": list,
    }
    wrong = [name for name, kind in kinds.items() if not isinstance(document.get(name), kind)]
    if wrong:
        raise DataError(path, f"has no usable {', '.join(wrong)}", remedy)
    return StageRecord(**{name: document[name] for name in kinds})


def usable_record(path: Path) -> StageRecord | None:
    """Read a `stage.json`; return None if it is missing or damaged.

    Raises:
        NewerSchemaError: it is of a later version.
    """
    try:
        return read_record(path) if path.exists() else None
    except NewerSchemaError:
        raise
    except DataError:
        return None


def refuse_newer(path: Path, document: Mapping[str, Any], remedy: str) -> None:
    """Refuse, with a DataError, a file of a later version or without a version."""
    schema = document.get("schema")
    if not isinstance(schema, int):
        raise DataError(path, f"states no schema number (schema: {schema!r})", remedy, code="damaged")
    if schema > SCHEMA:
        raise NewerSchemaError(
            path, f"has schema {schema}, this version reads up to {SCHEMA}", "update mocap to read it"
        )


_LIBRARIES = (
    *("numpy", "scipy", "numba", "pandas", "pyarrow", "matplotlib"),
    *("opencv-python-headless", "av", "ai-edge-litert", "onnxruntime", "pycolmap", "mcap", "rosbags"),
)
"""The libraries on which results depend; those that are installed are noted."""


@dataclass(frozen=True)
class Stopwatch:
    """A clock that starts when a run begins."""

    started: datetime = field(default_factory=lambda: datetime.now(UTC))
    started_s: float = field(default_factory=time.monotonic)

    def note(self, session: Path, stage: str) -> None:
        """Add the run, which ends now, to the session's run.json."""
        entry = {
            "stage": stage,
            "started": self.started.isoformat(timespec="seconds"),
            "seconds": round(time.monotonic() - self.started_s, 3),
            "version": version("mocap-pipeline"),
            "libraries": _libraries(),
            "platform": platform.platform(),
        }
        _write(session, {"runs": [*_runs(session), entry]})


def versions_of(folder: Path) -> dict[str, dict[str, str]]:
    """Return the versions of mocap, Python and libraries with which each stage last ran, from run.json."""
    versions: dict[str, dict[str, str]] = {}
    for run in _runs(folder):
        versions[str(run.get("stage"))] = {"mocap": str(run.get("version")), **run.get("libraries", {})}
    return versions


def note_sources(session: Path, hashes: Mapping[str, str], stamps: Mapping[str, str]) -> None:
    """Note in run.json each source's content hash with its stamp; both mappings are by the source's name."""
    noted = {name: {"sha256": digest, "stamp": stamps[name]} for name, digest in hashes.items()}
    if noted != _read(session).get("sources"):
        _write(session, {"sources": noted})


def noted_stamps(session: Path, hashes: Mapping[str, str]) -> dict[str, str]:
    """Return the noted stamps of the sources whose hashes are unchanged; empty without a usable run.json."""
    try:
        noted = _read(session).get("sources")
    except DataError:
        return {}
    if not isinstance(noted, dict):
        return {}
    return {
        name: noted[name].get("stamp", "")
        for name, digest in hashes.items()
        if isinstance(noted.get(name), dict) and noted[name].get("sha256") == digest
    }


def _runs(session: Path) -> list[dict[str, Any]]:
    runs: list[dict[str, Any]] = _read(session).get("runs", [])
    return runs


def _read(session: Path) -> dict[str, Any]:
    path = session / "run.json"
    remedy = "remove it: it holds only times of day"
    return read_json(path, remedy) if path.exists() else {}


def _write(session: Path, changes: Mapping[str, object]) -> None:
    write_json(session / "run.json", {**_read(session), "schema": SCHEMA, **changes})


@cache
def _libraries() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
