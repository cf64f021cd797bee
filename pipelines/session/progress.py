"""Progress of long work, and parallel work on its parts; an error or Ctrl-C soon ends all of them.

The terminal's bar is one implementation of progress, silence another.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Protocol, TypeVar


class Progress(Protocol):
    """The interface by which a stage reports its progress."""

    def start(self, task: str, total: int) -> None:
        """Begin a task of `total` steps; this ends the previous task."""

    def advance(self, steps: int = 1) -> None:
        """Report that `steps` more steps are done."""

    def note(self, message: str) -> None:
        """Report a choice, a finding or a doubt to the user."""


class Silent:
    """Progress without output (notebooks, tests)."""

    def start(self, task: str, total: int) -> None:
        """Ignore it."""

    def advance(self, steps: int = 1) -> None:
        """Ignore it."""

    def note(self, message: str) -> None:
        """Ignore it."""


T = TypeVar("T")
R = TypeVar("R")


class Halt:
    """A request to stop, which every worker checks from time to time."""

    def __init__(self) -> None:
        self._asked = Event()

    def ask(self) -> None:
        """Ask all workers to stop."""
        self._asked.set()

    def check(self) -> None:
        """Raise an InterruptedError if all workers are asked to stop."""
        if self._asked.is_set():
            raise InterruptedError("another part failed, or the user stopped it")


def side_by_side(work: Callable[[T], R], parts: Iterable[T], *, workers: int, halt: Halt) -> list[R]:
    """Call `work` on parts in threads, results in order; `halt`, which it checks, is set if one fails."""
    if workers == 1:
        return [work(part) for part in parts]
    with ThreadPoolExecutor(workers) as pool:
        try:
            return list(pool.map(work, parts))
        except BaseException:
            halt.ask()  # or Ctrl-C would wait for what is under way
            raise
