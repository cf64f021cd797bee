"""Sessions as workers of a cluster find them."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.detect import Block, _Order, detect_block
from pipelines.session.clusters import SharedSession
from pipelines.session.errors import DataError
from pipelines.session.registries import find_detector, hashes_of_models
from pipelines.session.stores import staged
from tests.commands.runner import content, succeeds
from tests.keypoints.spotted_flights import spot_detector
from tests.synthetic.flights import write_flight


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    succeeds("ingest", write_flight(folder, seconds=0.1).manifest)
    return folder / "flight.session"


def test_a_worker_refuses_another_session_another_program_and_other_models(
    session: Path, tmp_path: Path
) -> None:
    shared = SharedSession.at(session)
    assert shared.opened() == session
    other = replace(shared, ingested="another key")
    with pytest.raises(DataError) as raised:
        other.opened()
    assert raised.value.source == str(session)
    with pytest.raises(DataError) as raised:
        replace(shared, code="0.0.0").opened()
    assert raised.value.source == "--scheduler"

    detector = find_detector(spot_detector(tmp_path))
    order = _Order(shared, detector, hashes_of_models(detector), True, 1, Block("drone1", 0, 1), None)
    (tmp_path / "pose.onnx").write_bytes(b"another model")
    with pytest.raises(DataError) as raised:
        detect_block(order)
    assert raised.value.source == detector.name


def test_a_worker_opens_the_version_of_a_session_in_a_store(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "owner"))
    with staged(f"file://{tmp_path}/store/x.session", create=True) as copy:
        succeeds("ingest", session.parent / "flight.yaml", "-o", copy.folder)
        copy.publish()
        expected, shared = content(copy.folder), SharedSession.at(copy.folder)
        assert shared.place == copy.version
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "worker"))
        opened = pickle.loads(pickle.dumps(shared)).opened()  # noqa: S301  # our own
    assert tmp_path / "worker" in opened.parents
    assert content(opened) == expected


def test_errors_travel_between_processes_as_they_are() -> None:
    error = DataError(Path("drone1.mp4"), "is gone", "put it back")
    arrived = pickle.loads(pickle.dumps(error))  # noqa: S301  # our own
    assert (arrived.source, arrived.problem, arrived.remedy) == (error.source, error.problem, error.remedy)
    assert str(arrived) == str(error)
