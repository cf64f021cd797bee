"""Sessions side by side and studies: known differences, the page that shows them, and its file."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest

import pipelines.report
from pipelines.geometry.metrics import RESAMPLES, STRETCH_S
from pipelines.report import compare_sessions
from pipelines.reporting.content import SessionContent, StudyContent
from pipelines.reporting.session_comparison import compare, draw_comparison, lead, render_comparison
from pipelines.reporting.studies import METRICS, draw_study, study_blocks, tables
from pipelines.reporting.wording import Table
from pipelines.session.errors import DataError

from .conftest import JOINTS, OFFSET_M, make_skeleton, make_truth
from .reading import Outline, numbers, plain
from .test_page import numbers_of

OFF_MM = 1000 * float(np.linalg.norm(OFFSET_M))
NORMAL_95 = 1.959964


def _moved(content: SessionContent, times: float) -> SessionContent:
    """Move the skeleton to so many times its distance from truth."""
    assert content.skeleton is not None
    extra = dict(zip("xyz", (times - 1) * OFFSET_M, strict=True))
    return replace(
        content,
        skeleton=content.skeleton.assign(**{axis: content.skeleton[axis] + d for axis, d in extra.items()}),
    )


def _later(content: SessionContent, seconds: int) -> SessionContent:
    """Return the same session at another time: another flight, by its stamps."""

    def later(table: pd.DataFrame | None) -> pd.DataFrame | None:
        return None if table is None else table.assign(t_ns=table["t_ns"] + seconds * 1_000_000_000)

    return replace(content, skeleton=later(content.skeleton), truth=later(content.truth))


def _wandering(content: SessionContent, distance_mm: np.ndarray) -> SessionContent:
    """Return one sample a second, all joints east of the truth by the distance given for each sample."""
    frames = len(distance_mm)
    skeleton, truth = make_skeleton(frames, 1.0), make_truth(frames, 1.0)
    skeleton["status"] = "ok"
    skeleton[["x", "y", "z"]] = truth[["x", "y", "z"]].to_numpy()
    skeleton["x"] += np.repeat(distance_mm, len(JOINTS)) / 1000
    return replace(content, skeleton=skeleton, truth=truth, metrics={"method": "robust"})


def _lead(contents: dict[str, SessionContent]) -> str:
    return lead(compare(contents))


def test_the_same_motion_is_compared_moment_by_moment(content: SessionContent) -> None:
    (pair,) = compare({"a": content, "b": _moved(content, 2)}).pairs
    found = pair.differences["mpjpe"]
    assert pair.by_time
    # Every joint-frame of b is as far again from the truth as that of a: there is nothing to be unsure of.
    assert found.estimate.value == pytest.approx(OFF_MM, abs=1e-6)
    assert found.estimate.interval == pytest.approx((OFF_MM, OFF_MM), abs=1e-6)
    assert found.estimate.is_clear
    assert (found.first, found.other) == pytest.approx((OFF_MM, 2 * OFF_MM))
    assert content.skeleton is not None
    assert found.pairs == int((content.skeleton["status"] == "ok").sum())
    # What does not see where the skeleton is does not differ.
    for key in ("root_mpjpe", "pa_mpjpe", "share", "reprojection"):
        assert abs(pair.differences[key].estimate.value) < 1e-6, key


def test_pairs_are_what_both_measured(content: SessionContent) -> None:
    """The second lacks a joint that errs as the others do not: its mean is lower, the paired difference 0."""
    assert content.skeleton is not None
    nose = content.skeleton["joint"] == "nose"
    worse = content.skeleton.assign(x=content.skeleton["x"] + np.where(nose, 1.0, 0.0))
    without = worse.copy()
    without.loc[nose, "status"] = "rejected"
    a, b = replace(content, skeleton=worse), replace(content, skeleton=without)
    comparison = compare({"a": a, "b": b})
    first, second = (one.estimates["mpjpe"].value for one in comparison.sessions)
    assert first > second + 40  # a metre at one of 17 joints is 59 mm, less what it was off before
    found = comparison.pairs[0].differences["mpjpe"]
    assert abs(found.estimate.value) < 1e-9
    assert not found.estimate.is_clear
    assert comparison.pairs[0].differences["share"].estimate.is_clear


def test_other_times_are_compared_by_their_means(content: SessionContent) -> None:
    other = _later(_moved(content, 2), 3600)
    (pair,) = compare({"a": content, "b": other}).pairs
    assert not pair.by_time
    found = pair.differences["mpjpe"]
    assert found.estimate.value == pytest.approx(OFF_MM, abs=1e-6)
    assert (found.first, found.other) == pytest.approx((OFF_MM, 2 * OFF_MM))


@pytest.mark.parametrize("apart", [False, True])
def test_intervals_are_those_of_known_variances(content: SessionContent, apart: bool) -> None:
    """White errors, uniform over 20 mm: the difference of two means has the variance 2 * 20^2 / 12 / T."""
    frames = 600
    draw = np.random.default_rng(7)
    first, second = (_wandering(content, draw.uniform(40, 60, frames)) for _ in range(2))
    if apart:
        second = _later(second, 3600)
    (pair,) = compare({"a": first, "b": second}).pairs
    interval = pair.differences["mpjpe"].estimate.interval
    assert pair.by_time is not apart
    assert interval is not None
    width = 2 * NORMAL_95 * np.sqrt(2 * 20**2 / 12 / frames)
    # The spread of white stretches of five samples is known to sqrt(4 * 5 / 3 / 600) / 2 = 5 %, that of 2000
    # draws to 1.5 %, their tails to 3 %: three standard deviations of all of it are 20 %.
    assert interval[1] - interval[0] == pytest.approx(width, rel=0.2)
    assert STRETCH_S == 5.0
    assert RESAMPLES == 2000


def test_verdict_names_the_better_one_and_by_how_much(content: SessionContent) -> None:
    said = _lead({"near": content, "far": _moved(content, 2)})
    assert said.startswith("“near”")  # the better one is named first
    # The errors of both in mm, and the 95 % interval of their difference.
    assert numbers(said) == [22.4, 44.7, 95, 22.4, 22.4]
    assert _lead({"far": _moved(content, 2), "near": content}).startswith("“near”")


def test_a_doubted_session_comes_before_who_is_better(content: SessionContent) -> None:
    doubt = {"code": "mount", "cameras": ["mast"], "what": "W1", "evidence": {}, "remedy": "R1"}
    doubted = replace(_moved(content, 2), metrics={**(content.metrics or {}), "doubts": [doubt]})
    said = _lead({"a": content, "b": doubted})
    assert said.startswith("“b”")
    assert said.index("W1") < said.index("“a”")


def _three(content: SessionContent) -> dict[str, SessionContent]:
    stages = {name: dict(record) for name, record in content.stages.items()}
    gates = {"method": "robust", "gates": {"pixel_sigma_px": 2.0}}
    stages["reconstruct"] |= {"key": "c3" * 32, "settings": gates}
    other = replace(content, stages=stages, metrics={"method": "dlt"})
    return {"a": _moved(content, 3), "b": _moved(content, 2), "c": other}


@pytest.fixture(scope="module")
def page(content: SessionContent) -> str:
    return render_comparison(_three(content))


def test_three_sessions_are_set_against_the_first(content: SessionContent, page: str) -> None:
    outline = Outline(page)
    assert plain(_lead(_three(content))) in outline.text
    assert "“b” less “a”" in outline.text
    assert "“c” less “a”" in outline.text
    assert outline.count("figure") == 2
    # 67.1 mm and 44.7 mm are three and two times sqrt(500) mm; every joint of the second is nearer.
    row = next(row for row in outline.rows("MPJPE, mm") if len(row) > 5)
    assert row[1:4] == ["67.1", "44.7", "−22.4 −22.4 to −22.4"]
    assert row[5:] == ["better"]


def test_figures_come_with_their_numbers(content: SessionContent, page: str) -> None:
    written = [unquote(link.split(",", 1)[1]) for link in Outline(page).links if link.startswith("data:")]
    figures = {figure.key: figure for figure in draw_comparison(compare(_three(content)))}
    assert written == [figures[f"compare-{key}"].csv for key in ("time", "joints")]
    table = pd.read_csv(io.StringIO(written[1]))
    errors = table[table["panel"].str.startswith("MPJPE") & (table["series"] == "b")]["x"]
    assert errors.mean() == pytest.approx(2 * OFF_MM)


GENERATOR = '<meta name="generator" content="mocap'


@pytest.fixture
def sessions(tmp_path: Path, content: SessionContent, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Make two folders whose contents and page are stand-ins: these tests are about files alone."""
    folders = [tmp_path / f"{name}.session" for name in ("a", "b")]
    for folder in folders:
        folder.mkdir()
    monkeypatch.setattr(pipelines.report, "content_of", lambda _: content)
    monkeypatch.setattr(
        pipelines.report, "render_comparison", lambda contents: f"{GENERATOR} {' '.join(contents)}"
    )
    return folders


