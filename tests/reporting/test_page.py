"""The page of a session, and its figures as files."""

import base64
import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from html import unescape
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from pipelines.reporting.chart import MARK, Figure, refuse_foreign, write_figures
from pipelines.reporting.content import SessionContent
from pipelines.reporting.overlays import MOMENTS
from pipelines.reporting.page import draw_page, draw_session
from pipelines.reporting.viewer import MAX_BYTES
from pipelines.reporting.wording import joint_label
from pipelines.session.errors import DataError

from .comparisons import make_comparison
from .conftest import (
    ASIDE_PX,
    CAMERAS,
    JOINTS,
    OFFSET_M,
    described,
    make_frames,
    make_keypoints,
    make_metrics,
    make_poses,
    make_session,
    make_skeleton,
    make_truth,
)
from .reading import Outline, numbers, one, plain


def _sentences(outline: Outline, word: str) -> list[str]:
    """Return the sentences of a page that hold a word, with the spaces of their numbers."""
    text = " ".join(" ".join(outline.words).split(" "))
    sentences = re.split(r"(?<=[.:;])\s+", re.sub(r"[ \n]+", " ", text))
    return [said for said in sentences if word in said]


@pytest.fixture(scope="module")
def page(content: SessionContent) -> str:
    return draw_page(content).render()


def test_page_is_whole_and_small(page: str) -> None:
    outline = Outline(page)
    assert page.lower().startswith("<!doctype")
    assert outline.count("figure") == 8
    assert outline.count("img") == MOMENTS * len(CAMERAS)
    assert outline.count("canvas") == 2
    assert outline.count("h1") == 1
    assert len(page.encode()) < 1_500_000  # every figure is drawn twice, for phones too


def test_ids_are_unique_and_references_lead_somewhere(page: str) -> None:
    outline = Outline(page)
    assert [name for name, count in Counter(outline.ids).items() if count > 1] == []
    links = [link.removeprefix("#") for link in outline.links if not link.startswith(("#t=", "data:"))]
    assert set(outline.references + links) <= set(outline.ids)
    moments = [float(link.removeprefix("#t=")) for link in outline.links if link.startswith("#t=")]
    assert len(moments) == MOMENTS
    assert moments == sorted(moments)


def test_page_loads_nothing_and_runs_its_own_script_alone(page: str) -> None:
    outline = Outline(page)
    assert all(link.startswith(("#", "data:text/csv;", "data:image/webp;")) for link in outline.links)
    assert not {"iframe", "object", "embed", "link", "image"} & {tag for tag, _ in outline.elements}
    assert not [name for _, names in outline.elements for name in names if name.startswith("on")]
    assert not re.search(r"@import|url\((?!#)", page)
    (script,) = outline.scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'; img-src data:"
    assert _policy(page) == policy
    assert not re.search(r"\beval\(|new Function|innerHTML|fetch\(|import\(|XMLHttpRequest", script)


def test_pictures_are_held_by_the_page(content: SessionContent, page: str) -> None:
    asked = []

    def read_frame(camera: str, frame: int) -> NDArray[np.uint8] | None:
        asked.append((camera, frame))
        return None if camera == "mast" else np.full((1080, 1920, 3), 90, dtype=np.uint8)

    filmed = draw_page(content, read_frame).render()
    outline = Outline(filmed)
    pictures = [link for link in outline.links if not link.startswith(("#", "data:text/csv;"))]
    assert all(link.startswith("data:image/webp;base64,") for link in pictures)
    assert len(pictures) == MOMENTS * len(CAMERAS)
    assert len(asked) == len(set(asked)) == MOMENTS * len(CAMERAS)
    assert _policy(filmed).endswith("; img-src data:")
    # Both pages say why a ground is plain: a picture that is missing, or no video at all.
    assert "there is no picture" in outline.text
    assert "No video was ingested" in Outline(page).text


def _policy(page: str) -> str:
    found = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
    assert found is not None
    return unescape(found.group(1))


def test_numbers_of_the_page_are_those_of_the_data(page: str) -> None:
    outline = Outline(page)
    assert "81.1 %" in outline.text
    wrist = joint_label("left_wrist")
    assert outline.rows(wrist)[0][1:4] == ["45.0 %", "22.4", "0.0"]


def test_page_before_the_reconstruction(content: SessionContent) -> None:
    ingested = replace(content, skeleton=None, metrics=None, truth=None, stages={})
    outline = Outline(draw_page(ingested).render())
    assert "MPJPE" not in outline.text
    assert outline.count("figure") == 3
    assert outline.count("canvas") == 1  # the cameras alone


def test_page_of_unknown_joints_and_two_people(content: SessionContent) -> None:
    markers = {name: f"M{k}" for k, name in enumerate(JOINTS)}
    first = make_skeleton(40)
    first["joint"] = first["joint"].map(markers)
    both = pd.concat([first, first.assign(person=1, x=first["x"] + 3)])
    figures = {"coverage": 0.905, "reconstructed_share": 0.8, "mpjpe_mm": 43.21}
    by_person = {"person0": figures, "person1": figures | {"mpjpe_mm": None}}
    page = draw_page(replace(content, skeleton=both, metrics={"by_person": by_person}, truth=None)).render()
    outline = Outline(page)
    assert "90.5" in outline.text
    assert "43.2" in outline.text
    assert '<option value="1">person1</option>' in page
    assert '<select id="viewer-person">' in page
    assert "2 people" in outline.text
    assert page.count(">person1</text>") == 4  # legends of paths and errors over time, wide and narrow


