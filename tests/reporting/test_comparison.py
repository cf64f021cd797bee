"""Sessions side by side: differences that are known in closed form, and the page that shows them."""

import io
from dataclasses import replace
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest

from pipelines.geometry.metrics import RESAMPLES, STRETCH_S
from pipelines.reporting.content import SessionContent
from pipelines.reporting.session_comparison import (
    compare,
    draw_comparison,
    labels_of,
    lead,
    render_comparison,
)

from .conftest import JOINTS, OFFSET_M, make_skeleton, make_truth
from .reading import Outline, numbers, plain

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


def test_labels_are_as_long_as_they_must_be() -> None:
    assert labels_of([("x", "monday"), ("x", "tuesday")]) == ["monday", "tuesday"]
    assert labels_of([("x", "monday", "flight"), ("x", "tuesday", "flight")]) == [
        "monday/flight",
        "tuesday/flight",
    ]
    assert labels_of([("flight",), ("x", "flight")]) == ["flight", "x/flight"]
