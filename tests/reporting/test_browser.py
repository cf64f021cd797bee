"""The page in a real browser: it plays, turns and prints without a word on the console."""

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.reporting.content import SessionContent
from pipelines.reporting.page import draw_page

from .browser import Browser, browser
from .comparisons import make_comparison

# Of the pixels with exactly the colour of a variable: how many, and their middle; ANY: also half-drawn ones.
_PIXELS = """(() => {
  const canvas = document.getElementById('viewer-CANVAS');
  const colour = getComputedStyle(document.documentElement).getPropertyValue('NAME').trim();
  const rgb = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16));
  const { width, height } = canvas;
  const copy = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0);
  const data = copy.getImageData(0, 0, width, height).data;
  let [count, x, y] = [0, 0, 0];
  for (let k = 0; k < data.length; k += 4) {
    const solid = data[k + 3] === 255;
    if (solid ? rgb.every((value, c) => data[k + c] === value) : ANY && data[k + 3] > 0) {
      count += 1; x += (k / 4) % width; y += Math.floor(k / 4 / width);
    }
  }
  return [count, x / Math.max(count, 1), y / Math.max(count, 1)];
})()"""
_DRAWN = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"
_NOW = "parseFloat(document.getElementById('viewer-now').textContent)"


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("profile")) as running:
        yield running