HOSTILE = [
    "\"'><script>alert(1)</script></desc></svg></style></title><img src=x onerror=alert(1)>"
    '{{ 7 * 7 }} ${x} $a_b^c$ %s &lt;b&gt; &#60;i&#62; id="figure-top" url(#a) #22262a href="#x"',
    "مشي على – 丘 🚁 line\nbreak\ttab\x00nul\x1besc\u202e" + " long" * 40,
]


def _named(content: SessionContent, name: str) -> SessionContent:
    """Return a session and a comparison in which every text is `name`."""
    session = make_session(60)
    session |= {"flight": name, "warnings": [f"w {name}"], "sources": {name: "0" * 64}}
    description = described(session)
    # session.json cannot hold such names of cameras: should they come another way, pages escape them too.
    cameras = {name if key == "drone1" else key: each for key, each in description.cameras.items()}
    description = description.model_copy(update={"cameras": cameras})
    skeleton = make_skeleton(60)
    skeleton["joint"] = skeleton["joint"].replace("nose", name)
    metrics = make_metrics() | {name: 3.0, "method": name}

    def renamed(tables: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
        return {name if key == "drone1" else key: table for key, table in tables.items()}

    stored = make_comparison(name, "fixed", verdict=name)
    compared = stored.metrics | {"skeleton": name, "notes": [name]}
    arms = {
        arm: table.assign(camera=table["camera"].replace("drone1", name))
        for arm, table in stored.arms.items()
    }
    return replace(
        content,
        name=f"s {name}",
        session=description,
        skeleton=skeleton,
        metrics=metrics,
        truth=make_truth(60),
        poses=renamed(make_poses(60)),
        frames=renamed(make_frames(60)),
        keypoints=renamed(make_keypoints(60)),
        stages={
            name: {"key": name, "settings": {name: name}, "counts": {name: 1}, "warnings": [f"x {name}"]}
        },
        replan=replace(stored, metrics=compared, arms=arms),
    )


@pytest.fixture(scope="module")
def tame(content: SessionContent) -> Outline:
    return Outline(draw_page(_named(content, "tame")).render())


@pytest.mark.parametrize("name", HOSTILE)
def test_names_from_files_stay_text(content: SessionContent, tame: Outline, name: str) -> None:
    page = draw_page(_named(content, name)).render()
    outline = Outline(page)
    # Not one element or attribute more than with a harmless name; in the figures, where a longer label
    # leaves room for other ticks, none of another kind.
    assert outline.outside_drawings == tame.outside_drawings
    assert set(outline.elements) <= set(tame.elements)
    assert outline.scripts == tame.scripts
    (data,) = outline.data
    cameras = [camera["name"] for camera in json.loads(data)["cameras"]]
    assert cameras[0] == name  # as logged
    assert cameras[3] == name  # of an arm
    shown = " ".join(name.replace("\x00", "\ufffd").split())[:30]
    assert outline.text.replace("\x00", "\ufffd").count(shown) >= 11


@pytest.fixture(scope="module")
def compared(content: SessionContent) -> str:
    return draw_page(replace(content, replan=make_comparison())).render()


def test_a_comparison_of_planners_is_a_tab(page: str, compared: str) -> None:
    before, after = Outline(page), Outline(compared)
    assert after.count("figure") == before.count("figure") + 2
    assert after.count("table") == before.count("table") + 2
    assert str(make_comparison().metrics["verdict"])[1:] in after.text  # it begins with a capital there
    less = one([plain(" ".join(row)) for row in after.cells], "adaptive less fixed")
    assert numbers(less)[:3] == [-5.0, -5.5, -4.5]
    assert numbers(one(_sentences(after, "voxel"), "240"))[0] == 240
    assert {"replan", "tab-2"} & set(before.ids) == set()
    assert {"replan", "tab-2"} <= set(after.ids)
    assert [name for name, count in Counter(after.ids).items() if count > 1] == []
    assert set(after.references) <= set(after.ids)


def test_long_flight_stays_small_and_says_what_is_left_out(content: SessionContent) -> None:
    frames = 10 * 60 * 30
    long_flight = replace(
        content,
        session=described(make_session(frames)),
        skeleton=make_skeleton(frames),
        truth=make_truth(frames),
        poses=make_poses(frames),
        frames=make_frames(frames),
        keypoints=make_keypoints(frames),
    )
    page = draw_page(long_flight).render()
    outline = Outline(page)
    # The motion has at most 6 MB before base64. Pictures add about 1.5 MB to the rest: 6 million pixels at
    # 1.5 bits, in base64. Script and styles are 0.06 MB.
    assert len(page.encode()) < 4 * MAX_BYTES // 3 + 350_000
    # 600 s at 50 Hz are 30 000 poses: one in 50 leaves 600 of them.
    assert [50] in [numbers(said) for said in _sentences(outline, "pose")]
    # 600 s in 300 points.
    assert [2] in [numbers(said) for said in _sentences(outline, "point")]
    assert [18000] in [numbers(said)[1:] for said in _sentences(outline, "time")]


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
