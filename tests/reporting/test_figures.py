"""Figures: their numbers are those of the data, and their files are the same every time."""

import io
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest

from pipelines.reporting import chart, figures
from pipelines.reporting.chart import MARK, Figure, refuse_foreign, write_figures
from pipelines.reporting.content import SessionContent
from pipelines.reporting.page import draw_session
from pipelines.session.errors import DataError

from .comparisons import make_comparison
from .conftest import ASIDE_PX, CAMERAS, JOINTS, OFFSET_M, RATE_HZ

WIDTH_PX = 180 / 25.4 * 300


@pytest.fixture(scope="module")
def drawn(content: SessionContent) -> dict[str, Figure]:
    picture = np.full((540, 960, 3), (200, 90, 30), dtype=np.uint8)  # half the calibration's size, blue
    made = draw_session(replace(content, replan=make_comparison()), lambda _camera, _frame: picture)
    return {figure.key: figure for figure in made}


def numbers_of(figure: Figure) -> pd.DataFrame:
    """Return the rows of a figure's CSV."""
    return pd.read_csv(io.StringIO(figure.csv), keep_default_na=True)


def _series(figure: Figure, name: str) -> pd.DataFrame:
    table = numbers_of(figure)
    return table[table["series"] == name]


def test_numbers_are_those_of_the_session(drawn: Mapping[str, Figure]) -> None:
    assert {"timeline", "top", "time", "residuals", "sigmas", "joints", "arms-top", "arms-time"} <= set(drawn)
    measured = _series(drawn["time"], "median")["y"].dropna()
    np.testing.assert_allclose(measured, 1000 * np.linalg.norm(OFFSET_M), rtol=1e-6)
    table = numbers_of(drawn["time"])
    shares = table[table["panel"].str.startswith("joints")].groupby("x")["y"].sum()
    np.testing.assert_allclose(shares, 100.0, rtol=1e-6)
    joints = _series(drawn["joints"], "measured").set_index("row")["x"]
    assert len(joints) == len(JOINTS)
    assert joints["left wrist"] == pytest.approx(45.0)
    spans = _series(drawn["timeline"], "frames")
    assert list(spans["row"]) == list(CAMERAS)
    actor = _series(drawn["top"], "actor").dropna(subset=["x"])
    # The median of swinging joints stays near the middle, which walks at 6 m around (2, 1).
    np.testing.assert_allclose(np.hypot(actor["x"] - 2, actor["y"] - 1), 6.0, atol=0.35)


def test_numbers_of_arms_are_those_of_the_comparison(drawn: Mapping[str, Figure]) -> None:
    table = numbers_of(drawn["arms-time"])
    tilt = table[(table["panel"] == "tilt (deg)") & (table["series"] == "fixed")]
    np.testing.assert_allclose(tilt["y"], 15 + tilt["x"], atol=1e-6)  # rises by 1 deg/s
    hidden = table[table["panel"] == "time (s)"]
    assert hidden["series"].tolist() == ["fixed, drone1"]
    assert (hidden["low"].item(), hidden["high"].item()) == pytest.approx((2.0, 4.0))
    above = numbers_of(drawn["arms-top"])
    assert (above["series"] == "hidden").sum() == 2  # one line of sight
    assert above[above["series"] == "above"]["value"].max() == pytest.approx(4.5)
    svg = drawn["arms-top"].svg
    assert [f"above {m:g} m" in svg for m in (0.5, 1, 2, 4, 8)] == [True] * 4 + [False]


def test_descriptions_state_the_numbers_of_the_data(drawn: Mapping[str, Figure]) -> None:
    assert "left wrist 45" in drawn["joints"].description
    assert "fixed 15.0 to 25.0" in drawn["arms-time"].description


def test_the_skeleton_lies_over_the_pictures(drawn: Mapping[str, Figure]) -> None:
    overlay = drawn["overlay-1"]
    table = numbers_of(overlay)
    mast = table[table["panel"].str.startswith("mast")]
    found, seen = (mast[mast["series"] == name][["x", "y"]].to_numpy() for name in ("found", "reprojected"))
    aside = found - seen
    known = aside[np.isfinite(aside).all(axis=1)]
    assert len(known) > len(JOINTS) // 2
    np.testing.assert_allclose(known, np.tile(ASIDE_PX, (len(known), 1)), atol=1e-4)


