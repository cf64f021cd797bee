from __future__ import annotations

import base64
import hashlib
import json
import re
from collections import Counter
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from pipelines.reporting.content import SessionContent
from pipelines.reporting.overlays import MOMENTS
from pipelines.reporting.page import render_page
from pipelines.reporting.plates import PALETTE
from pipelines.reporting.wording import THIN

from .comparisons import make_comparison
from .conftest import (
    CAMERAS,
    FRAMES,
    JOINTS,
    START_NS,
    described,
    make_frames,
    make_keypoints,
    make_metrics,
    make_poses,
    make_session,
    make_skeleton,
    make_truth,
)

_VOID = {"meta", "br", "hr", "img", "input", "link"}


class _Outline(HTMLParser):
    """Every element with the names of its attributes, ids, references and text; checks the nesting."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, tuple[str, ...]]] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.links: list[str] = []
        self.words: list[str] = []
        self.data: list[str] = []
        self.scripts: list[str] = []
        self._open: list[str] = []
        self._is_data = False
        self.feed(page)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, tuple(name for name, _ in attrs)))
        self._is_data = ("type", "application/json") in attrs
        if tag not in _VOID:
            self._open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            elif name in {"aria-labelledby", "aria-describedby"}:
                self.references.append(value or "")
            elif name in {"href", "src", "xlink:href"}:
                self.links.append(value or "")
            self.references += re.findall(r"url\(#([^)]+)\)", value or "")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] == "script":
            (self.data if self._is_data else self.scripts).append(data)
        else:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split()).replace(THIN, " ")

    @property
    def outside_drawings(self) -> list[tuple[str, tuple[str, ...]]]:
        kept, drawing = [], False
        for element in self.elements:
            drawing = drawing or element[0] == "svg"
            drawing = drawing and element[0] != "figcaption"
            if not drawing:
                kept.append(element)
        return kept

    def count(self, tag: str) -> int:
        return sum(name == tag for name, _ in self.elements)


@pytest.fixture(scope="module")
def page(content: SessionContent) -> str:
    return render_page(content)


def test_page_is_whole_and_small(page: str) -> None:
    outline = _Outline(page)
    assert page.startswith("<!doctype html>")
    assert outline.count("figure") == 8
    assert page.count('<svg class="overlay"') == MOMENTS * len(CAMERAS)
    assert outline.count("canvas") == 2
    assert outline.count("h1") == 1
    assert len(page.encode()) < 1_000_000


def test_ids_are_unique_and_references_lead_somewhere(page: str) -> None:
    outline = _Outline(page)
    assert [name for name, count in Counter(outline.ids).items() if count > 1] == []
    links = [link.removeprefix("#") for link in outline.links if not link.startswith("#t=")]
    assert set(outline.references + links) <= set(outline.ids)
    moments = [float(link.removeprefix("#t=")) for link in outline.links if link.startswith("#t=")]
    assert len(moments) == MOMENTS
    assert moments == sorted(moments)


def test_page_loads_nothing_and_runs_its_own_script_alone(page: str) -> None:
    outline = _Outline(page)
    assert all(link.startswith("#") for link in outline.links)
    assert not {"iframe", "object", "embed", "link", "img", "image"} & {tag for tag, _ in outline.elements}
    assert not [name for _, names in outline.elements for name in names if name.startswith("on")]
    assert not re.search(r"@import|url\((?!#)", page)
    (script,) = outline.scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    assert _policy(page) == policy
    assert not re.search(r"\beval\(|new Function|innerHTML|fetch\(|import\(|XMLHttpRequest", script)


def test_pictures_are_held_by_the_page(content: SessionContent) -> None:
    asked = []

    def read_frame(camera: str, frame: int) -> NDArray[np.uint8] | None:
        asked.append((camera, frame))
        return None if camera == "mast" else np.full((1080, 1920, 3), 90, dtype=np.uint8)

    page = render_page(content, read_frame)
    outline = _Outline(page)
    pictures = [link for link in outline.links if not link.startswith("#")]
    assert all(link.startswith("data:image/jpeg;base64,") for link in pictures)
    # One in a panel and one in its map, of two cameras; without a pose, in drone2's gap, the whole alone.
    assert len(pictures) == MOMENTS * 2 * 2 - 1
    assert len(asked) == len(set(asked)) == MOMENTS * len(CAMERAS)
    assert _policy(page).endswith("; img-src data:")
    assert "Where the ground is plain, there is no picture." in outline.text
    assert "No video was ingested, so the ground is plain." in _Outline(render_page(content)).text


def _policy(page: str) -> str:
    found = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
    assert found is not None
    return unescape(found.group(1))


def test_every_header_cell_has_a_scope(page: str) -> None:
    headers = [names for tag, names in _Outline(page).elements if tag == "th"]
    assert headers
    assert all("scope" in names for names in headers)


def test_figures_take_their_colours_from_the_page(page: str) -> None:
    drawings = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    assert not re.search(r"#[0-9a-f]{6}\b", "".join(re.findall(r"<[^>]+>", "".join(drawings))))
    for variable in re.findall(r"var\((--[a-z0-9-]+)\)", "".join(drawings)):
        assert f"{variable}: #" in page
    # Light and dark both define the whole palette; over a picture, parts of it are others.
    style = re.sub(r"\.on-picture \{[^}]*\}", "", page)
    for variable in PALETTE.values():
        assert style.count(f"{variable}: #") == 2, variable


def test_same_content_gives_the_same_bytes_whatever_was_drawn_before(
    content: SessionContent, page: str
) -> None:
    with mpl.rc_context({"font.size": 20, "axes.facecolor": "red", "svg.fonttype": "path"}):
        again = render_page(content)
        assert mpl.rcParams["font.size"] == 20
    assert again == page


def test_numbers_of_the_page_are_those_of_the_data(page: str) -> None:
    text = _Outline(page).text
    assert "81.1 % of 10 200 joint-frames" in text
    assert "left wrist 45.0 % 22.4 0.0" in text  # the row of the table
    assert "left wrist 45.0 %," in text  # the description of the figure
    assert "the largest at" in text
    # The actor's arc: 1.2 m/s for 19 s (the last second has no pose), less the 2 s nobody saw.
    arc = re.search(r"the actor over ([\d.]+) m", text)
    assert arc is not None
    # Two hops of 1/30 s are lost to the hole, and the median of the swinging joints wobbles a little.
    assert float(arc.group(1)) == pytest.approx(1.2 * 17, rel=0.05)


def test_page_without_truth(content: SessionContent) -> None:
    metrics: dict[str, object] = {
        "method": "dlt",
        "reprojection_px": {"median": 4.4, "mean": 4.2},
        "per_joint": {},
    }
    text = _Outline(render_page(replace(content, truth=None, metrics=metrics))).text
    assert "Reprojection error over time" in text
    assert "MPJPE" not in text


def test_page_before_the_reconstruction(content: SessionContent) -> None:
    ingested = replace(content, skeleton=None, metrics=None, truth=None, stages={})
    outline = _Outline(render_page(ingested))
    assert "not reconstructed yet" in outline.text
    assert outline.count("figure") == 3
    assert outline.count("canvas") == 1  # the cameras alone


def test_page_with_nothing_reconstructed(content: SessionContent) -> None:
    skeleton = make_skeleton(50).assign(status="rejected")
    skeleton[["x", "y", "z", "reprojection_px"]] = np.nan
    text = _Outline(render_page(replace(content, skeleton=skeleton, metrics={}, truth=None))).text
    assert "Nothing was reconstructed: none of 850 joint-frames passed." in text
    assert "disagreed by more than pixel and pose noise explain (rejected)" in text


def test_page_of_an_empty_skeleton(content: SessionContent) -> None:
    empty = replace(content, skeleton=make_skeleton(5)[:0], metrics={}, truth=None)
    assert "the skeleton has no rows" in _Outline(render_page(empty)).text


def test_page_of_a_single_frame(content: SessionContent) -> None:
    single = replace(
        content,
        session=described(make_session(1)),
        skeleton=make_skeleton(1).assign(status="ok", x=1.0, y=2.0, z=3.0, reprojection_px=1.0),
        truth=make_truth(1),
        poses={name: table[:1] for name, table in make_poses().items()},
    )
    assert _Outline(render_page(single)).count("figure") == 8


def test_page_of_unknown_joints_and_two_people(content: SessionContent) -> None:
    markers = {name: f"M{k}" for k, name in enumerate(JOINTS)}
    first = make_skeleton(40)
    first["joint"] = first["joint"].map(markers)
    both = pd.concat([first, first.assign(person=1, x=first["x"] + 3)])
    page = render_page(replace(content, skeleton=both, metrics={}, truth=None))
    outline = _Outline(page)
    assert outline.count("figure") == 7  # no bone is known
    assert '<select id="viewer-person">' in page
    assert "2 people" in outline.text
    assert "person 1" in outline.text


HOSTILE = [
    "\"'><script>alert(1)</script>",
    "</desc></svg></style></title><img src=x onerror=alert(1)>",
    "{{ 7 * 7 }} ${x} $a_b^c$ %s &lt;b&gt; &#60;i&#62;",
    'id="figure-top" url(#a) #22262a href="#x"',
    "مشي على التل – 丘を歩く – Ходьба 🚁",
    "line\nbreak\ttab\x00nul\x1besc\u202e" + " long" * 40,
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
    compared = stored.metrics | {"mode": name, "skeleton": name, "notes": [name]}
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
def tame(content: SessionContent) -> _Outline:
    return _Outline(render_page(_named(content, "tame")))


@pytest.mark.parametrize("name", HOSTILE)
def test_names_from_files_stay_text(content: SessionContent, tame: _Outline, name: str) -> None:
    page = render_page(_named(content, name))
    outline = _Outline(page)
    # Not one element or attribute more than with a harmless name; in the figures, where a longer label
    # leaves room for other ticks, none of another kind.
    assert outline.outside_drawings == tame.outside_drawings
    assert set(outline.elements) <= set(tame.elements)
    assert outline.scripts == tame.scripts
    (data,) = outline.data
    cameras = [camera["name"] for camera in json.loads(data)["cameras"]]
    assert cameras[0] == name  # as logged
    assert cameras[3] == name  # of an arm
    comparison = page[page.index('<section id="replan"') : page.index('<section id="made"')]
    rest = page.replace(comparison, "")
    shown = " ".join(name.replace("\x00", "\ufffd").split())[:30]
    for part, least in ((rest, 6), (comparison, 6)):
        assert _Outline(part).text.replace("\x00", "\ufffd").count(shown) >= least


@pytest.fixture(scope="module")
def compared(content: SessionContent) -> str:
    return render_page(replace(content, replan=make_comparison()))


def test_a_comparison_of_planners_is_a_section(page: str, compared: str) -> None:
    before, after = _Outline(page), _Outline(compared)
    assert after.count("figure") == before.count("figure") + 3
    assert after.count("table") == before.count("table") + 2
    assert "Adaptive is better." in after.text
    assert "Simulated: adaptive and fixed; flown is what the log says." in after.text
    assert "adaptive simulated 17.2 23.5 – 12.5 % 9.2 to 10.8" in after.text
    assert "61.0 58.5 to 63.5 87.5 81.2 to 93.8 collision 3" in after.text
    assert "flown as logged" in after.text
    assert "adaptive less fixed −5.00 −5.50 to −4.50" in after.text
    assert "The map: 240 voxels of the surface above the ground" in after.text
    assert "Planners compared" not in before.text
    assert [name for name, count in Counter(after.ids).items() if count > 1] == []
    assert set(after.references) <= set(after.ids)


def test_the_rest_of_the_page_is_as_without_a_comparison(page: str, compared: str) -> None:
    start, end = compared.index('<section id="replan"'), compared.index('<section id="made"')
    rest = compared[:start] + compared[end:]
    viewer = re.compile(
        r'<section id="motion".*?</section>|<script type="application/json".*?</script>', re.DOTALL
    )
    assert "".join(viewer.sub("", rest).split()) == "".join(viewer.sub("", page).split())


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
    page = render_page(long_flight)
    text = _Outline(page).text
    # Pictures add about 1.5 MB: 6 million pixels at 1.5 bits, in base64.
    assert len(page.encode()) < 3_500_000
    # 600 s at 50 Hz are 30 000 poses: one in 50 leaves 600 of them.
    assert "One pose in 50 is drawn." in text
    assert "Each point stands for 2 s." in text
    assert re.search(r"The page holds one time in \d of 18 000", text)


def test_far_world_coordinates_are_told_from_a_round_number(content: SessionContent) -> None:
    shift = {"x": 691_234.5, "y": 5_335_678.9}
    assert content.skeleton is not None
    far = replace(
        content,
        skeleton=content.skeleton.assign(**{axis: content.skeleton[axis] + d for axis, d in shift.items()}),
        poses={
            name: table.assign(**{axis: table[axis] + d for axis, d in shift.items()})
            for name, table in content.poses.items()
        },
        truth=None,
    )
    text = _Outline(render_page(far)).text
    assert "east of 691 000 m (m)" in text
    assert "north of 5 335 000 m (m)" in text


def test_frames_and_start_are_told(page: str) -> None:
    text = _Outline(page).text
    assert START_NS == 1_700_000_000_000_000_000
    assert "2023-11-14 22:13:20.000 UTC" in text
    assert f"17 joints at {FRAMES} times" in text
