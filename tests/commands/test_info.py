"""Several flights for one command, lines for terminals, and the commands `models` and `info`."""

import json
import re
import tarfile
import unicodedata
from pathlib import Path
from typing import Any

import pytest

from mocap_cli.terminal import say
from pipelines.session.storage import write_json
from tests.commands.runner import content, ingested, mocap, refused, result_of, succeeds
from tests.keypoints.spotted_flights import CAMERAS, spot_detector, write_spotted_flight
from tests.synthetic.flights import write_flight


@pytest.fixture(scope="module")
def flights_of_two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make two flights, and a damaged one between them."""
    made = tmp_path_factory.mktemp("several")
    for k, name in enumerate(("friday", "monday")):
        write_flight(made / name, seconds=0.2, seed=k)
    (made / "lost").mkdir()
    (made / "lost" / "flight.yaml").write_text("schema: 1\nname: [", encoding="utf-8")
    return made


def test_one_that_fails_stops_none_of_the_others(flights_of_two: Path, tmp_path: Path) -> None:
    done = mocap("ingest", flights_of_two / "*" / "flight.yaml", "-o", tmp_path, "--json")
    assert done.returncode == 1
    line, count = done.stderr.strip().splitlines()
    assert line.startswith(f"mocap: {flights_of_two}/lost/flight.yaml")
    assert count == "mocap: 1 of 3 failed"
    told = json.loads(done.stdout)
    assert list(told["results"]) == [f"{flights_of_two}/{name}/flight.yaml" for name in ("friday", "monday")]
    assert told["failed"] == {f"{flights_of_two}/lost/flight.yaml": line.removeprefix("mocap: ")}

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


def test_output_of_several_is_a_folder_around_them(flights_of_two: Path, tmp_path: Path) -> None:
    flights = [flights_of_two / name / "flight.yaml" for name in ("friday", "monday")]
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert f"{tmp_path}/file: " in refused("ingest", *flights, "-o", tmp_path / "file")
    succeeds("ingest", flights[0], "-o", tmp_path / "one.session")
    before = content(tmp_path / "one.session")
    assert f"{tmp_path}/one.session: " in refused("ingest", *flights, "-o", tmp_path / "one.session")
    assert content(tmp_path / "one.session") == before
    assert refused("ingest", flights_of_two / "*.yml").startswith(f"mocap: {flights_of_two}/*.yml: ")


# A colour, the same by one byte of C1, a title with BEL, reversed reading order, new or forged lines.
EVIL = ["\x1b[31m", "\x9b31m", "\x1b]0;t\x07", "\u202e", "\r", "\nmocap: all is well", "\x7f", "\u2028"]
STEERING = {"Cc", "Cf", "Zl", "Zp", "Cs"}


def steering(text: str) -> set[str]:
    """Find the characters of a text that could control a terminal, except ends of lines."""
    return {c for c in text.replace("\n", "") if unicodedata.category(c) in STEERING}


@pytest.mark.parametrize("evil", EVIL)
def test_a_line_stays_one_line_that_steers_nothing(evil: str, capsys: pytest.CaptureFixture[str]) -> None:
    say(f"  written: a{evil}b  c\u00a0d\u3000e \u00e9\u4e2d")
    printed = capsys.readouterr().out
    assert printed.count("\n") == 1
    assert not steering(printed)
    assert printed.startswith("  written: a?")
    assert printed.endswith("b  c\u00a0d\u3000e \u00e9\u4e2d\n")


def test_usage_errors_are_clicks_own_otherwise() -> None:
    alone = mocap()
    assert alone.returncode == 2
    assert alone.stderr.strip() == succeeds("--help").strip()
    wrong = mocap("reconstruct", "a.session", "--persons", "0")
    assert wrong.returncode == 2
    assert " reconstruct [OPTIONS] SESSION" in wrong.stderr.splitlines()[0]
    assert "'--persons': '0' " in wrong.stderr


def test_every_command_that_names_files(tmp_path: Path) -> None:
    forged = "mocap: all is well"
    folder = tmp_path / f"a\x1b[31m\n{forged}"
    flight = write_flight(folder, seconds=0.3)
    flight.settings["name"] = "Fly\x1b[2Jing\x9b"
    flight.save()
    session = folder / "flight.session"
    commands: list[tuple[str | Path, ...]] = [
        ("ingest", flight.manifest),
        ("reconstruct", session),
        ("export", session, "--to", "csv"),
        ("export", session, "--to", "csv"),
        ("report", session),
        ("info", flight.manifest),
        ("info", session, flight.manifest),
        ("init", folder, "-o", folder / "draft.yaml"),
        ("ingest", folder / "none.yaml"),
        ("reconstruct", session, folder, "-q"),
        ("reconstruct", session, f"--no\x1b[31m{folder}"),
        (f"no\x1b[31m{folder}",),
    ]
    for command in commands:
        done = mocap(*command)
        printed = done.stdout + done.stderr
        assert printed, command
        assert not steering(printed), (command, printed)
        assert forged not in printed.splitlines(), command
        assert "Traceback" not in printed


FILES = ("pose_detection.tflite", "pose_landmark_full.tflite")
HEAVY = "pose_landmark_heavy.tflite"


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set an empty cache of models, and no network for pip."""
    monkeypatch.setenv("MOCAP_MODELS", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    return tmp_path / "cache"


def test_what_is_missing_is_listed_with_the_command_that_gets_it(empty_cache: Path) -> None:
    listed = succeeds("models")
    for file in (*FILES, HEAVY):
        assert file in listed
    for name in ("blazepose", "blazepose-heavy"):
        assert f"`mocap models fetch {name}`" in listed
    detectors = result_of("models")["detectors"]
    assert {d["name"]: d["files"] for d in detectors} == {
        "blazepose": dict.fromkeys(FILES),
        "blazepose-heavy": dict.fromkeys((FILES[0], HEAVY)),
    }


def test_what_is_there_is_listed_with_its_place(empty_cache: Path) -> None:
    (empty_cache / "blazepose").mkdir(parents=True)
    for file in FILES:
        (empty_cache / "blazepose" / file).touch()
    listed = succeeds("models")
    assert str(empty_cache / "blazepose" / FILES[0]) in listed
    assert [line.split()[3] for line in listed.splitlines() if line.endswith("missing")] == [HEAVY]


def test_fetching_without_a_network_says_what_to_do(empty_cache: Path) -> None:
    line = refused("models", "fetch", "blazepose")
    assert "could not be downloaded" in line
    assert "--from" in line


def test_heavy_without_npm_says_what_to_do(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(empty_cache))
    line = refused("models", "fetch", "blazepose-heavy")
    for part in ("npm", "--from", HEAVY):
        assert part in line
    assert not empty_cache.exists()


def test_heavy_from_a_tarball_of_something_else_is_refused(empty_cache: Path, tmp_path: Path) -> None:
    tarball = tmp_path / "mediapipe-pose.tgz"
    tarball.write_text("not a tarball")
    assert "is no readable tarball" in refused("models", "fetch", "blazepose-heavy", "--from", tarball)
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / HEAVY).write_bytes(b"another network")
    with tarfile.open(tarball, "w:gz") as made:
        made.add(tmp_path / "package", "package")
    line = refused("models", "fetch", "blazepose-heavy", "--from", tarball)
    assert "of 27709200" in line
    assert not empty_cache.exists()


