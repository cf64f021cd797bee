"""Parts of a stage worked on at once, so that an error or Ctrl-C ends all of them soon."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


class Halt:
    """What everybody who works on a part looks at now and then."""

    def __init__(self) -> None:
        self._asked = Event()

    def ask(self) -> None:
        """Have everybody stop."""
        self._asked.set()

    def check(self) -> None:
        """Go on, unless everybody is to stop.

        Raises:
            InterruptedError: they are.
        """
        if self._asked.is_set():
            raise InterruptedError("another part failed, or the user stopped it")


def side_by_side(work: Callable[[T], R], parts: Iterable[T], *, workers: int, halt: Halt) -> list[R]:
    """What `work` makes of every part, in their order; threads, since what takes long leaves the interpreter.

    Args:
        work: looks at `halt` now and then.
        parts: handed to it.
        workers: how many at once.
        halt: asked for when one fails or the user interrupts; the exception is raised when all have stopped.
    """
    with ThreadPoolExecutor(workers) as pool:
        try:
            return list(pool.map(work, parts))
        except BaseException:
            halt.ask()  # or Ctrl-C would wait for what is under way
            raise
