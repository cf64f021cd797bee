"""The report shows the comparison of planners that lies in the session, and a study beside it."""

from html import unescape
from pathlib import Path

import pytest

from pipelines.session.storage import read_json
from pipelines.study import study
from tests.commands.runner import succeeds

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
