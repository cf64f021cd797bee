"""The errors that a user can cause or correct. Each is one line: which file, what is wrong, what to do.

The command line prints the line and exits 1. Any other exception that escapes is a bug of this program.
"""

import tomllib
from pathlib import Path
from typing import Any, Literal


def read_codes(kind: Literal["errors", "doubts"]) -> dict[str, Any]:
    """Read every code: of errors with what it stands for, of doubts with the keys of flight.yaml, too."""
    content = (Path(__file__).parent / "data" / "codes.toml").read_text(encoding="utf-8")
    codes: dict[str, Any] = tomllib.loads(content)[kind]
    return codes


class MocapError(Exception):
    """Root of every error that is reported as one line; `code` is its kind, one of `read_codes`."""

    code: str = "data"


class DataError(MocapError):
    """Input that cannot be used: what is wrong with which file or setting, and what the user can do."""

    def __init__(
        self, source: Path | str, problem: str, remedy: str = "", *, code: str | None = None
    ) -> None:
        self.source = source
        self.problem = problem
        self.remedy = remedy
        if code is not None:
            self.code = code
        super().__init__(f"{source}: {problem}" + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle it by its arguments, because it travels between processes."""
        return type(self), (self.source, self.problem, self.remedy), {"code": self.code}


class NoViewsError(DataError):
    """At no time do the cameras have pictures, people and a pose."""

    code = "no-views"


class BusyError(MocapError):
    """Another process is writing the session."""

    code = "busy"
