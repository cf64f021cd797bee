"""Paths of the real recordings that some tests use; a clone without them skips those tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_ROOT = Path(__file__).resolve().parent.parent


def real_data(relative: str) -> Path:
    """Return the path of a real input; skip the calling test if it is absent."""
    folder = Path(os.environ.get("MOCAP_REAL_DATA", _ROOT.parent / "shared" / "data"))
    path = folder / relative
    if not path.exists():
        pytest.skip(f"real recordings are not here ({relative}); set MOCAP_REAL_DATA to their folder")
    return path
