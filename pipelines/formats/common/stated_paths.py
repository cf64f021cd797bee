"""Check of paths that files state: a relative path must not lead out of the file's own folder."""

from __future__ import annotations

import os
from pathlib import Path


def leads_out(stated: str) -> bool:
    """Return True if a relative path leads out of its folder; links may, as a file cannot bring any."""
    return Path(os.path.normpath(stated)).parts[:1] == (os.pardir,)
