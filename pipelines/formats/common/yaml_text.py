"""Safe reading of other tools' YAML: plain mappings, lists and numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.formats.common.text_tables import read_text
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.yaml_files import plain_yaml

_LARGEST = 1 << 20  # characters; the parser is slow, and calibrations are far smaller


def read_yaml(path: Path) -> dict[str, object]:
    """Read the mapping at the top of a YAML file, built of plain types only.

    The first line `%YAML:1.0` of old OpenCV and Kalibr files, which is no YAML, is skipped.

    Raises:
        DataError: unreadable, larger than a megabyte, no valid YAML, or no mapping of names.
    """
    text = read_text(path)
    if len(text) > _LARGEST:
        raise DataError(path, f"has {len(text)} characters", f"a calibration has less than {_LARGEST}")
    if text.startswith("%YAML:"):
        text = "#" + text
    value = plain_yaml(path, text)
    if not isinstance(value, dict):
        raise DataError(path, "is no YAML mapping of names to values", "write it again")
    return {str(key): item for key, item in value.items()}


def numbers(source: Path, name: str, value: object) -> Float:
    """Return a list of numbers as an array [N]; `name` is for the message if it is none.

    Raises:
        DataError: not a list, or an element is not a number.
    """
    if not isinstance(value, list) or not all(
        isinstance(cell, int | float) and not isinstance(cell, bool) for cell in value
    ):
        raise DataError(source, f"{name} is no list of numbers", "write it again")
    return np.array(value, dtype=np.float64)
