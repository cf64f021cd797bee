"""Libraries that come with an extra of the package: asked for where they are needed, and by name."""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import Any

from pipelines.session.errors import DataError


def need(module: str, extra: str) -> Any:
    """An optional library.

    Args:
        module: what is imported.
        extra: the extra of the package that brings it.

    Raises:
        DataError: it is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # SWIG's wrappers deprecate themselves
            return import_module(module)
    except ImportError as error:
        raise DataError(module, "is not installed", f'run `pip install "mocap-pipeline[{extra}]"`') from error
