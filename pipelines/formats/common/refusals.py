"""Errors that readers share: one remedy and one code for each kind."""

from pathlib import Path

from pipelines.session.errors import DataError
from pipelines.session.storage import as_data_error

AGAIN = "copy it again, or export it again"


def damaged(source: Path | str, problem: object) -> DataError:
    """Make the error of a file whose content contradicts itself; an exception of a library is quoted."""
    if isinstance(problem, OSError):
        return as_data_error(problem, Path(source))
    if not isinstance(problem, str):
        problem = f"is damaged ({' '.join(str(problem).split())[:100] or type(problem).__name__})"
    return DataError(source, problem, AGAIN, code="damaged")


def bad_value(source: Path | str, problem: str) -> DataError:
    """Make the error of a value that is not of the expected kind."""
    return DataError(source, problem, AGAIN, code="bad-value")


def empty(source: Path | str, problem: str) -> DataError:
    """Make the error of a file without content."""
    return DataError(source, problem, AGAIN, code="empty")
