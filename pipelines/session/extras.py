"""Import of optional libraries; where one is missing, the error gives the command that installs it."""

from __future__ import annotations

import re
import warnings
from importlib import import_module
from importlib.metadata import requires
from typing import Any

from pipelines.session.errors import DataError

_OF_EXTRA = re.compile(r"(?P<requirement>[^;]+?)\s*;\s*extra == ['\"](?P<extra>[^'\"]+)['\"]")


def need(module: str, extra: str) -> Any:
    """Import an optional library.

    Args:
        module: the name of the module.
        extra: the extra of this package that lists it.

    Raises:
        DataError: it is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # SWIG's wrappers deprecate themselves
            return import_module(module)
    except ImportError as error:
        raise DataError(module, "is not installed", f"run `{install_command(extra)}`") from error


def install_command(extra: str) -> str:
    """Write the command that installs the libraries of an extra, by their own names.

    This package is on no package index, so pip would not find `mocap-pipeline[extra]`.
    """
    listed = [_OF_EXTRA.fullmatch(line) for line in requires("mocap-pipeline") or ()]
    names = [found["requirement"] for found in listed if found and found["extra"] == extra]
    if not names:
        raise ValueError(f"mocap-pipeline has no extra {extra!r}")
    return " ".join(["pip install", *(f'"{name}"' for name in sorted(names))])
