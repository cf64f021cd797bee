"""`mocap info`: descriptions of mocap's own files and folders, and errors of others."""

import re
from pathlib import Path
from typing import Any

from pipelines.session.storage import read_json, write_json
from tests.commands.runner import ingested, refused, result_of, succeeds
from tests.keypoints.spotted_flights import CAMERAS, spot_detector, write_spotted_flight
from tests.synthetic.flights import write_flight

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


def test_a_study_tells_the_error_of_every_condition(tmp_path: Path) -> None:
    words = (
        "tilt_deg=0,30",
        "noise=low",
        "method=dlt",
        "seconds=4",
        "rate_hz=5",
        "trials=1",
        "keypoints=exact",
    )
    succeeds("study", *words, "-o", tmp_path / "study")
    facts = reading(tmp_path / "study")
    cells = read_json(tmp_path / "study" / "metrics.json")["cells"]
    assert facts["kind"].startswith("study")
    assert facts["study"] == " ".join(words)
    assert [list(errors.values()) for errors in facts["mpjpe_mm"].values()] == [
        [cell["metrics"]["mpjpe_mm"]["mean"]] for cell in cells
    ]
    for tilt, condition in zip((0, 30), facts["mpjpe_mm"], strict=True):
        assert re.fullmatch(rf"{tilt} deg, 2 \w+, \w+ low", condition)


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
