"""`mocap run`: one command from a folder to the verdict."""

from pathlib import Path

import pytest

from tests.commands.runner import content, mocap, refused, result_of, succeeds
from tests.commands.test_init import write_lenses
from tests.synthetic.flights import write_flight

WHOLE = True


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the files of a flight that `init` drafts completely, without a flight.yaml."""
    flight = write_flight(tmp_path_factory.mktemp("files"), cameras=3, seconds=1.0)
    write_lenses(flight)
    flight.manifest.unlink()
    return flight.manifest.parent


def test_a_folder_goes_to_a_verdict_and_the_same_command_changes_nothing(folder: Path) -> None:
    result = result_of("run", folder)
    assert result["flight"] == str(folder / "flight.yaml")
    assert result["assumed"]
    assert result["verdict"]["grade"] in {"good", "usable", "poor"}
    low, median, high = result["verdict"]["expected_error_mm"]
    assert 0 < low < median < high
    page = Path(result["page"])
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")
    before = content(Path(result["session"]))
    last = succeeds("run", folder).splitlines()[-1]
    assert last.startswith("next: mocap ")
    assert content(Path(result["session"])) == before


def test_same_bytes_twice_and_with_one_or_two_workers(tmp_path: Path) -> None:
    sessions = []
    for place, workers in (("first", "1"), ("second", "2")):
        flight = write_flight(tmp_path / place, cameras=3, bystander=True, seconds=0.5)
        session = tmp_path / place / "flight.session"
        succeeds("ingest", flight.manifest)
        succeeds("reconstruct", session, "--method", "robust", "--workers", workers)
        succeeds("report", session)
        sessions.append(content(session))
    assert sessions[0] == sessions[1]
    assert {"session.json", "reconstruct/skeleton.parquet", "report/index.html"} <= set(sessions[0])


def test_what_only_the_user_knows_stops_it_with_the_draft_beside_the_data(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.5)
    flight.manifest.unlink()
    done = mocap("run", tmp_path)
    assert (done.returncode, done.code) == (1, "incomplete")
    assert "missing: " in flight.manifest.read_text(encoding="utf-8")
    assert not flight.manifest.with_suffix(".session").exists()


def test_a_folder_without_a_flight_is_refused(tmp_path: Path) -> None:
    refused("run", tmp_path, code="wrong-kind")
    assert mocap("run").returncode == 2
