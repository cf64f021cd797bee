"""Names for the sessions of several flights that share a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipelines.session.errors import DataError

_USUAL = "flight"


def names_of(paths: Sequence[Path]) -> list[str]:
    """Return a name for each flight or session, which does not depend on the others.

    The name is that of the file without its ending. Most manifests are called `flight`; these get the name
    of the folder around them.

    Raises:
        DataError: two have the same name.
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
