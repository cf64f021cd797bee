"""The figures of a comparison show the values of its tables."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from pipelines.reporting.arms import (
    KEYFRAMES,
    Replan,
    draw_arms,
    draw_from_above,
    summarise_replan,
)
from pipelines.reporting.chart import Plate

from .comparisons import make_comparison
from .conftest import START_NS
from .reading import numbers


@pytest.fixture(scope="module")
def compared() -> Replan:
    return summarise_replan(make_comparison(), START_NS, 2)


@pytest.fixture(scope="module")
def plates(compared: Replan) -> dict[str, Plate]:
    return draw_arms(compared)


def _told(plate: Plate) -> dict[str, list[float]]:
    """Return the numbers of each arm's sentence in a figure's description, by arm."""
    found = re.search(r"<desc[^>]*>(.*?)</desc>", plate.svg)
    assert found is not None
    sentences = re.split(r"\. (?=[a-z]+:)", found.group(1))
    return {said.partition(":")[0]: numbers(said) for said in sentences}


def test_descriptions_state_the_numbers_of_the_tables(plates: dict[str, Plate]) -> None:
    assert list(plates) == ["arms-top", "arms-time", "arms-yaw"]
    over_time = _told(plates["arms-time"])
    assert over_time["adaptive"][:2] == [15.0, 15.0]  # tilt in deg: mean and largest
    # 15 deg + 1 deg/s over 10 s; 10 m away; hidden for 100 of 501 moments, one of two drones; 50 cm.
    assert over_time["fixed"] == [20.0, 25.0, 10.0, 10.0, 10.0, 50.0]
    # Keyframes at 0, 2, ... 10 s: of them 2 s alone lies in the hidden stretch. The actor goes 10 m.
    assert _told(plates["arms-top"])["fixed"][-3:] == [10.0, 1, 12]
    assert _told(plates["arms-yaw"])["adaptive"] == [45.0, 145.0, 100.0]


def _path(svg: str, colour: str, width: str) -> np.ndarray:
    """Return the points of the first line of a colour and width, [N, 2] in the drawing's units."""
    style = rf'style="[^"]*stroke: var\({colour}\)[^"]*stroke-width: {re.escape(width)}[;"]'
    for d, tag in re.findall(r'<path d="([^"]*)"([^>]*)>', svg):
        if re.search(style, tag) and "fill: none" in tag:
            return np.array(re.findall(r"[-\d.]+", d), dtype=np.float64).reshape(-1, 2)
    raise AssertionError(f"no line of {colour} and {width}")


def _ticks(svg: str, axis: str) -> dict[float, float]:
    """Return the positions of the numbers beside an axis, by number."""
    anchor = {"x": "middle", "y": "end"}[axis]
    found = re.findall(
        rf'<text style="font-size: 7.2px; text-anchor: {anchor}[^"]*"'
        r' x="([\d.]+)" y="([\d.]+)">(−?[\d.]+)</text>',
        svg,
    )
    return {float(value.replace("−", "-")): float(x if axis == "x" else y) for x, y, value in found}


def test_the_line_of_the_yaw_rises_as_commanded(plates: dict[str, Plate]) -> None:
    svg = plates["arms-yaw"].svg
    turned, kept = _path(svg, "--camera-2", "1.6"), _path(svg, "--camera-3", "1.6")
    up, along = _ticks(svg, "y"), _ticks(svg, "x")
    deg_per_unit = 90 / (up[90] - up[180])
    s_per_unit = 10 / (along[10] - along[0])
    # Both ends and both numbers are rounded to 0.01 units: at 2 deg a unit, 0.04 deg.
    assert (turned[0, 1] - turned[-1, 1]) * deg_per_unit == pytest.approx(100, abs=0.05)
    assert (turned[-1, 0] - turned[0, 0]) * s_per_unit == pytest.approx(10, abs=0.01)
    assert np.ptp(kept[:, 1]) == 0
    assert kept[0, 1] == turned[0, 1]


def test_hidden_sight_lines_are_told_apart(plates: dict[str, Plate]) -> None:
    svg = plates["arms-top"].svg
    # One sight line, and the key that explains it.
    assert svg.count("stroke: var(--status-rejected)") == 2
    content = make_comparison("adaptive", "flown")
    clear = draw_arms(summarise_replan(content, START_NS, 2))["arms-top"].svg
    assert "--status-rejected" not in clear


def test_heights_of_the_map_are_shaded_as_far_as_they_go(plates: dict[str, Plate]) -> None:
    # 4.5 m: above 0.5, 1, 2 and 4 m; 8 m is not reached.
    svg = plates["arms-top"].svg
    assert [f"above {m:g} m" in svg for m in (0.5, 1, 2, 4, 8)] == [True] * 4 + [False]
    assert numbers(plates["arms-top"].caption) == [KEYFRAMES, 0.5]  # the ground is at 0.5 m
    bare = draw_arms(summarise_replan(replace(make_comparison(), map=None), START_NS, 2))["arms-top"]
    assert "above 0.5 m" not in bare.svg
    assert "map" not in bare.caption


def test_no_fly_zones_are_hatched_and_named() -> None:
    content = make_comparison()
    zone = {"name": "school", "polygon_m": [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]], "low_m": None, "high_m": 9.0}
    drawn, bare = (
        draw_from_above(summarise_replan(replace(content, metrics=content.metrics | zones), START_NS, 2))
        for zones in ({"zones": [zone]}, {})
    )
    assert "school" in drawn.caption
    assert drawn.svg.count("<pattern") == bare.svg.count("<pattern") + 1
    assert drawn.svg.count("url(#") >= bare.svg.count("url(#") + len(content.arms)
    assert "no-fly" not in bare.svg + bare.caption


def test_the_same_comparison_gives_the_same_bytes(compared: Replan, plates: dict[str, Plate]) -> None:
    again = draw_arms(compared)
    assert {key: plate.svg for key, plate in again.items()} == {k: p.svg for k, p in plates.items()}
    assert [plate.caption for plate in again.values()] == [plate.caption for plate in plates.values()]
    for plate in plates.values():
        assert not re.search(r"#[0-9a-f]{6}\b", "".join(re.findall(r"<[^>]+>", plate.svg)))
