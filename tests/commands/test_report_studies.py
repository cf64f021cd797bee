"""`mocap report --study`: a study on a session's page, only if it is requested."""

import json
import re
from html import unescape
from pathlib import Path

import pytest

from pipelines import report as stage
from pipelines.ingest import ingest
from pipelines.session.errors import DataError
from pipelines.session.storage import STUDY_MARK
from pipelines.study import study
from tests.commands.runner import content, refused, succeeds
from tests.synthetic.flights import write_flight

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


def test_a_study_in_a_session_disturbs_nothing_and_replaces_no_session(session: Path) -> None:
    """Check that `overwrite` does not replace a session either."""
    succeeds("report", session)
    study(WORDS, None, session / "study")
    assert "unchanged" in succeeds("report", session)
    succeeds("info", session)
    before = content(session)
    for place in (session, session / "report"):
        with pytest.raises(DataError) as error:
            study(WORDS, None, place, overwrite=True)
        assert error.value.source == place
    assert content(session) == before
