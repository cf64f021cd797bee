"""Paths that files state: one that is relative must not lead out of the file's own folder."""

from __future__ import annotations

import os
from pathlib import Path


def leads_out(stated: str) -> bool:
    """Whether a relative path leads out of where it begins; links, which a file cannot bring along, may."""
    return Path(os.path.normpath(stated)).parts[:1] == (os.pardir,)
