"""Parallel parts: results are in order, and one failure ends the others."""

from threading import Barrier

import pytest

from pipelines.session.progress import Halt, side_by_side


def test_a_failure_ends_the_others() -> None:
    halt, together = Halt(), Barrier(2, timeout=10)
    stopped: list[int] = []

    def work(part: int) -> None:
        together.wait()
        if part == 0:
            raise ValueError(part)
        while True:  # for ever, unless it is asked to stop
            try:
                halt.check()
            except InterruptedError:
                stopped.append(part)
                raise

    with pytest.raises(ValueError, match=r"^0$"):
        side_by_side(work, range(2), workers=2, halt=halt)
    assert stopped == [1]