def test_fetching_an_unknown_name_lists_what_has_models(empty_cache: Path) -> None:
    line = refused("models", "fetch", "openpose2")
    assert "blazepose" in line


NAME = "A short one"
STALE = "out of date"  # a key of a stage
SCENARIO = f"""
schema: 1
name: {NAME}
seed: 5
duration_s: 0.5
actor: {{start: [0, 0], motion: [{{stand: {{seconds: 1}}}}]}}
drones: {{count: 3}}
"""


def reading(path: Path) -> dict[str, Any]:
    facts = result_of("info", path)["readings"]
    assert len(facts) == 1
    return dict(facts[0])


def test_yaml_is_what_its_keys_say(tmp_path: Path) -> None:
    scenario = tmp_path / "a.yaml"
    scenario.write_text(SCENARIO)
    facts = reading(scenario)
    assert (facts["kind"], facts["seed"], facts["drones"]["count"]) == ("scenario", 5, 3)
    scenario.write_text(SCENARIO.replace("seed: 5", "sead: 5"))
    line = refused("info", scenario)
    assert "sead: " in line
    assert "'seed'" in line
    planner = tmp_path / "planner.yaml"
    planner.write_text("radius_m: 12\nw_obs: 2\n")
    described = reading(planner)
    assert described.pop("kind").startswith("planner")
    assert described == {"radius_m": 12, "w_obs": 2}
    planner.write_text("radius_m: 12\nw_obs: -2\n")
    assert "w_obs" in refused("info", planner)
    for text in ("schema: 1\nname: of what?\n", "services: {web: {image: nginx}}\n"):
        planner.write_text(text)
        line = refused("info", planner)
        assert "planner.yaml: " in line
        assert all(key in line for key in ("YAML", "`cameras:`", "`drones:`", "`w_obs:`"))


