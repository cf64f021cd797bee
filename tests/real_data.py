"""Real recordings and networks that some tests use; where they cannot be had, those tests are skipped."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from pipelines.session.registries import find_detector
from tests.commands.runner import mocap_process

_ROOT = Path(__file__).resolve().parent.parent


def real_data(relative: str) -> Path:
    """Return the path of a real input; skip the calling test if it is absent."""
    folder = Path(os.environ.get("MOCAP_REAL_DATA", _ROOT.parent / "shared" / "data"))
    path = folder / relative
    if not path.exists():
        pytest.skip(f"real recordings are not here ({relative}); set MOCAP_REAL_DATA to their folder")
    return path


def facts(name: str) -> dict[str, Any]:
    """Return what other programs found in a real input."""
    found: dict[str, Any] = json.loads(real_data("facts.json").read_text(encoding="utf-8"))[name]
    return found


def fetch_networks(detector: str) -> None:
    """Fetch a detector's networks if they are absent; skip the calling test if that fails."""
    if None in find_detector(detector).models().values():
        fetched = mocap_process("models", "fetch", detector, timeout=300)
        if fetched.returncode:
            pytest.skip(f"the networks of {detector} cannot be fetched here: {fetched.stderr.strip()}")
