"""Progress of long work. The terminal's bar is one implementation, silence another."""

from __future__ import annotations

from typing import Protocol


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