def test_page_lies_beside_the_first_session(sessions: list[Path], tmp_path: Path) -> None:
    done = compare_sessions(sessions)
    page = tmp_path / "comparison" / "index.html"
    assert (done.place, done.skipped) == (page, False)
    assert done.place.read_text() == f"{GENERATOR} a b"
    assert compare_sessions(sessions).skipped
    # A page of ours is written anew.
    assert not compare_sessions(sessions[::-1]).skipped
    assert done.place.read_text() == f"{GENERATOR} b a"
    assert list(page.parent.iterdir()) == [page]


def test_nothing_foreign_is_written_over(sessions: list[Path], tmp_path: Path) -> None:
    mine = tmp_path / "thesis.html"
    mine.write_text("mine")
    with pytest.raises(DataError, match="--overwrite") as error:
        compare_sessions(sessions, mine)
    assert error.value.source == mine
    assert mine.read_text() == "mine"
    compare_sessions(sessions, mine, overwrite=True)
    assert mine.read_text().startswith(GENERATOR)
    with pytest.raises(DataError, match="--output") as error:
        compare_sessions(sessions, tmp_path, overwrite=False)
    assert error.value.source == tmp_path


def test_a_session_is_not_compared_with_itself(sessions: list[Path]) -> None:
    with pytest.raises(DataError, match="twice") as error:
        compare_sessions([sessions[0], sessions[1], sessions[0] / ".." / "a.session"])
    assert error.value.source == sessions[0]


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
    assert [row[shown.names - 1] for row in shown.rows] == ["trade-off", "best", ""]
