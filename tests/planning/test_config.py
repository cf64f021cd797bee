"""Settings from mappings: accepted values, and refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipelines.planning.config import PlannerConfig, Zone, planner_config
from pipelines.planning.formation import yaw_set
from pipelines.planning.search import lattice
from pipelines.session.errors import DataError


def test_what_is_not_mentioned_keeps_its_default() -> None:
    config = planner_config({"radius_m": 8, "yaws": 16.0, "tilts_deg": [10, 20]})
    assert config == PlannerConfig(radius_m=8.0, yaws=16, tilts_deg=(10.0, 20.0))
    assert planner_config({}) == PlannerConfig()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"radus_m": 8}, r"unknown key 'radus_m' \(did you mean 'radius_m'\?\)"),
        ({"radius_m": "wide"}, "radius_m: 'wide' is no number"),
        ({"l_obs": True}, "l_obs: True is no number"),
        ({"l_obs": float("nan")}, "l_obs: nan is no number"),
        ({"yaws": 7.5}, "yaws: 7.5 is no whole number"),
        ({"yaws": 1000}, "yaws: 1000 is more than 360"),
        ({"ranges_m": 8}, "ranges_m: must be a list"),
        ({"ranges_m": []}, "ranges_m: needs at least one"),
        ({"radius_m": 0}, "radius_m: 0 is out of range"),
        ({"l_occ": -1}, "l_occ: -1 is out of range"),
        ({"tilt_deg": 88}, "at most 85"),
        ({"soft_separation_m": 2.0}, "soft_separation_m"),
        ({"yaw_frame": "body"}, "yaw_frame: 'body' is none of world, heading"),
        ({"yaw_frame": 1}, "yaw_frame: 1 is none of world, heading"),
        ({"zones": {"box": []}}, "zones: must be a list"),
        ({"zones": [{"name": "roof"}]}, "zones: zone 1: must have either"),
        ({"zones": [{"box": [[0, 0, 0], [5, 5, 0]]}]}, "zone 1: its lowest point 0 must be below"),
        ({"zones": [{"box": [[0, 0, 0], [5, 5]]}]}, "zone 1: box must be"),
        ({"zones": [{"polygon": [[0, 0], [5, 5]]}]}, "zone 1: polygon must be"),
        ({"zones": [{"polygon": [[0, 0], [5, 5], [2, 2]]}]}, "zone 1: its corners enclose nothing"),
        ({"zones": [{"polygon": [[0, 0], [5, 5], [0, "x"]]}]}, "zone 1: 'x' is no number"),
        ({"zones": [{"polygon": [[0, 0], [5, 5], [0, 5]], "hight": 3}]}, "zone 1: unknown key 'hight'"),
    ],
)
def test_what_cannot_be_meant_is_refused(values: dict[str, object], said: str) -> None:
    with pytest.raises(DataError, match=said) as error:
        planner_config(values, "weights.yaml")
    assert error.value.source == "weights.yaml"


def test_zones_are_polygons_with_heights_or_boxes() -> None:
    polygon = {"name": "roof", "polygon": [[0, 0], [4, 0], [0, 3], [0, 0]], "heights": [None, 9]}
    zones = planner_config({"zones": [polygon, {"box": [[5, 5, 3], [1, 7, 0]]}]}).zones
    assert zones == (
        Zone(((0.0, 0.0), (4.0, 0.0), (0.0, 3.0)), None, 9.0, "roof"),  # a closed polygon is opened
        Zone(((1.0, 5.0), (5.0, 5.0), (5.0, 7.0), (1.0, 7.0)), 0.0, 3.0, "zone 2"),
    )


def test_all_unknown_keys_are_in_one_message() -> None:
    with pytest.raises(DataError, match=r"^weights.yaml: .*'a'.*'b'"):
        planner_config({"a": 1, "b": 2}, "weights.yaml")


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({}, []),
        ({"yaws": 1}, []),  # nobody expects that to turn
        ({"yaws": 16}, []),  # 22.5 deg, as far as one second allows
        ({"yaws": 15}, ["yaws: 15 cells of 24 deg"]),
        ({"yaws": 8, "knot_s": 2.0}, []),
        ({"lattice_knots": 1}, ["lattice_yaws: 8 cells of 45 deg"]),
    ],
)
def test_cells_that_no_formation_reaches_are_told(values: dict[str, Any], named: list[str]) -> None:
    config = PlannerConfig(**values)
    lines = config.out_of_reach()
    assert [line.partition(",")[0] for line in lines] == named
    # As the search has it: a cell has a neighbour beside itself, or it has not.
    for name, yaws, knot_s in (
        ("yaws", config.yaws, config.knot_s),
        ("lattice_yaws", config.lattice_yaws, config.lattice_knots * config.knot_s),
    ):
        states = np.zeros((yaws, 3))
        states[:, 0] = yaw_set(yaws, 0.0)
        neighbours = lattice(states, rates=np.array(config.slot_rates), knot_s=knot_s, w_turn=1.0).neighbours
        alone = (neighbours >= 0).sum(axis=1).max() == 1
        assert (alone and yaws > 1) == any(line.startswith(f"{name}:") for line in lines)
