"""`mocap replan-sweep` on a short simulated flight: table, trade-off, resumption and refusals."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from mocap_cli.main import Mocap
from mocap_cli.replan_sweep import replan_sweep_command
from pipelines.planning.comparison import capped_mm
from pipelines.replan import fly_and_measure
from tests.commands.test_replan import CALM, session_of

GRID = ("--radius", "8,12", "--drones", "2,3", "--trials", "4")


def run(*arguments: str | Path) -> Result:
    group = Mocap("mocap", commands=[replan_sweep_command])
    return CliRunner().invoke(group, ["replan-sweep", *map(str, arguments)])


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    noisy = CALM + "  pose_noise: {white: {position_m: 0.02, rotation_deg: 0.5}}\n"
    return session_of(tmp_path_factory.mktemp("calm"), noisy)


def test_an_interrupted_sweep_goes_on_and_ranks_what_is_known(
    calm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of attitude grow with range, and three views are better than two; a way has its drones."""
    flown: list[str] = []

    def flying(*arguments: object) -> None:
        if len(flown) == 3:
            raise KeyboardInterrupt
        fly_and_measure(*arguments)  # type: ignore[arg-type]
        flown.append(str(arguments[-1]))

    monkeypatch.setattr("pipelines.sweep.fly_and_measure", flying)
    assert run(calm, *GRID).exit_code == 130
    assert not (calm / "sweep").exists()
    flown[:] = [""]  # three more are allowed: one is left
    done = run(calm, *GRID, "--json")
    assert done.exit_code == 0, done.stderr
    assert len(flown) == 2
    metrics = json.loads(done.stdout)
    cells = {(cell["radius_m"], cell["drones"]): cell for cell in metrics["cells"]}
    assert list(cells) == [(8, 2), (8, 3), (12, 2), (12, 3)]
    error = {name: cell["capped_mm"] for name, cell in cells.items()}
    assert error[8, 3] < min(error[8, 2], error[12, 3])
    assert error[12, 2] > max(error[8, 2], error[12, 3])
    assert [name for name, cell in cells.items() if cell["best"]] == [(8, 3)]
    assert cells[8, 3]["tradeoff"]
    assert cells[8, 3]["path_m"] > 1.2 * cells[8, 2]["path_m"]
    with (calm / "sweep" / "table.csv").open(encoding="utf-8") as file:
        assert [float(row["capped_mm"]) for row in csv.DictReader(file)] == list(error.values())
    drawn = (calm / "sweep" / "tradeoff.svg").read_bytes()
    assert b"<svg" in drawn
    assert "unchanged" in run(calm, *GRID).output
    assert (calm / "sweep" / "tradeoff.svg").read_bytes() == drawn


def test_bad_lists_and_arms_are_refused(calm: Path) -> None:
    for usage in (("--radius", "8,x"), ("--tilt", "99"), ("--drones", "1"), ("--radius", "nan")):
        assert run(calm, *usage).exit_code == 2, usage
    many = ("--radius", ",".join(str(k) for k in range(1, 252)), "--drones", "2,3")
    for wrong in (("--arms", "flown"), many):
        done = run(calm, *wrong)
        assert done.exit_code == 1, wrong
        assert done.stderr.strip().count("\n") == 0, wrong


def test_the_capped_error_counts_what_is_missing() -> None:
    error = np.array([[[0.05, 0.4]], [[np.nan, 0.15]]], dtype=np.float32)
    assert capped_mm(error, 2) == pytest.approx([100.0, 150.0], rel=1e-6)
    assert capped_mm(error, 4) == pytest.approx([125.0, 150.0], rel=1e-6)
