"""`mocap report --figures`: of one session, and of two that are compared."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.commands.runner import refused, succeeds

SCENARIO = """
schema: 1
name: Steps
duration_s: 1
actor: {motion: [walk: {distance_m: 2}]}
drones: {count: 2}
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    (folder / "scenario.yaml").write_text(SCENARIO, encoding="utf-8")
    succeeds("simulate", folder / "scenario.yaml", "-o", folder / "flight", "--no-video")
    succeeds("ingest", folder / "flight" / "flight.yaml", "-o", folder / "robust.session")
    succeeds("reconstruct", folder / "robust.session", "--method", "robust")
    return folder / "robust.session"


@pytest.mark.slow
def test_figures_of_a_session(session: Path, tmp_path: Path) -> None:
    figures = tmp_path / "figures"
    said = succeeds("report", session, "--figures", figures)
    assert f"written: {figures}" in said
    told = json.loads((figures / "figures.json").read_text(encoding="utf-8"))
    assert told["sessions"]["robust"] == {"flight": "Steps", "simulated": True}
    assert {"top", "time", "joints", "body"} <= {each["figure"] for each in told["figures"]}
    assert f"unchanged: {figures}" in succeeds("report", session, "--figures", figures)
    assert json.loads(succeeds("report", session, "--figures", figures, "--json"))["figures"] == str(figures)
    (figures / "notes.txt").write_text("mine")
    line = refused("report", session, "--figures", figures)
    assert re.search(rf"{figures.name}: .*\(1, \D*notes\.txt\)", line)
    assert "is a session" in refused("report", session, "--figures", session)


@pytest.mark.slow
def test_figures_of_a_comparison(session: Path, tmp_path: Path) -> None:
    other = tmp_path / "dlt.session"
    shutil.copytree(session, other)
    succeeds("reconstruct", other, "--method", "dlt")
    figures = tmp_path / "figures"
    succeeds("report", session, other, "-o", tmp_path / "page.html", "--figures", figures)
    told = json.loads((figures / "figures.json").read_text(encoding="utf-8"))
    assert [each["figure"] for each in told["figures"]] == [
        "compare-differences",
        "compare-time",
        "compare-joints",
    ]
    assert list(told["sessions"]) == ["robust", "dlt"]
