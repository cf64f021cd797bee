"""The figures as files: whole, the same every time, beside the numbers that they draw."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest

from pipelines.reporting.chart import MARK, Plate, refuse_foreign, write_figures
from pipelines.reporting.comparison_page import draw_comparison
from pipelines.reporting.content import SessionContent
from pipelines.reporting.figures import draw_all
from pipelines.reporting.page import draw_session
from pipelines.reporting.session_comparison import compare
from pipelines.reporting.summary import summarise
from pipelines.session.errors import DataError

from .comparisons import TIMES, make_comparison, tilt_deg
from .conftest import ASIDE_PX, CAMERAS, JOINTS, OFFSET_M
from .test_comparison import OFF_MM, _moved

WIDTH_PX = 180 / 25.4 * 300


@pytest.fixture(scope="module")
def plates(content: SessionContent) -> dict[str, Plate]:
    picture = np.full((540, 960, 3), (200, 90, 30), dtype=np.uint8)  # half the calibration's size, blue
    drawn = draw_session(replace(content, replan=make_comparison()), lambda _camera, _frame: picture)
    assert [key for key in drawn if key.startswith("overlay")] == [f"overlay-{k}" for k in range(1, 7)]
    return {key: plate for key, plate in drawn.items() if not re.fullmatch(r"overlay-[2-6]", key)}


@pytest.fixture(scope="module")
def written(
    plates: Mapping[str, Plate], content: SessionContent, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    folder = tmp_path_factory.mktemp("figures")
    write_figures(folder, plates, {"walk": content}, "k" * 64)
    return folder


def _read(written: Path, name: str) -> pd.DataFrame:
    return pd.read_csv(written / name, keep_default_na=True)


@pytest.mark.slow
def test_every_figure_is_there_in_every_form(
    content: SessionContent, plates: Mapping[str, Plate], written: Path
) -> None:
    told = json.loads((written / MARK).read_text(encoding="utf-8"))
    assert told["sessions"] == {"walk": {"flight": content.session.flight, "simulated": False}}
    assert [each["figure"] for each in told["figures"]] == list(plates)
    listed = [name for each in told["figures"] for name in each["files"]]
    assert sorted([MARK, *listed]) == sorted(path.name for path in written.iterdir())
    for key, plate in plates.items():
        picture = cv2.imread(str(written / f"{key}.png"))
        assert picture is not None
        share = plate.figure.get_size_inches()[0] / 9.0  # as wide as the page, or half of that
        assert picture.shape[1] == pytest.approx(share * WIDTH_PX, abs=1.5)
        assert (picture[0, 0] == 255).all()
        drawing = (written / f"{key}.svg").read_text(encoding="utf-8")
        width_pt = ET.fromstring(drawing).get("width", "").removesuffix("pt")  # noqa: S314 - our own file
        assert float(width_pt) == pytest.approx(share * 180 / 25.4 * 72, abs=0.01)
        assert "<dc:date>" not in drawing
        document = (written / f"{key}.pdf").read_bytes()
        assert document.startswith(b"%PDF-")
        assert b"/FontFile2" in document  # TrueType, as journals ask
        assert b"/Type3" not in document
        assert not any(word in document for word in (b"CreationDate", b"Producer", b"Matplotlib"))
        assert plate.caption == next(each["caption"] for each in told["figures"] if each["figure"] == key)


def test_numbers_are_those_of_the_session(written: Path) -> None:
    time = _read(written, "time.csv")
    measured = time["median_mm"].dropna()
    assert 0 < len(measured) < len(time)
    np.testing.assert_allclose(measured, 1000 * np.linalg.norm(OFFSET_M), rtol=1e-6)
    words = [name for name in time if str(name).endswith("_percent")]
    np.testing.assert_allclose(time[words].sum(axis=1), 100.0, rtol=1e-6)
    joints = _read(written, "joints.csv").set_index("joint")
    assert list(joints.index) == list(JOINTS)
    assert joints.loc["left_wrist", "ok_percent"] == pytest.approx(45.0)
    spans = _read(written, "timeline.csv")
    assert list(spans[spans["what"] == "frames"]["camera"]) == list(CAMERAS)
    paths = _read(written, "top.csv")
    actor = paths[paths["who"] == "actor"].dropna()
    # The median of swinging joints stays near the middle, which walks at 6 m around (2, 1).
    radius = np.hypot(actor["east_m"] - 2, actor["north_m"] - 1)
    np.testing.assert_allclose(radius, 6.0, atol=0.35)


def test_numbers_of_arms_are_those_of_the_comparison(written: Path) -> None:
    arms = _read(written, "arms-time.csv")
    assert len(arms) == 3 * 2 * TIMES
    fixed = arms[(arms["arm"] == "fixed") & (arms["camera"] == "drone2")]
    np.testing.assert_allclose(fixed["tilt_deg"], tilt_deg("fixed"), rtol=1e-8)
    assert arms[arms["arm"] == "fixed"]["hidden"].sum() == 100  # 2 s at 50 Hz, one of two drones
    costs = _read(written, "arms-yaw-costs.csv")
    np.testing.assert_allclose(costs["cost"], 1 - np.cos(np.radians(costs["yaw_deg"])), atol=1e-8)


def test_the_skeleton_lies_over_the_pictures(written: Path) -> None:
    joints = _read(written, "overlay-1.csv")
    found, reprojected = (
        joints[[f"{what}_x_px", f"{what}_y_px"]].to_numpy() for what in ("found", "reprojected")
    )
    aside = found - reprojected
    known = aside[np.isfinite(aside).all(axis=1)]
    assert len(known) > len(JOINTS)
    np.testing.assert_allclose(known, np.tile(ASIDE_PX, (len(known), 1)), atol=1e-5)
    drawn = cv2.imread(str(written / "overlay-1.png"))
    assert drawn is not None
    # Most of the figure is picture, in its own colour.
    assert (drawn == (200, 90, 30)).all(axis=-1).mean() > 0.5


def test_a_comparison_of_sessions_has_its_numbers(content: SessionContent, tmp_path: Path) -> None:
    contents = {"a": content, "b": _moved(content, 2)}
    write_figures(tmp_path, draw_comparison(compare(contents)), contents, "k")
    differences = _read(tmp_path, "compare-differences.csv").set_index("measure")
    assert differences.loc["MPJPE", "difference_percent"] == pytest.approx(100.0)
    joints = _read(tmp_path, "compare-joints.csv")
    errors = joints[joints["measure"].str.contains("mm")].groupby("session")["value"].mean()
    assert errors.to_dict() == pytest.approx({"a": OFF_MM, "b": 2 * OFF_MM})
    assert set(_read(tmp_path, "compare-time.csv")["session"]) == {"a", "b"}


def test_files_are_the_same_every_time_and_leave_the_page_as_it_is(
    content: SessionContent, tmp_path: Path
) -> None:
    drawn: list[str] = []
    for folder in (tmp_path / "first", tmp_path / "second"):
        folder.mkdir()
        with mpl.rc_context({"font.size": 20, "svg.fonttype": "path", "pdf.fonttype": 3}):
            plates = draw_all(summarise(content), content.poses)
            if drawn:
                assert plates["time"].svg  # the second time its page is drawn before its files
            write_figures(folder, {"time": plates["time"]}, {"walk": content}, "k")
        drawn.append(plates["time"].svg)
    for path in (tmp_path / "first").iterdir():
        assert path.read_bytes() == (tmp_path / "second" / path.name).read_bytes(), path.name
    # And the page's drawing is the same before and after files were written.
    assert drawn[0] == drawn[1]


def test_nothing_of_others_is_written_over(written: Path, tmp_path: Path) -> None:
    refuse_foreign(written, overwrite=False)  # figures of ours are replaced
    refuse_foreign(tmp_path / "new", overwrite=False)
    refuse_foreign(tmp_path, overwrite=False)  # empty
    mine = tmp_path / "thesis.tex"
    mine.write_text("mine")
    with pytest.raises(DataError, match=rf"\(1, \D*{mine.name}\).*--overwrite") as error:
        refuse_foreign(tmp_path, overwrite=False)
    assert error.value.source == tmp_path
    with pytest.raises(DataError, match="--figures") as error:
        refuse_foreign(mine, overwrite=False)
    assert error.value.source == mine
    refuse_foreign(tmp_path, overwrite=True)
    (tmp_path / "session.json").write_text("{}")
    with pytest.raises(DataError, match="is a session"):
        refuse_foreign(tmp_path, overwrite=True)
