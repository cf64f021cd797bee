"""The figures of a page as files for a publication: PNG, SVG and PDF, with their numbers as CSV."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.reporting.content import SessionContent
from pipelines.reporting.plates import WIDTH_IN, Plate, page_style, settled
from pipelines.session.errors import DataError
from pipelines.session.storage import read_json, refuse_sessions, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.typing import RcKeyType

MARK = "figures.json"
"""Mark of a folder of figures: their flights, titles, captions, and the names of all files."""

_WIDTH_MM = 180.0  # of a figure as wide as the page: two columns of a journal, one being half of that
_DPI = 300
# Text stays text, and fonts are embedded as TrueType: journals refuse Type 3.
_STYLE: dict[RcKeyType, Any] = {"svg.fonttype": "none", "pdf.fonttype": 42, "savefig.facecolor": "white"}
# Neither dates nor versions: the same figure gives the same files.
_METADATA: dict[str, dict[str, Any]] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}


def write_figures(
    folder: Path, plates: Mapping[str, Plate], contents: Mapping[str, SessionContent], key: str
) -> None:
    """Write `<figure>.png`, `.svg`, `.pdf` and `.csv` for every figure, and the mark.

    The same plates give the same bytes. Numbers that have a name of their own go to `<figure>-<name>.csv`;
    empty cells are missing numbers.

    Args:
        folder: an existing, empty folder.
        contents: the sessions that they are of, by label; the mark names their flights.
        key: equal for equal figures; it is stored in the mark.
    """
    listed = []
    for plate in plates.values():
        names = _write_drawing(folder, plate.key, plate.figure)
        for what, numbers in plate.csv.items():
            name = f"{plate.key}-{what}.csv" if what else f"{plate.key}.csv"
            (folder / name).write_text(numbers, encoding="utf-8", newline="\n")
            names.append(name)
        words = {"title": plate.title, "caption": plate.caption, "description": plate.description}
        listed.append({"figure": plate.key, **words, "files": names})
    sessions = {
        label: {"flight": content.session.flight, "simulated": content.session.simulated}
        for label, content in contents.items()
    }
    write_json(folder / MARK, {"schema": 1, "key": key, "sessions": sessions, "figures": listed})


def _write_drawing(folder: Path, key: str, figure: Figure) -> list[str]:
    import matplotlib as mpl

    names = []
    with page_style():
        mpl.rcParams.update(_STYLE)
        with settled(figure, _WIDTH_MM / 25.4 / WIDTH_IN):
            for kind, metadata in _METADATA.items():
                names.append(f"{key}.{kind}")
                figure.savefig(folder / names[-1], dpi=_DPI, metadata=metadata)
    return names


def refuse_foreign(folder: Path, *, overwrite: bool) -> None:
    """Refuse to overwrite files that are not ours.

    Args:
        folder: the folder for figures; its old contents are removed.
        overwrite: replace other people's files; sessions and their parts are never replaced.

    Raises:
        DataError: a session, a part of one, or a folder that contains one; a file, or a folder that contains
            more than figures that were written before.
    """
    refuse_sessions(folder, mark=MARK, option="--figures")
    if overwrite or not folder.exists():
        return
    if not folder.is_dir():
        raise DataError(
            folder, "is a file, not a folder", "name another place with --figures", code="not-a-folder"
        )
    foreign = sorted({path.name for path in folder.iterdir()} - _ours(folder))
    if foreign:
        raise DataError(
            folder,
            f"holds other files than figures ({len(foreign)}, the first {foreign[0]})",
            "name another folder with --figures, or replace it with --overwrite",
            code="exists",
        )


def _ours(folder: Path) -> set[str]:
    """Return the names of the files that the mark in a folder lists."""
    if not (folder / MARK).is_file():
        return set()
    stated = read_json(folder / MARK, "remove it, or name another folder with --figures").get("figures")
    figures = stated if isinstance(stated, list) else []
    return {MARK, *(name for each in figures if isinstance(each, dict) for name in each.get("files", ()))}
