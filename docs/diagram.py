"""Draw docs/architecture.svg from the imports that are really there.

    python docs/diagram.py

Rows are the layers that the import contracts of pyproject.toml keep. An arrow from a box to one below
means that some module in it imports one there.
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import grimp

_ROWS = [
    ["mocap_cli"],
    ["stages"],
    ["sources"],
    ["drafting", "formats", "keypoints", "reconstruction", "planning", "simulation", "reporting"],
    ["session"],
    ["geometry"],
]
_WIDTH, _ROW, _HEIGHT, _GAP = 960, 104, 44, 14


def arrows() -> set[tuple[str, str]]:
    """The pairs of boxes of which the first imports the second."""
    graph = grimp.build_graph("mocap_cli", "pipelines")
    found = set()
    for importer in graph.modules - {"pipelines"}:
        for imported in graph.find_modules_directly_imported_by(importer) - {"pipelines"}:
            pair = _box(importer), _box(imported)
            if pair[0] != pair[1]:
                found.add(pair)
    return found


def _box(module: str) -> str:
    top, *inside = module.split(".")
    if top == "mocap_cli":
        return top
    rooms = {name for row in _ROWS for name in row}
    return inside[0] if inside[0] in rooms else "stages"


def draw() -> str:
    """The picture as SVG text; the same imports give the same bytes."""
    place = {
        name: ((k + 0.5) * _WIDTH / len(row), r * _ROW + 34)
        for r, row in enumerate(_ROWS)
        for k, name in enumerate(row)
    }
    lines = []
    for above, below in sorted(arrows()):
        (x0, y0), (x1, y1) = place[above], place[below]
        lines.append(
            f'<path d="M{x0:.0f} {y0 + _HEIGHT / 2:.0f} L{x1:.0f} {y1 - _HEIGHT / 2:.0f}" stroke="#8a94a6"'
            f' stroke-opacity="0.55" stroke-width="1.6" fill="none">'
            f"<title>{above} imports {below}</title></path>"
        )
    for row in _ROWS:
        wide = min(_WIDTH / len(row), 420) - _GAP
        for name in row:
            x, y = place[name]
            left, top = x - wide / 2, y - _HEIGHT / 2
            lines.append(
                f'<rect x="{left:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{_HEIGHT}" rx="6"'
                ' fill="#f4f6fb" stroke="#33415c"/>'
                f'<text x="{x:.1f}" y="{y + 5:.1f}" text-anchor="middle">{escape(name)}</text>'
            )
    height = len(_ROWS) * _ROW - _ROW + 68
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" font-family="sans-serif"'
        ' font-size="14" fill="#1b263b">\n<rect width="100%" height="100%" fill="white"/>\n'
        + "\n".join(lines)
        + "\n</svg>\n"
    )


if __name__ == "__main__":
    Path(__file__).with_name("architecture.svg").write_text(draw(), encoding="utf-8")
