"""How long work says where it is. The terminal's bar is one implementation, silence another."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """What a stage needs of whoever watches it."""

    def start(self, task: str, total: int) -> None:
        """Begin a task of `total` steps; the one before it is finished."""

    def advance(self, steps: int = 1) -> None:
        """Say that `steps` more are done."""

    def note(self, message: str) -> None:
        """Say something worth knowing: what was chosen, found or doubted."""


class Silent:
    """Progress that nobody watches (notebooks, tests)."""

    def start(self, task: str, total: int) -> None:
        """Ignore it."""

    def advance(self, steps: int = 1) -> None:
        """Ignore it."""

    def note(self, message: str) -> None:
        """Ignore it."""
