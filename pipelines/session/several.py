"""Several flights at once: what their sessions are called when they share a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipelines.session.errors import DataError

_USUAL = "flight"


def names_of(paths: Sequence[Path]) -> list[str]:
    """A name for each flight or session, which does not depend on the others.

    It is that of the file without its ending. Where that is `flight`, as most manifests are called, it is
    that of the folder around it.

    Raises:
        DataError: two are called alike.
    """
    named: dict[str, Path] = {}
    for path in paths:
        name = _name_of(path)
        if name in named:
            raise DataError(
                path,
                f"would be called {name}, as {named[name]} is",
                "leave --output out, or rename one of them",
            )
        named[name] = path
    return list(named)


def _name_of(path: Path) -> str:
    whole = path.resolve()
    return whole.stem if whole.stem != _USUAL else whole.parent.name
