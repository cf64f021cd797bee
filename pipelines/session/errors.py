"""The errors that a user can cause or correct. Each is one line: which file, what is wrong, what to do.

The command line prints the line and exits 1. Any other exception that escapes is a bug of this program.
"""

from pathlib import Path


class MocapError(Exception):
    """Root of every error that is reported as one line instead of a traceback."""


class DataError(MocapError):
    """Input that cannot be used.

    Args:
        source: the file, folder or setting at fault.
        problem: what is wrong with it, with the numbers involved.
        remedy: what the user can do about it; empty only where the problem already says it.
    """

    def __init__(self, source: Path | str, problem: str, remedy: str = "") -> None:
        self.source = source
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{source}: {problem}" + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type["DataError"], tuple[Path | str, str, str]]:
        """Pickle it by its arguments, because it travels between processes."""
        return type(self), (self.source, self.problem, self.remedy)


class NoPositionsError(DataError):
    """A log holds no position; its attitudes may be of use all the same."""


class NoViewsError(DataError):
    """At no time do two cameras have pictures and a pose."""


class BusyError(MocapError):
    """Another process is writing the session."""
