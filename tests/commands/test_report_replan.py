"""The report shows the comparison of planners that lies in the session."""

from __future__ import annotations

import json
import re
from html import unescape
from pathlib import Path

import pytest

from pipelines.study import study
from tests.commands.runner import succeeds

SCENARIO = """
schema: 1
name: Past a mound
duration_s: 2
actor: {motion: [walk: {distance_m: 3}]}
world:
  ground: {size_m: 50}
  mounds: [{centre: [0, 9], sigma_m: [2, 2], height_m: 6}]
  map: {resolution_m: 0.5, height_m: 8}
drones: {count: 2, formation: {yaw_deg: 45}}
"""


@pytest.mark.slow
def test_the_report_shows_the_comparison_of_the_session(tmp_path: Path) -> None:
    (tmp_path / "scenario.yaml").write_text(SCENARIO, encoding="utf-8")
    succeeds("simulate", tmp_path / "scenario.yaml", "-o", tmp_path / "flight", "--no-video")
    succeeds("ingest", tmp_path / "flight" / "flight.yaml")
    session = tmp_path / "flight" / "flight.session"
    page = session / "report" / "index.html"
    succeeds("report", session)
    assert 'id="replan"' not in page.read_text(encoding="utf-8")

    succeeds("replan-compare", session, "--trials", "2")
    succeeds("report", session)
    shown = page.read_text(encoding="utf-8")
    metrics = json.loads((session / "replan" / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["verdict"][1:] in unescape(shown)
    assert all(f'id="figure-arms-{key}"' in shown for key in ("top", "time", "yaw"))
    # Figures that are computed from the tables agree with the metrics.
    told = re.search(r'id="figure-arms-time-desc">(.*?)</desc>', shown)
    assert told is not None
    for arm in ("adaptive", "fixed", "joint", "flown"):
        scores = metrics["arms"][arm]
        mean, largest, least = scores["tilt_deg"]["mean"], scores["tilt_deg"]["max"], scores["range_m"]["min"]
        said = re.search(rf"\b{arm}: (.*?)(?= [a-z]+: |$)", told.group(1))
        assert said is not None
        stated = [round(value, 1) for value in (mean, largest, least)]
        assert [float(number) for number in re.findall(r"\d+\.\d", said.group(1))[:3]] == stated
    # Of the mound of 6 m, 4 m are exceeded and 8 m are not.
    assert "above 4 m" in shown
    assert "above 8 m" not in shown
    assert re.search(r"[1-9]\d* voxels", shown)
    first = page.read_bytes()
    succeeds("report", session, "--force")
    assert page.read_bytes() == first

    succeeds("replan-compare", session, "--trials", "2", "--arms", "adaptive,fixed")
    studied = session.with_name("ranges")
    verdict = study(["range_m=8,10", "trials=2"], session, studied).metrics["verdict"]
    succeeds("report", session, "--study", studied)
    assert 'dir="auto">flown</th>' in shown
    shown = unescape(page.read_text(encoding="utf-8"))
    assert 'dir="auto">flown</th>' not in shown
    assert verdict[1:] in shown
    assert 'id="figure-study-1"' in shown
