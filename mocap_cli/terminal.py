"""Output to the terminal: progress and notes on stderr, results on stdout.

Everything that commands print goes through this module. Names and texts in files come from others. Characters
in them that could control the terminal or start a new line are replaced by visible ones.
"""

from __future__ import annotations

import json
import logging
import shlex
import sys
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID

    from pipelines.session.progress import Progress

# A longer line hides what was printed before it.
MAX_LINE_CHARACTERS = 2000
# Terminals are at least so wide; a longer line of a table would be broken anywhere.
TERMINAL_COLUMNS = 100


def one_line(text: str) -> str:
    """Remove line breaks and control characters from a text: names in files must not control a terminal."""
    printable = "".join(c if c.isprintable() else " " for c in text)
    shown = " ".join(printable.split())
    return shown if len(shown) <= MAX_LINE_CHARACTERS else shown[:MAX_LINE_CHARACTERS] + " ..."


def say(text: str = "", *, err: bool = False) -> None:
    """Print one line; control characters, line breaks and bytes that are no text become question marks.

    Copies of what lies in an object store are called by its URL.
    """
    if "/mocap/stores/" in text:
        from pipelines.session.urls import as_urls

        text = as_urls(text)
    click.echo("".join(c if _is_shown(c) else "?" for c in text), err=err)


def _is_shown(c: str) -> bool:
    """Test if a character is text or a space of any width, and no control, direction mark or line break."""
    return c.isprintable() or unicodedata.category(c) == "Zs"


class _Notes:
    """Progress without bars: notes only, and none at all when quiet."""

    def __init__(self, verbosity: int) -> None:
        self._verbosity = verbosity

    def start(self, task: str, total: int) -> None:
        if self._verbosity > 0:
            say(f"{one_line(task)} ({total})", err=True)

    def advance(self, steps: int = 1) -> None:
        """Do nothing: there is no bar."""

    def note(self, message: str) -> None:
        if self._verbosity >= 0:
            say(one_line(message), err=True)


class _BarsOnStderr(_Notes):
    """Progress as one bar for each task."""

    def __init__(self, verbosity: int, bars: Bars) -> None:
        super().__init__(verbosity)
        self._bars = bars
        self._task: TaskID | None = None

    def start(self, task: str, total: int) -> None:
        from rich.markup import escape

        self._task = self._bars.add_task(escape(one_line(task)), total=total)

    def advance(self, steps: int = 1) -> None:
        if self._task is not None:
            self._bars.advance(self._task, steps)

    def note(self, message: str) -> None:
        if self._verbosity >= 0:
            self._bars.console.print(one_line(message), markup=False, highlight=False)


@contextmanager
def watching(verbosity: int) -> Iterator[Progress]:
    """Make the progress of a stage: bars if stderr is a terminal, else notes; nothing with -q."""
    if verbosity < 0 or not sys.stderr.isatty():
        notes = _Notes(verbosity)
        with _noting_compilation(notes):
            yield notes
        return
    from rich.console import Console
    from rich.progress import Progress as Bars

    with Bars(console=Console(stderr=True), transient=True) as bars:
        shown = _BarsOnStderr(verbosity, bars)
        with _noting_compilation(shown):
            yield shown


class _Noting(logging.Handler):
    """Handler that turns records into notes."""

    def __init__(self, notes: _Notes) -> None:
        super().__init__()
        self._notes = notes

    def emit(self, record: logging.LogRecord) -> None:
        self._notes.note(record.getMessage())


@contextmanager
def _noting_compilation(notes: _Notes) -> Iterator[None]:
    """Note what `pipelines.geometry.compilation` logs; by its name, because the module imports numba."""
    logger = logging.getLogger("pipelines.geometry.compilation")
    handler = _Noting(notes)
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def say_next(command: str, place: Path | str, quiet: bool) -> None:
    """Print the next command of the user's way, as the last line; `{}` in it stands for a path."""
    if quiet:
        return
    held = click.get_current_context().meta.get(_HELD)
    if held is None:
        say(f"next: {command.format(shlex.quote(str(place)))}")
    else:
        held.setdefault(command, []).append(shlex.quote(str(place)))


def after_page(session: Path) -> str:
    """Return the command that follows when one has looked at a session, as its page says."""
    from pipelines.session.storage import read_json

    metrics = session / "reconstruct" / "metrics.json"
    if not metrics.is_file():
        return "mocap reconstruct {}"
    verdict = read_json(metrics).get("verdict")
    follows = str(verdict.get("next", "")) if isinstance(verdict, dict) else ""
    return follows if follows.startswith("mocap check") else "mocap export {} --to trc,angles"


_HELD = "mocap.next"


@contextmanager
def next_once() -> Iterator[None]:
    """Hold back next commands; at the end print the one that most of them are, with all their paths."""
    held: dict[str, list[str]] = {}
    click.get_current_context().meta[_HELD] = held
    yield
    if held:
        command, places = max(held.items(), key=lambda item: len(item[1]))
        say(f"next: {command.format(' '.join(places))}")


def say_warnings(warnings: Sequence[str], quiet: bool) -> None:
    """Print warnings on stderr, unless quiet."""
    if not quiet:
        for warning in warnings:
            say(f"warning: {one_line(warning)}", err=True)


def print_json(result: Mapping[str, object]) -> None:
    """Print the machine-readable result; unprintable characters are escaped, so that no data are lost."""
    text = json.dumps(result, indent=2, ensure_ascii=False, allow_nan=False)
    click.echo("".join(c if _is_shown(c) or c == "\n" else json.dumps(c)[1:-1] for c in text))


def print_table(header: Sequence[str], rows: Sequence[Sequence[object]], *, names: int = 1) -> None:
    """Print a plain table: text aligned left, numbers right, `-` for a missing value.

    A table wider than a terminal is printed in parts below each other, each with the first `names` columns.
    A text in the last column stays where it is.
    """
    texts = [[_cell(value) for value in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(header, *texts, strict=True)]
    numeric = [
        all(isinstance(row[k], int | float | None) for row in rows) if rows else False
        for k in range(len(header))
    ]
    parts, used = [list(range(names))], sum(widths[:names]) + 2 * names
    for k, width in enumerate(widths[names:], start=names):
        is_open = k == len(widths) - 1 and not numeric[k]  # a text at the end, such as a path, may be long
        if used + width > TERMINAL_COLUMNS and len(parts[-1]) > names and not is_open:
            parts.append(list(range(names)))
            used = sum(widths[:names]) + 2 * names
        parts[-1].append(k)
        used += width + 2
    for number, part in enumerate(parts):
        if number:
            say()
        for line in [list(header), *texts]:
            cells = [line[k].rjust(widths[k]) if numeric[k] else line[k].ljust(widths[k]) for k in part]
            say("  ".join(cells).rstrip())


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.1f}"
    return one_line(str(value))
