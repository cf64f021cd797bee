"""`mocap report --figures`: of one session, and of two that are compared."""

import shutil
from pathlib import Path

import pytest

from pipelines.ingest import ingest
from pipelines.reporting import chart
from pipelines.session.storage import read_json
from tests.commands.runner import refused, succeeds
from tests.synthetic.flights import write_flight


@pytest.mark.slow
def test_figures_of_a_session_and_of_a_comparison(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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

    other, both = tmp_path / "dlt.session", tmp_path / "both"
    shutil.copytree(session, other)
    succeeds("reconstruct", other, "--method", "dlt")
    succeeds("report", session, other, "-o", tmp_path / "page.html", "--figures", both)
    told = read_json(both / "figures.json")
    keys = [each["figure"] for each in told["figures"]]
    assert keys == ["compare-time", "compare-joints"]
    assert list(told["sessions"]) == ["robust", "dlt"]
