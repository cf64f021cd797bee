"""Several flights or sessions for one command, or a pattern that the shell did not expand."""

import json
from pathlib import Path

import pytest

from tests.commands.runner import content, mocap, refused, succeeds
from tests.synthetic.flights import write_flight


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make two flights, and a damaged one between them."""
    made = tmp_path_factory.mktemp("several")
    for k, name in enumerate(("friday", "monday")):
        write_flight(made / name, seconds=0.2, seed=k)
    (made / "lost").mkdir()
    (made / "lost" / "flight.yaml").write_text("schema: 1\nname: [", encoding="utf-8")
    return made


def test_one_that_fails_stops_none_of_the_others(folder: Path, tmp_path: Path) -> None:
    done = mocap("ingest", folder / "*" / "flight.yaml", "-o", tmp_path, "--json")
    assert done.returncode == 1
    line, count = done.stderr.strip().splitlines()
    assert line.startswith(f"mocap: {folder}/lost/flight.yaml")
    assert count == "mocap: 1 of 3 failed"
    told = json.loads(done.stdout)
    assert list(told["results"]) == [f"{folder}/{name}/flight.yaml" for name in ("friday", "monday")]
    assert told["failed"] == {f"{folder}/lost/flight.yaml": line.removeprefix("mocap: ")}

    sessions = [tmp_path / f"{name}.session" for name in ("friday", "monday")]
    printed = succeeds("reconstruct", tmp_path / "*.session", "--method", "dlt")
    assert [f"{session}:" in printed and f"written: {session}" in printed for session in sessions] == [
        True
    ] * 2
    assert "unchanged" in succeeds("reconstruct", sessions[1], "--method", "dlt")  # as one alone
    (tmp_path / "no.session").mkdir()
    for command in (["reconstruct"], ["replan-compare"], ["export", "--to", "csv", "-o", tmp_path / "out"]):
        done = mocap(*command, tmp_path / "no.session", sessions[0])
        assert done.returncode == 1, command
        assert f"mocap: {tmp_path}/no.session: " in done.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["friday.export"]
    assert "friday.export/Test_flight.csv" in content(tmp_path / "out")


def test_output_of_several_is_a_folder_around_them(folder: Path, tmp_path: Path) -> None:
    flights = [folder / name / "flight.yaml" for name in ("friday", "monday")]
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert f"{tmp_path}/file: " in refused("ingest", *flights, "-o", tmp_path / "file")
    succeeds("ingest", flights[0], "-o", tmp_path / "one.session")
    before = content(tmp_path / "one.session")
    assert f"{tmp_path}/one.session: " in refused("ingest", *flights, "-o", tmp_path / "one.session")
    assert content(tmp_path / "one.session") == before
    assert refused("ingest", folder / "*.yml").startswith(f"mocap: {folder}/*.yml: ")
