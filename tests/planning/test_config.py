"""Settings from mappings: accepted values, and refusals."""

import pytest

from pipelines.planning.config import SETTINGS, PlannerConfig, planner_config
from pipelines.session.errors import DataError


def test_what_is_not_mentioned_keeps_its_default() -> None:
    config = planner_config({"radius_m": 8, "ranges_m": [10, 20], "horizon_s": 7})
    assert config == PlannerConfig(radius_m=8.0, ranges_m=(10.0, 20.0), horizon_s=7.0)
    assert config.horizon_knots == 7
    assert planner_config({}) == PlannerConfig()
    assert len(SETTINGS) <= 20


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"radus_m": 8}, "'radius_m'"),
        ({"radius_m": "wide"}, "radius_m"),
        ({"l_obs": True}, "l_obs"),
        ({"l_obs": float("nan")}, "l_obs"),
        ({"horizon_s": 61}, "horizon_s"),
        ({"ranges_m": 8}, "ranges_m"),
        ({"ranges_m": []}, "ranges_m"),
        ({"radius_m": 0}, "radius_m"),
        ({"l_occ": -1}, "l_occ"),
        ({"tilt_deg": 88}, "tilt_deg"),
        ({"tuning": {}}, "tuning"),
    ],
)
def test_what_cannot_be_meant_is_refused_by_name(values: dict[str, object], named: str) -> None:
    with pytest.raises(DataError) as error:
        planner_config({**values, "unheard_of": 1}, "weights.yaml")
    assert error.value.source == "weights.yaml"
    assert named in str(error.value)
    assert "unheard_of" in str(error.value)  # all problems in one message


def test_a_yaw_rate_that_reaches_no_cell_is_warned_of() -> None:
    assert not PlannerConfig(yaw_rate_deg_per_s=11.25).out_of_reach()  # a cell of 32 a second
    assert len(PlannerConfig(yaw_rate_deg_per_s=11.0).out_of_reach()) == 1
