"""Names of exported files."""

from __future__ import annotations

import re


def safe_file_name(name: str) -> str:
    """A recording's free-text name as part of a file name: letters, digits, dot, dash, underscore."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._")[:80] or "recording"
