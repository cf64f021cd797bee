"""`plan:` of flight.yaml: the commands in flight as the arm `planned`."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from ruamel.yaml import YAML

from pipelines.geometry.arrays import Float
from pipelines.session.storage import read_json
from tests.commands.runner import refused, result_of, succeeds
from tests.commands.test_replan import CALM, session_of
from tests.synthetic.logged_flights import pose_entry
from tests.synthetic.logs import write_log

TILT_DEG, RANGE_M = 40.0, 8.0


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a flight of two drones at 15 deg; its planner commanded 40 deg and 8 m, east and north."""
    folder = tmp_path_factory.mktemp("planned")
    session = session_of(folder, CALM)
    flight = folder / "flight"
    t_ns, hips = true_hips(session)
    level, up = RANGE_M * np.cos(np.radians(TILT_DEG)), RANGE_M * np.sin(np.radians(TILT_DEG))
    entries = []
    for k, stamp in enumerate(t_ns.tolist()):
        at = hips[k] + [level, 0.0, up]
        entries.append(pose_entry("/drone1/setpoint", stamp, at.tolist()))
    write_log(flight, "planner", "mcap-cdr", entries)
    rows = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} {x:.6f} {y + level:.6f} {z + up:.6f} 0 0 0 1"
        for stamp, (x, y, z) in zip(t_ns.tolist(), hips.tolist(), strict=True)
    ]
    (flight / "drone2.tum").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return flight


def true_hips(session: Path) -> tuple[NDArray[np.int64], Float]:
    """Read the times and the positions of the true hips."""
    truth = pd.read_parquet(session / "truth.parquet")
    hips = truth[truth["joint"].isin(["left_hip", "right_hip"])].groupby("t_ns")[["x", "y", "z"]].mean()
    return hips.index.to_numpy(np.int64), hips.to_numpy(np.float64)


def with_plan(flight: Path, name: str, **plan: Any) -> Path:
    """Write a copy of the flight's manifest with a plan."""
    yaml = YAML(typ="safe", pure=True)
    stated = yaml.load((flight / "flight.yaml").read_text(encoding="utf-8"))
    path = flight / f"{name}.yaml"
    with path.open("w", encoding="utf-8") as file:
        yaml.dump(stated | {"plan": plan}, file)
    return path


def test_what_was_commanded_is_an_arm_like_the_others(flown: Path, tmp_path: Path) -> None:
    manifest = with_plan(
        flown,
        "planned",
        drone1={"file": "planner.mcap", "topic": "/drone1/setpoint"},
        drone2="drone2.tum",
    )
    session = tmp_path / "planned.session"
    succeeds("ingest", manifest, "-o", session)
    stored = read_json(session / "session.json")
    assert {name: entry["source"] for name, entry in stored["plan"].items()} == {
        "drone1": "planner.mcap",
        "drone2": "drone2.tum",
    }
    assert {"planner.mcap", "drone2.tum"} <= set(stored["sources"])
    table = pd.read_parquet(session / "plan.parquet")
    assert list(table.columns) == ["t_ns", "camera", "x", "y", "z"]

    metrics = result_of("replan-compare", session, "--trials", "2")
    assert list(metrics["arms"]) == ["adaptive", "fixed", "joint", "flown", "planned"]
    planned = metrics["arms"]["planned"]
    assert planned["simulated"] is False
    assert planned["reconstruction_error"]["simulated"] is True
    # Commands at the stamps of the truth and straight between them, like the hips that are scored against:
    # what is left is the micrometre to which the file states them.
    assert planned["tilt_deg"]["mean"] == pytest.approx(TILT_DEG, abs=0.01)
    assert planned["range_m"]["mean"] == pytest.approx(RANGE_M, abs=0.01)
    assert planned["yaw_separation_deg"]["mean"] == pytest.approx(90, abs=0.01)
    assert planned["limit_violations"]["collision"] == 0
    # At 40 deg the detector misses more joints than at 15: METHODS' 81 % at 45 against 97 %.
    coverage = {
        name: arm["reconstruction_error"]["coverage"]["mean"] for name, arm in metrics["arms"].items()
    }
    assert coverage["planned"] < coverage["fixed"]
    assert "planned" in [each["arm"] for each in metrics["differences"]]
    track = pd.read_parquet(session / "replan" / "planned" / "trajectories.parquet")
    assert np.degrees(track["slot_tilt_rad"]).mean() == pytest.approx(TILT_DEG, abs=0.5)


def test_one_drone_alone_and_a_gap_in_its_commands(flown: Path, tmp_path: Path) -> None:
    """Check that a gap in commands is reported, and that the path across it is straight."""
    rows = (flown / "drone2.tum").read_text(encoding="utf-8").splitlines()
    (flown / "gap.tum").write_text("\n".join([*rows[:4], *rows[-4:]]) + "\n", encoding="utf-8")
    session = tmp_path / "alone.session"
    succeeds("ingest", with_plan(flown, "alone", drone2="gap.tum"), "-o", session)
    metrics = result_of("replan-compare", session, "--arms", "planned", "--trials", "1")
    assert metrics["arms"]["planned"]["drones"] == 1
    assert any(re.search(r"^planned: \d+\.\d %", warning) for warning in metrics["warnings"])
    track = pd.read_parquet(session / "replan" / "planned" / "trajectories.parquet")
    assert set(track["camera"]) == {"drone2"}


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "no camera": ({"drone3": "drone2.tum"}, "'drone3' is no camera of this flight"),
    "no log": ({"drone1": {"file": "drone2.tum", "topic": "/a"}}, "plan.drone1: has a topic"),
    "no topic": ({"drone1": {"file": "planner.mcap", "topic": "/sent"}}, "has no topic /sent"),
    "another day": ({"drone1": "old.tum"}, "old.tum: spans 5.000 to 6.000 s, the pictures"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_plan_that_cannot_be_used_gets_one_line(flown: Path, tmp_path: Path, case: str) -> None:
    (flown / "old.tum").write_text("5.0 0 0 0 0 0 0 1\n6.0 0 0 0 0 0 0 1\n", encoding="utf-8")
    plan, said = REFUSED[case]
    assert said in refused("ingest", with_plan(flown, "bad", **plan), "-o", tmp_path / "bad.session")