@pytest.mark.slow
def test_every_figure_is_there_in_every_form(
    content: SessionContent, drawn: Mapping[str, Figure], tmp_path: Path
) -> None:
    shown = [drawn[key] for key in ("timeline", "overlay-1")]
    write_figures(tmp_path, shown, {"walk": content}, "k" * 64)
    told = json.loads((tmp_path / MARK).read_text(encoding="utf-8"))
    assert told["sessions"] == {"walk": {"flight": content.session.flight, "simulated": False}}
    listed = [name for each in told["figures"] for name in each["files"]]
    assert sorted([MARK, *listed]) == sorted(path.name for path in tmp_path.iterdir())
    for figure in shown:
        picture = cv2.imread(str(tmp_path / f"{figure.key}.png"))
        assert picture is not None
        assert picture.shape[1] == pytest.approx(WIDTH_PX, abs=1.5)
        assert (picture[0, 0] == 255).all()
        drawing = (tmp_path / f"{figure.key}.svg").read_text(encoding="utf-8")
        width_pt = ET.fromstring(drawing).get("width", "").removesuffix("pt")  # noqa: S314 - our own file
        assert float(width_pt) == pytest.approx(180 / 25.4 * 72, abs=0.01)
        document = (tmp_path / f"{figure.key}.pdf").read_bytes()
        assert document.startswith(b"%PDF-")
        assert b"/FontFile2" in document  # TrueType, as journals ask
        assert b"/Type3" not in document
        for word in (b"CreationDate", b"Producer", b"Matplotlib", b"<dc:date>"):
            assert word not in document + drawing.encode()
    # Most of the figure is picture, in its own colour.
    drawing_of_picture = cv2.imread(str(tmp_path / "overlay-1.png"))
    assert drawing_of_picture is not None
    assert (drawing_of_picture == (200, 90, 30)).all(axis=-1).mean() > 0.5


def test_files_are_the_same_every_time_and_leave_the_page_as_it_is(
    content: SessionContent, drawn: Mapping[str, Figure], tmp_path: Path
) -> None:
    svgs = []
    for k, folder in enumerate((tmp_path / "first", tmp_path / "second")):
        folder.mkdir()
        fresh = replace(drawn["timeline"])
        with mpl.rc_context({"font.size": 20, "svg.fonttype": "path", "pdf.fonttype": 3}):
            if k:
                assert fresh.svg  # the second time its page is drawn before its files
            write_figures(folder, [fresh], {"walk": content}, "k")
        svgs.append(fresh.svg)
    for path in (tmp_path / "first").iterdir():
        assert path.read_bytes() == (tmp_path / "second" / path.name).read_bytes(), path.name
    assert svgs[0] == svgs[1]


def test_nothing_of_others_is_written_over(content: SessionContent, tmp_path: Path) -> None:
    refuse_foreign(tmp_path / "new", overwrite=False)
    refuse_foreign(tmp_path, overwrite=False)  # empty
    write_figures(tmp_path, [], {"walk": content}, "k")
    refuse_foreign(tmp_path, overwrite=False)  # figures of ours are replaced
    mine = tmp_path / "thesis.tex"
    mine.write_text("mine")
    for place, code in ((tmp_path, "exists"), (mine, "not-a-folder")):
        with pytest.raises(DataError) as error:
            refuse_foreign(place, overwrite=False)
        assert (error.value.source, error.value.code) == (place, code)
    refuse_foreign(tmp_path, overwrite=True)
    (tmp_path / "session.json").write_text("{}")
    with pytest.raises(DataError, match="is a session"):
        refuse_foreign(tmp_path, overwrite=True)


# --- series ---


def test_bins_hold_each_time_once_and_its_percentiles() -> None:
    for count in (1, 299, 301, 5000):
        seconds = np.arange(count) / RATE_HZ + 3.0
        bins = chart.time_bins(seconds)
        assert len(bins) - 1 == min(count, chart.MOST_BINS)
        assert np.histogram(seconds, bins)[0].sum() == count
    rng = np.random.default_rng(3)
    seconds = np.arange(1200) / RATE_HZ
    values = rng.random((1200, 2, 17))
    values[400:420] = np.nan
    middle, low, high = chart.percentiles(values, seconds, chart.time_bins(seconds))
    # 300 bins of 4 times each.
    expected = np.nanpercentile(values[:4], [50, 10, 90])
    np.testing.assert_allclose([middle[0], low[0], high[0]], expected, rtol=1e-12)
    assert np.flatnonzero(np.isnan(middle)).tolist() == list(range(100, 105))


def test_a_path_is_thinned_and_broken_at_gaps() -> None:
    t_ns = np.delete(np.arange(3000), slice(1000, 1500)) * 20_000_000
    path = np.column_stack([t_ns / 1e9, np.zeros(len(t_ns))])
    thinned = figures._drawn_path(t_ns, path, [int(t_ns[999])])
    (breaks,) = np.nonzero(np.isnan(thinned[:, 0]))
    assert len(breaks) == 2  # at the gap and at the end
    # Both ends of the gap are drawn, nothing within it.
    assert thinned[breaks[0] - 1, 0] == pytest.approx(999 * 0.02)
    assert thinned[breaks[0] + 1, 0] == pytest.approx(1500 * 0.02)
    assert len(thinned) <= chart.MOST_POINTS + 4
