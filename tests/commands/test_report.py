"""`mocap report`: figures, comparisons of planners and studies on the page of a session."""

import json
import re
from html import unescape
from pathlib import Path

import pytest

from pipelines import report as stage
from pipelines.ingest import ingest
from pipelines.reporting import chart
from pipelines.session.storage import STUDY_MARK, read_json
from pipelines.study import study
from tests.commands.runner import content, refused, succeeds
from tests.synthetic.flights import write_flight


@pytest.mark.slow
def test_figures_of_a_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # One kind of file is enough here; tests/reporting/test_figures.py has them all.
    monkeypatch.setattr(chart, "_FILE_METADATA", {"svg": {"Date": None}})
    session, figures = tmp_path / "robust.session", tmp_path / "figures"
    ingest(write_flight(tmp_path, seconds=0.5).manifest, session=session)
    succeeds("reconstruct", session, "--method", "robust")
    assert f"written: {figures}" in succeeds("report", session, "--figures", figures)
    told = read_json(figures / "figures.json")
    assert list(told["sessions"]) == ["robust"]
    assert {"top", "time", "joints"} <= {each["figure"] for each in told["figures"]}
    assert f"unchanged: {figures}" in succeeds("report", session, "--figures", figures)
    (figures / "notes.txt").write_text("mine")
    assert "notes.txt" in refused("report", session, "--figures", figures)
    assert "is a session" in refused("report", session, "--figures", session)


SCENARIO = """
schema: 1
name: Past a mound
duration_s: 1.5
actor: {motion: [walk: {distance_m: 2}]}
world:
  ground: {size_m: 30}
  mounds: [{centre: [0, 9], sigma_m: [2, 2], height_m: 6}]
  map: {resolution_m: 1, height_m: 8}
drones: {count: 2, formation: {yaw_deg: 45}}
"""


@pytest.mark.slow
def test_the_report_shows_the_comparison_of_the_session(tmp_path: Path) -> None:
    (tmp_path / "scenario.yaml").write_text(SCENARIO, encoding="utf-8")
    succeeds("simulate", tmp_path / "scenario.yaml", "-o", tmp_path / "flight", "--no-video")
    succeeds("ingest", tmp_path / "flight" / "flight.yaml")
    session = tmp_path / "flight" / "flight.session"
    page = session / "report" / "index.html"
    succeeds("replan-compare", session, "--trials", "2", "--arms", "fixed,flown")
    succeeds("report", session)
    shown = page.read_text(encoding="utf-8")
    metrics = read_json(session / "replan" / "metrics.json")
    assert metrics["verdict"][1:] in unescape(shown)
    assert all(f'id="figure-arms-{key}"' in shown for key in ("top", "time"))
    # Figures that are computed from the tables agree with the metrics.
    tilt = metrics["arms"]["fixed"]["tilt_deg"]["mean"]
    assert f'<td class="n">{tilt:.1f}</td>' in shown
    first = page.read_bytes()
    succeeds("report", session, "--force")
    assert page.read_bytes() == first
    studied = session.with_name("ranges")
    verdict = study(["range_m=8,10", "arm=fixed", "trials=2"], session, studied).metrics["verdict"]
    succeeds("report", session, "--study", studied)
    shown = unescape(page.read_text(encoding="utf-8"))
    assert verdict[1:] in shown
    assert 'id="figure-study-1"' in shown


WORDS = ("robots=2,3", "noise=none,low", "method=dlt", "seconds=4", "rate_hz=5", "trials=2")


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Ingest a flight; studies run without their figure, which takes longer than these small ones."""
    monkeypatch.setattr("pipelines.study.draw", lambda *_: None)
    flight = write_flight(tmp_path, seconds=0.5)
    ingest(flight.manifest, session=tmp_path / "flight.session")
    return tmp_path / "flight.session"


def test_a_study_is_on_the_page_until_it_is_made_again_without(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = session / "report" / "index.html"
    succeeds("report", session)
    plain = page.read_bytes()
    folder = tmp_path / "two <b>drones"
    metrics = study(WORDS, None, folder).metrics
    drawn: list[str] = []
    monkeypatch.setattr(
        stage, "write_figures", lambda _, figures, *__: drawn.extend(each.key for each in figures)
    )
    succeeds("report", session, "--study", folder, "--figures", tmp_path / "figures")
    assert "study-1" in drawn
    shown = page.read_text(encoding="utf-8")
    assert 'id="figure-study-1"' in shown
    assert f"mocap study {' '.join(WORDS)} -o 'two <b>drones'" in unescape(shown)
    assert "<b>drones" not in shown
    worst = metrics["cells"][-1]["metrics"]["mpjpe_mm"]["mean"]
    assert f">{worst:.1f}<small>" in shown
    assert "unchanged" in succeeds("report", session, "--study", folder)
    assert succeeds("report", session).startswith("written")
    assert page.read_bytes() == plain


def test_what_is_no_study_gets_one_line(session: Path, tmp_path: Path) -> None:
    before = content(session)
    for place in (tmp_path / "nowhere", session):
        assert re.search(rf"{place.name}: .*\b{STUDY_MARK}", refused("report", session, "--study", place))
    folder = tmp_path / "study"
    folder.mkdir()
    (folder / STUDY_MARK).write_text("{}", encoding="utf-8")
    for text in ("{", "[]", "{}", json.dumps({"kind": "walk", "command": [], "cells": []})):
        (folder / "metrics.json").write_text(text, encoding="utf-8")
        assert "metrics.json" in refused("report", session, "--study", folder)
    assert content(session) == before
