from __future__ import annotations

import base64
import re
from dataclasses import replace
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.cameras import Intrinsics
from pipelines.reporting.overlays import View
from pipelines.reporting.panels import draw_panel, picture_width

JOINTS = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
BODY = np.array([[[620.0, 300.0], [580.0, 300.0], [615.0, 380.0], [585.0, 380.0]]])
WIDTH, HEIGHT = 1280, 720


@pytest.fixture
def view() -> View:
    nobody = np.zeros((1, 4), dtype=np.bool_)
    return View(
        camera="<b>&",
        intrinsics=Intrinsics(WIDTH, HEIGHT, 900.0, 900.0, 639.5, 359.5),
        joints=JOINTS,
        frame=3,
        t_s=0.1,
        found=BODY + np.array([3.0, 4.0]),
        reprojected=BODY,
        rejected=nobody,
        unmeasured=nobody,
        others=np.zeros((0, 4, 2)),
        has_pose=True,
        picture=None,
    )


def _parsed(view: View, width_px: int = 640) -> ET.Element:
    drawing = re.sub(r' href="', ' xlink="', draw_panel(view, width_px))
    return ET.fromstring(drawing)  # noqa: S314 - our own drawing


def _window(svg: ET.Element) -> tuple[float, float, float, float]:
    left, top, width, height = (float(value) for value in svg.attrib["viewBox"].split())
    return left, top, width, height


def _classes(svg: ET.Element) -> set[str]:
    return {element.attrib["class"] for element in svg if "class" in element.attrib}


def _decoded(image: ET.Element) -> NDArray[np.uint8]:
    kind, _, data = image.attrib["xlink"].partition(",")
    assert kind == "data:image/jpeg;base64"
    jpeg = np.frombuffer(base64.b64decode(data), dtype=np.uint8)
    return np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), dtype=np.uint8)


def test_marks_stand_where_the_pixels_are(view: View) -> None:
    svg = _parsed(view)
    rings = [element for element in svg if element.attrib.get("class") == "found"]
    assert [(float(ring.attrib["cx"]), float(ring.attrib["cy"])) for ring in rings] == [
        (x, y) for x, y in view.found[0]
    ]
    (residuals,) = [element for element in svg if element.attrib.get("class") == "residual"]
    assert residuals.attrib["d"].startswith("M623.0 304.0L620.0 300.0")
    assert residuals.attrib["d"].count("M") == 4
    assert {("bone", side) for side in ("left", "right", "middle")} <= {
        tuple(c.split()) for c in _classes(svg)
    }
    assert "casing" in _classes(svg)


def test_panel_is_a_square_around_the_person(view: View) -> None:
    left, top, width, height = _window(_parsed(view))
    assert width == height
    # 84 px from the highest ring or joint to the lowest, and a margin.
    assert width == np.ceil(1.3 * 84)
    assert left + width / 2 == pytest.approx(601.5, abs=1)
    assert top + height / 2 == pytest.approx(342, abs=1)


@pytest.mark.parametrize("corner", [(0.0, 0.0), (WIDTH - 61.0, HEIGHT - 91.0)])
def test_panel_stays_in_the_picture(view: View, corner: tuple[float, float]) -> None:
    moved = BODY - BODY.min(axis=(0, 1)) + corner
    left, top, width, height = _window(_parsed(replace(view, found=moved, reprojected=moved)))
    assert left >= -0.5
    assert top >= -0.5
    assert left + width <= WIDTH - 0.5
    assert top + height <= HEIGHT - 0.5


def test_points_outside_the_picture_do_not_move_the_panel(view: View) -> None:
    astray = view.reprojected.copy()
    astray[0, 0] = [9e5, -9e5]
    _, _, width, _ = _window(_parsed(replace(view, reprojected=astray)))
    assert width < 130


def test_whole_picture_where_nobody_is(view: View) -> None:
    nowhere = np.full_like(BODY, np.nan)
    svg = _parsed(replace(view, found=nowhere, reprojected=nowhere))
    assert _window(svg) == (-0.5, -280.5, 1280, 1280)
    assert not _classes(svg) & {"found", "joint", "residual", "casing", "map"}


def test_rejected_and_unmeasured_joints_are_crosses(view: View) -> None:
    rejected, unmeasured = view.rejected.copy(), view.unmeasured.copy()
    rejected[0, 0], unmeasured[0, 1] = True, True
    gone = view.reprojected.copy()
    gone[0, :2] = np.nan
    svg = _parsed(replace(view, rejected=rejected, unmeasured=unmeasured, reprojected=gone))
    assert sum(element.attrib.get("class") == "found" for element in svg) == 2
    for kind in ("rejected", "unmeasured"):
        (cross,) = [element for element in svg if element.attrib.get("class") == kind]
        assert cross.attrib["d"].count("M") == 2
    assert ["bone", "left"] not in [kind.split() for kind in _classes(svg)]


def test_a_map_shows_where_the_panel_lies(view: View) -> None:
    svg = _parsed(view)
    (inset,) = [element for element in svg if element.attrib.get("class") == "map"]
    assert _window(inset) == (-0.5, -0.5, WIDTH, HEIGHT)
    (where,) = [element for element in inset if element.attrib["class"] == "where"]
    assert [float(where.attrib[key]) for key in ("x", "y", "width", "height")] == list(_window(svg))


@pytest.mark.parametrize("scale", [1, 2])
def test_picture_lies_under_its_pixels(view: View, scale: int) -> None:
    # White from 600 to 604 by 340 to 344 px, in a picture as large as the calibration's or twice.
    picture = np.zeros((HEIGHT * scale, WIDTH * scale, 3), dtype=np.uint8)
    picture[340 * scale : 345 * scale, 600 * scale : 605 * scale] = 255
    svg = _parsed(replace(view, picture=picture))
    assert "on-picture" in svg.attrib["class"]
    image = next(element for element in svg if element.tag == "image")
    decoded = _decoded(image)
    x, y, width, height = (float(image.attrib[key]) for key in ("x", "y", "width", "height"))
    rows, columns = np.nonzero(decoded[..., 0] > 128)
    # The centre of a pixel of the JPEG, counted from its edge, in pixels of the picture.
    assert x + (columns.mean() + 0.5) * width / decoded.shape[1] == pytest.approx(602, abs=0.1)
    assert y + (rows.mean() + 0.5) * height / decoded.shape[0] == pytest.approx(342, abs=0.1)


def test_pictures_are_no_wider_than_asked_and_never_enlarged(view: View) -> None:
    picture = np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8)
    shown = [
        _decoded(
            next(
                element
                for element in _parsed(replace(view, picture=picture), width)
                if element.tag == "image"
            )
        )
        for width in (50, 640)
    ]
    assert shown[0].shape[:2] == (50, 50)
    assert shown[1].shape[:2] == (110, 110)  # as many as the panel covers


def test_same_view_gives_the_same_bytes(view: View) -> None:
    picture = np.random.default_rng(3).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    pictured = replace(view, picture=picture)
    assert draw_panel(pictured, 300) == draw_panel(pictured, 300)


def test_a_panel_has_no_words_of_the_session(view: View) -> None:
    assert "b&" not in draw_panel(view, 640)
    assert "<b" not in draw_panel(view, 640)


@pytest.mark.parametrize(("panels", "width"), [(1, 640), (12, 640), (48, 353)])
def test_many_panels_share_the_room(panels: int, width: int) -> None:
    assert picture_width(panels) == width
    assert panels * picture_width(panels) ** 2 <= 6_000_000
