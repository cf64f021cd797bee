"""Run times of stages, the library versions they ran with, and the stamps of sources.

All of it is in `run.json`, the only file that differs from run to run.
"""

from __future__ import annotations

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
from pipelines.session.stage_records import SCHEMA
from pipelines.session.storage import read_json, write_json

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
    told: dict[str, dict[str, str]] = {}
    for run in _runs(folder):
        told[str(run.get("stage"))] = {"mocap": str(run.get("version")), **run.get("libraries", {})}
    return told


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
