"""session.json of a foreign session: it may only hold names that flight.yaml may hold."""

import json
from pathlib import Path
from typing import Any

import pytest

from pipelines.ingest import ingest
from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from tests.commands.runner import refused
from tests.synthetic.flights import write_flight


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ingest(write_flight(tmp_path_factory.mktemp("flight"), seconds=0.2).manifest).folder


def renamed(document: dict[str, Any], name: str) -> None:
    document["cameras"][name] = document["cameras"].pop("drone1")
    document["clock_reference"] = name
    document["truth"]["cameras"] = []


@pytest.mark.parametrize("name", ["../../other", "..", "a/b", "a\\b", "/other", "", "x" * 65, "DRONE2"])
def test_a_camera_that_names_no_folder_of_its_own_is_refused(session: Path, name: str) -> None:
    changed(session, lambda document: renamed(document, name), "camera")


@pytest.mark.parametrize("key", ["clock_reference", "plan", "truth"])
def test_what_names_no_camera_is_refused(session: Path, key: str) -> None:
    def change(document: dict[str, Any]) -> None:
        document["clock_reference"] = "../x" if key == "clock_reference" else "drone1"
        document["plan"] = {"../x": {"source": "", "count": 1, "dropped": {}}} if key == "plan" else None
        document["truth"]["cameras"] = ["../x"] if key == "truth" else []

    changed(session, change, "'../x' is no camera of this flight")


def changed(session: Path, change: Any, problem: str) -> None:
    """Change session.json, check that it is refused, and restore it."""
    path = session / "session.json"
    kept = path.read_bytes()
    document = json.loads(kept)
    change(document)
    try:
        path.write_text(json.dumps(document), encoding="utf-8")
        with pytest.raises(DataError) as told:
            read_description(session)
        assert told.value.source == path
        assert problem in str(told.value)
        assert problem in refused("export", session, "--to", "tum")
    finally:
        path.write_bytes(kept)


def test_names_that_flight_yaml_may_have_are_read(session: Path) -> None:
    path = session / "session.json"
    kept = path.read_bytes()
    document = json.loads(kept)
    renamed(document, "A_b-9")
    path.write_text(json.dumps(document), encoding="utf-8")
    assert list(read_description(session).cameras) == ["drone2", "A_b-9"]
    path.write_bytes(kept)