@pytest.fixture(scope="module")
def page(content: SessionContent, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Render the report with pictures behind the overlays, as a file."""
    path = tmp_path_factory.mktemp("report") / "index.html"
    picture = np.full((1080, 1920, 3), 90, dtype=np.uint8)
    path.write_text(draw_page(content, lambda _camera, _frame: picture).render(), encoding="utf-8")
    return path


@pytest.fixture
def opened(chromium: Browser, page: Path) -> Iterator[Browser]:
    """Open the page; after the test its console must be empty."""
    chromium.complaints.clear()
    chromium.show_as()
    chromium.open(page)
    chromium.wait_for("document.getElementById('viewer').dataset.ready === 'true'")
    yield chromium
    assert chromium.complaints == []


def _pixels(
    opened: Browser, name: str, canvas: str = "flight", *, any_drawn: bool = False
) -> tuple[int, float, float]:
    assert opened.evaluate(_DRAWN)
    asked = _PIXELS.replace("CANVAS", canvas).replace("NAME", name)
    count, x, y = opened.evaluate(asked.replace("ANY", "true" if any_drawn else "false"))
    return int(count), float(x), float(y)


def _go_to(opened: Browser, t_s: float) -> None:
    opened.evaluate(f"location.hash = '#t={t_s}'")
    opened.wait_for(f"Math.abs({_NOW} - {t_s}) < 0.006")


def test_playing_moves_the_skeleton(opened: Browser) -> None:
    _go_to(opened, 1.0)
    count, x, y = _pixels(opened, "--left", "flight")
    assert count > 3
    opened.evaluate("document.getElementById('viewer-speed').value = '5'")
    opened.click("#viewer-play")
    opened.wait_for(f"{_NOW} > 4")
    assert opened.evaluate("document.getElementById('viewer-play').textContent") == "Pause"
    opened.click("#viewer-play")
    assert opened.evaluate("document.getElementById('viewer-play').textContent") == "Play"
    _go_to(opened, 4.0)
    _, moved_x, moved_y = _pixels(opened, "--left", "flight")
    # The actor walked 3.6 m, where half a canvas shows about 10 m.
    assert np.hypot(moved_x - x, moved_y - y) > 15


def test_dragging_turns_and_the_wheel_zooms(opened: Browser) -> None:
    _go_to(opened, 3.0)
    before = _pixels(opened, "--left", "body")
    x, y = opened.middle_of("#viewer-body")
    opened.mouse("mousePressed", x, y)
    opened.mouse("mouseMoved", x + 180, y)
    opened.mouse("mouseReleased", x + 180, y)
    turned = _pixels(opened, "--left", "body")
    assert turned != before
    opened.mouse("mouseWheel", x, y, deltaX=0, deltaY=-400)
    assert _pixels(opened, "--left", "body")[0] > turned[0]
    opened.click("#viewer-reset")
    assert _pixels(opened, "--left", "body") == before


_FOCUSED = """(() => {
  const e = document.activeElement;
  const style = getComputedStyle(e);
  const place = e.getBoundingClientRect();
  const seen = place.bottom > 0 && place.top < innerHeight && place.width > 0;
  const name = e.id || e.closest("figure, .table")?.id || e.getAttribute("aria-labelledby") || e.hash || "";
  return [e.tagName, name, seen && style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 1];
})()"""


def test_tab_alone_reaches_player_slider_curves_tables_and_links_with_a_visible_focus(
    opened: Browser,
) -> None:
    opened.evaluate("document.body.focus()")
    reached: list[tuple[str, str]] = []
    while True:
        opened.press("Tab")
        kind, name, visible = opened.evaluate(_FOCUSED)
        if kind == "BODY" or len(reached) > 200:
            break
        assert visible, (kind, name)
        reached.append((kind, name))
    wanted = [
        ("A", "#doubts"),
        ("BUTTON", "viewer-play"),
        ("INPUT", "viewer-time"),
        ("CANVAS", "viewer-body"),
        ("CANVAS", "viewer-flight"),
        ("SELECT", "viewer-from"),
        ("DIV", "figure-time"),
        ("DIV", "figure-residuals"),
        ("A", "figure-residuals"),
        ("SUMMARY", ""),
    ]
    places = [reached.index(each) for each in wanted]
    assert places == sorted(places)  # in the order of the page


def test_a_foreign_script_does_not_run(chromium: Browser, page: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed.html"
    hostile = "<script>document.title = 'taken'</script></body>"
    changed.write_text(page.read_text(encoding="utf-8").replace("</body>", hostile), encoding="utf-8")
    chromium.open(changed)
    assert chromium.evaluate("document.title") != "taken"
    assert any("Content Security Policy" in complaint for complaint in chromium.complaints)
    chromium.complaints.clear()


def test_arms_and_the_map_are_shown_as_chosen(
    chromium: Browser, content: SessionContent, tmp_path: Path
) -> None:
    path = tmp_path / "index.html"
    path.write_text(draw_page(replace(content, replan=make_comparison())).render(), encoding="utf-8")
    chromium.complaints.clear()
    chromium.show_as(scheme="dark")
    chromium.open(path)
    chromium.wait_for("document.getElementById('viewer').dataset.ready === 'true'")

    def pixels(name: str, *, any_drawn: bool = False) -> int:
        return _pixels(chromium, name, any_drawn=any_drawn)[0]

    def choose(element: str, change: str) -> None:
        chromium.evaluate(
            f"(() => {{ const e = document.getElementById('{element}'); {change};"
            "e.dispatchEvent(new Event('change')); })()"
        )

    _go_to(chromium, 5.0)
    # Colours of the session's first drone, and of the first arm of a session of three cameras.
    assert pixels("--camera-0") > 50
    assert pixels("--camera-3") == 0
    choose("viewer-arm", "e.value = '0'")
    assert pixels("--camera-0") == 0
    assert pixels("--camera-3") > 50
    with_map = pixels("--ink", any_drawn=True)
    choose("viewer-surface", "e.checked = false")
    assert with_map - pixels("--ink", any_drawn=True) > 200
    assert chromium.complaints == []


def test_a_click_on_a_curve_and_its_arrow_keys_choose_the_moment(opened: Browser) -> None:
    curve = "#figure-residuals .drawing"
    left, right, first, last = (
        float(value)
        for value in opened.evaluate(f"document.querySelector('{curve} svg').dataset.time").split()[:4]
    )
    x, y = opened.middle_of(f"{curve} svg")  # of the drawing, which is wider than its axes
    width = float(opened.evaluate(f"document.querySelector('{curve} svg').viewBox.baseVal.width"))
    expected = first + (width / 2 - left) / (right - left) * (last - first)
    for kind in ("mousePressed", "mouseReleased"):
        opened.mouse(kind, x, y)
    opened.wait_for(f"Math.abs({_NOW} - {expected}) < 0.05")  # a pixel, and two decimals
    moments = opened.evaluate(
        "Array.from(document.querySelectorAll('[name=moment]'), (e) => Number(e.dataset.t))"
    )
    chosen = opened.evaluate("Number(document.querySelector('[name=moment]:checked').dataset.t)")
    now = opened.evaluate(_NOW)
    assert chosen == min(moments, key=lambda t: abs(t - now))
    opened.evaluate(f"document.querySelector('{curve}').focus()")
    opened.press("ArrowRight")
    opened.wait_for(f"{_NOW} > {now}")
    opened.press("ArrowLeft")
    opened.press("ArrowLeft")
    opened.wait_for(f"{_NOW} < {now}")


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 900)])
def test_the_first_screen_holds_the_verdict_and_the_person(opened: Browser, width: int, height: int) -> None:
    opened.show_as(width=width, height=height)
    assert opened.evaluate(f"document.documentElement.scrollWidth <= {width}")
    for shown in (".verdict code", "#viewer-body"):
        bottom = opened.evaluate(f"document.querySelector('{shown}').getBoundingClientRect().bottom")
        assert bottom < height, shown


def test_a_table_is_saved_with_its_numbers(opened: Browser) -> None:
    opened.evaluate("URL.createObjectURL = (blob) => { window.saved = blob; return '#t=1'; }")
    opened.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    opened.click("[aria-labelledby=joints-caption] + .downloads button")
    text = str(opened.evaluate("window.saved.text()"))
    head, *rows = csv.reader(text.splitlines())
    assert len(rows) == 17
    assert head[1].split(", ") == ["Measured", "share"]
    shares = {tuple(row[0].split()): "".join(row[1].split()) for row in rows}
    assert shares["left", "wrist"] == "45.0%"
