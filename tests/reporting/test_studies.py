"""The page's words about a study, against metrics with chosen numbers."""

from typing import Any

from pipelines.reporting.content import StudyContent
from pipelines.reporting.studies import METRICS, draw_study, study_blocks, tables
from pipelines.reporting.wording import Table

from .test_figures import numbers_of


def estimate(mean: float, *, half: float = 0.0) -> dict[str, Any]:
    return {"mean": mean, "interval": [mean - half, mean + half] if half else None, "trials": 4}


def metrics_of(axis: str, cells: list[dict[str, Any]]) -> dict[str, Any]:
    settings = {
        "methods": list(dict.fromkeys(cell["method"] for cell in cells)),
        "seconds": 75.0,
        "trials": 4,
    }
    common = {"kind": "walk", "scenario": None, "keypoints": "modelled after blazepose"}
    return {**common, "axis": axis, "settings": settings, "cells": cells, "command": []}


def cell(mean_mm: float | None, **of: Any) -> dict[str, Any]:
    metrics = dict.fromkeys(METRICS, None) | {"reconstructed_share": estimate(0.9)}
    if mean_mm is not None:
        metrics["mpjpe_mm"] = metrics["root_mpjpe_mm"] = estimate(mean_mm, half=2.0)
    plain = {"tilt_deg": 15.0, "robots": 2, "noise": "none", "noise_model": "", "method": "dlt"}
    return {**plain, "ratio": None, "metrics": metrics, **of}


def test_a_study_of_tilt_tells_its_ends_under_the_strongest_noise() -> None:
    cells = [
        cell(k * times, tilt_deg=tilt, noise=noise, method=method, ratio=estimate(times, half=half))
        for noise, k in (("none", 30.0), ("high", 800.0))
        for tilt, times, half in ((0.0, 1.0, 0.0), (60.0, 2.0, 0.1))
        for method in ("dlt", "robust")
    ]
    metrics = metrics_of("tilt_deg", cells)
    errors, shares = tables(metrics)[0], tables(metrics)[5]
    assert (errors.names, errors.header) == (2, ["noise", "method", "0 deg", "60 deg"])
    assert errors.rows[-1] == ["high", "robust", "800.0 [798.0, 802.0]", "1600.0 [1598.0, 1602.0]"]
    assert shares.rows[0] == ["none", "dlt", "90.0", "90.0"]
    figure = draw_study("study-1", metrics)
    table = numbers_of(figure)
    assert table[(table["series"] == "high") & (table["x"] == 60)]["y"].tolist() == [1600] * 4
    assert table["low"][0] == 28
    assert "var(--level-3)" in figure.svg
    shown = [
        block
        for block in study_blocks(StudyContent(metrics, "mocap study", "abc"), figure)
        if isinstance(block, Table)
    ]
    assert shown[0].rows[-1][-1] == ("1600.0", "1598.0 to 1602.0")


def test_a_study_of_two_variables_has_a_line_for_each_value_of_the_second() -> None:
    cells = [cell(30.0 * n + t, tilt_deg=float(t), robots=n) for t in (0, 30) for n in (2, 3)]
    table = tables(metrics_of("tilt_deg", cells))[0]
    assert table.header == ["noise", "robots", "method", "0 deg", "30 deg"]
    assert [row[:3] for row in table.rows] == [["none", "2", "dlt"], ["none", "3", "dlt"]]
    assert [row[3].split()[0] for row in table.rows] == ["60.0", "90.0"]


def test_a_study_of_a_session_shows_the_tradeoff() -> None:
    def cell(range_m: float, robots: int, error_mm: float, *, best: bool, on_it: bool) -> dict[str, Any]:
        figures = dict.fromkeys(("mpjpe_mm", "pck150", "coverage", "mean_range_m", "hidden_share"), 0.5)
        figures |= dict.fromkeys(("blind_s", "energy_kj", "min_separation_m"), 1.0)
        where = {"arm": "adaptive", "range_m": range_m, "tilt_deg": 15.0, "robots": robots}
        ends = {"capped_mm": error_mm, "low_mm": error_mm - 2, "high_mm": error_mm + 2}
        way = {"path_m": 30.0 * robots, "violations": 0, "best": best, "tradeoff": on_it}
        return where | ends | figures | way

    cells = [
        cell(8.0, 2, 60.0, best=False, on_it=True),
        cell(8.0, 3, 40.0, best=True, on_it=True),
        cell(12.0, 3, 90.0, best=False, on_it=False),
    ]
    words = {"kind": "session", "varied": ["range_m", "robots"], "verdict": "best is 40 mm"}
    figure = draw_study("study-1", words | {"cells": cells, "keypoints": "modelled", "trials": 4})
    table = numbers_of(figure)
    assert table["y"].tolist() == [60, 40, 90]
    assert table["series"].tolist() == ["8 m, 2 drones", "8 m, 3 drones", "12 m, 3 drones"]
    (shown,) = tables(words | {"cells": cells})
    assert [row[-1] for row in shown.rows] == ["trade-off", "best", ""]
