"""When stages ran, for how long and with what: `run.json`, the one file that differs from run to run."""

from __future__ import annotations

import platform
import time
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pipelines.session.stage_records import SCHEMA
from pipelines.session.storage import read_json, write_json

_LIBRARIES = (
    *("numpy", "scipy", "numba", "pandas", "pyarrow", "matplotlib"),
    *("opencv-python-headless", "av", "ai-edge-litert", "onnxruntime", "pycolmap", "mcap", "rosbags"),
)
"""What results rest on, as far as it is installed."""


@dataclass(frozen=True)
class Stopwatch:
    """Started when a run begins."""

    started: datetime = field(default_factory=lambda: datetime.now(UTC))
    started_s: float = field(default_factory=time.monotonic)

    def note(self, session: Path, stage: str) -> None:
        """Add the run that ends now to the session's run.json."""
        entry = {
            "stage": stage,
            "started": self.started.isoformat(timespec="seconds"),
            "seconds": round(time.monotonic() - self.started_s, 3),
            "version": version("mocap-pipeline"),
            "libraries": _libraries(),
            "platform": platform.platform(),
        }
        write_json(session / "run.json", {"schema": SCHEMA, "runs": [*_runs(session), entry]})


def versions_of(folder: Path) -> dict[str, dict[str, str]]:
    """With which mocap, Python and libraries each stage of a session last ran, as far as run.json says."""
    told: dict[str, dict[str, str]] = {}
    for run in _runs(folder):
        told[str(run.get("stage"))] = {"mocap": str(run.get("version")), **run.get("libraries", {})}
    return told


def _runs(session: Path) -> list[dict[str, Any]]:
    path = session / "run.json"
    told = read_json(path, "remove it: it holds only times of day") if path.exists() else {}
    runs: list[dict[str, Any]] = told.get("runs", [])
    return runs


@cache
def _libraries() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
