"""Parts of a flight side by side: their results, their errors, and what a worker refuses."""

import os
import signal
from dataclasses import replace
from pathlib import Path
from threading import Barrier

import pytest

from pipelines.detect import Block, _DetectionOrder, detect_block
from pipelines.session.errors import DataError
from pipelines.session.parallel import SharedSession, each_part
from pipelines.session.progress import Halt, side_by_side
from pipelines.session.registries import find_detector, hashes_of_models
from tests.commands.runner import succeeds
from tests.keypoints.spotted_flights import spot_detector
from tests.raising import refused
from tests.synthetic.flights import write_flight


def work(part: int) -> tuple[int, int]:
    """Return the square and the process; negative parts fail or kill their process."""
    if part == -1:
        raise DataError(Path("part"), "is wrong", code="damaged")
    if part == -2:
        os.kill(os.getpid(), signal.SIGKILL)
    return part * part, os.getpid()


def test_parts_are_worked_on_by_other_processes() -> None:
    found = dict(each_part(work, range(4), workers=2))
    assert {number: square for number, (square, _) in found.items()} == {k: k * k for k in range(4)}
    assert os.getpid() not in {process for _, process in found.values()}
    alone = dict(each_part(work, range(4), workers=1))
    assert {process for _, process in alone.values()} == {os.getpid()}
    assert list(each_part(work, [], workers=2)) == []


@pytest.mark.parametrize(("part", "code"), [(-1, "damaged"), (-2, "worker-lost")])
def test_a_part_that_fails_is_an_error_here(part: int, code: str) -> None:
    with refused(code):
        list(each_part(work, [part, part], workers=2))


def test_a_worker_refuses_another_session_another_program_and_other_models(tmp_path: Path) -> None:
    succeeds("ingest", write_flight(tmp_path, seconds=0.1).manifest)
    shared = SharedSession.at(tmp_path / "flight.session")
    assert shared.opened() == tmp_path / "flight.session"
    with refused("wrong-worker", tmp_path / "flight.session"):
        replace(shared, ingested="another key").opened()
    with refused("wrong-worker", "--scheduler"):
        replace(shared, code="0.0.0").opened()
    detector = find_detector(spot_detector(tmp_path))
    order = _DetectionOrder(shared, detector, hashes_of_models(detector), True, 1, Block("drone1", 0, 1))
    (tmp_path / "pose.onnx").write_bytes(b"another model")
    with refused("wrong-worker", detector.name):
        detect_block(order)


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