def test_a_simulated_flight_and_its_summary(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(SCENARIO)
    folder = tmp_path / "flight"
    succeeds("simulate", tmp_path / "a.yaml", "-o", folder, "--no-video")
    for path in (folder, folder / "simulation.json"):
        facts = reading(path)
        assert "simulated" in facts["kind"]
        assert (facts["name"], facts["seed"]) == (NAME, 5)
        assert set(facts["frames"]) == {"drone1", "drone2", "drone3"}
    write_json(folder / "simulation.json", {"schema": 2, "simulated": True})
    assert re.search(r"simulation\.json: .*\b2\b.*\b1\b", refused("info", folder))
    write_json(folder / "simulation.json", {"schema": 1, "simulated": True})
    assert "simulation.json: " in refused("info", folder)
    (folder / "simulation.json").write_text('{"schema": 1,')
    assert re.search(r"simulation\.json: .*\bJSON\b", refused("info", folder / "simulation.json"))


def test_a_stage_whose_data_changed_is_out_of_date(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, seconds=0.4)
    session = flight.manifest.with_suffix(".session")
    succeeds("ingest", flight.manifest)
    succeeds("reconstruct", session, "--method", "robust")
    assert STALE not in reading(session)["reconstruct"]
    flight.settings["cameras"]["drone2"]["clock"] = {"offset_s": 0.01}
    flight.save()
    succeeds("ingest", flight.manifest)
    assert reading(session)["reconstruct"][STALE]
    changed = "The inputs of reconstruct have changed since: run it again."
    succeeds("report", session)
    page = session / "report" / "index.html"
    assert changed in page.read_text(encoding="utf-8")
    succeeds("reconstruct", session, "--method", "robust")
    assert STALE not in reading(session)["reconstruct"]
    succeeds("report", session)
    assert changed not in page.read_text(encoding="utf-8")


def test_detections_of_a_session_are_the_imported_or_the_found_ones(tmp_path: Path) -> None:
    manifest = write_spotted_flight(tmp_path, 6)
    session = manifest.with_suffix(".session")

    def detections() -> dict[str, int | None]:
        return {name: camera["detections"] for name, camera in reading(session)["cameras"].items()}

    succeeds("ingest", manifest)
    assert detections() == dict.fromkeys(CAMERAS)  # no detection has run yet: None, not 0
    succeeds("reconstruct", session, "--method", "robust", "--detector", spot_detector(tmp_path))
    assert detections() == dict.fromkeys(CAMERAS, 6)  # one person in each of the pictures
    flight = write_flight(tmp_path / "imported", seconds=0.2, clean=True)
    session = ingested(flight)
    assert detections() == {"drone1": 6, "drone2": 6}
