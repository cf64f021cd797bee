"""`mocap report --study`: a study on a session's page, only if it is requested."""

from __future__ import annotations

import json
import re
import shutil
from html import unescape
from pathlib import Path

import pytest

from pipelines import report as stage
from pipelines.ingest import ingest
from pipelines.session.whole_folders import STUDY_MARK
from tests.commands.runner import content, refused, succeeds
from tests.synthetic.flights import write_flight

STUDY = ("--seconds", "4", "--rate", "5", "--trials", "2", "--methods", "dlt", "--levels", "none,low")


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Ingest a flight; studies run without their figure, which takes longer than these small ones."""
    monkeypatch.setattr("pipelines.ablate.draw", lambda *_: None)
    flight = write_flight(tmp_path, seconds=1.0)
    ingest(flight.manifest, session=tmp_path / "flight.session")
    return tmp_path / "flight.session"


def test_a_study_is_on_the_page_until_it_is_made_again_without(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = session / "report" / "index.html"
    succeeds("report", session)
    plain = page.read_bytes()
    folder = tmp_path / "two <b>drones"
    succeeds("ablate", "robots", "--robots", "2,3", *STUDY, "-o", folder)
    drawn: list[str] = []
    monkeypatch.setattr(stage, "write_figures", lambda _, plates, *__: drawn.extend(plates))
    succeeds("report", session, "--study", folder, "--figures", tmp_path / "figures")
    assert "study-1" in drawn
    shown = page.read_text(encoding="utf-8")
    assert 'id="figure-study-1"' in shown
    assert re.search(r"tilt 15 deg, 4 s\b", shown)
    command = "mocap ablate robots --robots 2,3 --levels none,low --methods dlt --seconds 4 --rate 5"
    assert f"{command} --trials 2 -o 'two <b>drones'" in unescape(shown)
    assert "<b>drones" not in shown
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    worst = summary["cells"][-1]["metrics"]["mpjpe_mm"]["mean"]
    assert f">{worst:.1f}<small>" in shown
    stated = json.loads((session / "report" / "stage.json").read_text(encoding="utf-8"))["settings"]
    assert stated["studies"][0]["command"].startswith(command)
    assert "unchanged" in succeeds("report", session, "--study", folder)
    assert succeeds("report", session).startswith("written")
    assert page.read_bytes() == plain


def test_what_is_no_study_gets_one_line(session: Path, tmp_path: Path) -> None:
    before = content(session)
    for place in (tmp_path / "nowhere", session):
        assert re.search(rf"{place.name}: .*\b{STUDY_MARK}", refused("report", session, "--study", place))
    folder = tmp_path / "study"
    folder.mkdir()
    for text in ("{", "[]", "{}", '{"study": "tilt", "settings": {}, "cells": []}', '{"settings": 3}'):
        (folder / "summary.json").write_text(text, encoding="utf-8")
        assert STUDY_MARK in refused("report", session, "--study", folder)
    assert content(session) == before


def test_a_study_in_a_session_disturbs_nothing_and_replaces_no_session(session: Path) -> None:
    """Check that --overwrite does not replace a session either."""
    succeeds("report", session)
    succeeds("ablate", "robots", "--robots", "2", *STUDY, "-o", session / "study")
    assert "unchanged" in succeeds("report", session)
    page = session / "report" / "index.html"
    assert "figure-study" not in page.read_text(encoding="utf-8")
    succeeds("report", session, "--study", session / "study")
    succeeds("info", session)
    shutil.rmtree(session / "study")
    before = content(session)
    for place in (session, session / "report"):
        line = refused("ablate", "robots", *STUDY, "-o", place, "--overwrite")
        assert re.search(rf"{place.name}: .*--output", line)
    assert content(session) == before
