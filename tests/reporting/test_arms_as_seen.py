"""The skeleton as arms see it: the moments shown, the hidden joints, and the numbers of the figure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from pipelines.reporting.arms import Replan, draw_arms, moments, summarise_replan

from .comparisons import DRONES, HIDDEN_S, make_comparison
from .conftest import START_NS
from .reading import numbers

JOINTS = {"left_shoulder": (40, 0), "right_shoulder": (0, 0), "left_hip": (40, 100), "right_hip": (0, 100)}
LOOKS_S = np.arange(11)


def make_seen(arm: str) -> pd.DataFrame:
    """Make four joints once a second.

    drone1 of `fixed` sees none in its hidden stretch, `flown` loses a hip.
    """
    rows = []
    for t_s in LOOKS_S.tolist():
        for camera in DRONES:
            for joint, (x, y) in JOINTS.items():
                hidden = arm == "fixed" and camera == "drone1" and HIDDEN_S[0] <= t_s < HIDDEN_S[1]
                lost = arm == "flown" and joint == "left_hip"
                status = "outside" if lost else "hidden" if hidden else "seen"
                place = (np.nan, np.nan) if lost else (600.0 + x, 300.0 + y)
                rows.append((START_NS + t_s * 10**9, camera, joint, *place, status))
    return pd.DataFrame(rows, columns=["t_ns", "camera", "joint", "x", "y", "status"])


@pytest.fixture(scope="module")
def compared() -> Replan:
    content = make_comparison()
    return summarise_replan(replace(content, seen={arm: make_seen(arm) for arm in content.arms}), START_NS, 2)


def test_moments_are_those_at_which_the_arms_differ_most(compared: Replan) -> None:
    """Hidden at 2 and 3 s; where nothing is lost, the tilt of `fixed` and `flown` rises by 1 deg/s."""
    looks = [(arm, arm.seen) for arm in compared.arms if arm.seen is not None]
    assert moments(looks).tolist() == [2, 3, 8, 10]


def test_the_figure_says_what_is_lost(compared: Replan) -> None:
    plate = draw_arms(compared)["arms-seen"]
    said = dict(sentence.split(":") for sentence in plate.description.rstrip(".").split(". "))
    # Joints and looks; then seen, hidden and outside.
    assert numbers(said["adaptive"]) == [88, 11, 88, 0, 0]
    assert numbers(said["fixed"]) == [88, 11, 80, 8, 0]
    assert numbers(said["flown"]) == [88, 11, 66, 0, 22]
    # Two of the four moments, at drone1 of `fixed`; every panel of `flown` lacks a hip.
    assert plate.svg.count(">0 of 4<") == 2
    assert plate.svg.count(">3 of 4<") == 8
    assert ">drone1, 17\u202fdeg<" in plate.svg  # fixed at 2 s: 15 + 2
    table = plate.numbers[""]
    assert len(table) == 3 * 88
    hidden = table[table["status"] == "hidden"]
    assert set(hidden["arm"]) == {"fixed"}
    assert sorted(set(hidden["t_s"])) == [2, 3]
    assert table.loc[table["status"] == "outside", "x_px"].isna().all()
