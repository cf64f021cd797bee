"""Numbers, words and tables as the pages print them, and the templates that use them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment


# A narrow no-break space stands between a number and its unit, and between thousands (ISO 80000-1).
THIN = "\u202f"
ABSENT = "–"
_EMPTY: tuple[object, ...] = ("", ABSENT, (ABSENT, ""))

# A stamp after 2000-01-01 counts from the epoch: no log counts 30 years since its own start.
EPOCH_SINCE_NS = 946_684_800_000_000_000
# Longer labels would take the room of the curves.
MAX_LABEL = 24

_FORMULA = re.compile(r"(?:^|(?<=[;\t\r\n]))(?=[-=+@\t\r\n＝＋－＠])")

STATUS_LABELS = {
    "ok": "measured",
    "filled": "filled",
    "few_views": "few views",
    "low_parallax": "low parallax",
    "rejected": "rejected",
    "not_detected": "not detected",
    "no_pose": "no camera pose",
}
STATUS_REASONS = {
    "ok": "reconstructed from views that agree, or placed with the body by a single camera",
    "filled": "the position was filled in between measured ones",
    "few_views": "fewer than two cameras saw the joint at the same time",
    "low_parallax": "the cameras looked along nearly the same line, which leaves the distance undetermined",
    "rejected": "the views disagreed by more than pixel and pose noise explain",
    "not_detected": "the keypoint detector found the joint in no camera",
    "no_pose": "the cameras had no pose at these times",
}
STATUS_REMEDIES = {
    "few_views": "Check that the cameras overlap in time and see the same person.",
    "low_parallax": "The cameras must see the actor from more different directions.",
    "rejected": "Check clocks, mounts and intrinsics, or state a larger pose noise.",
    "not_detected": "Check that the keypoint files belong to these videos, and their first frame number.",
    "no_pose": "Check that the pose logs cover the time of the videos, and the clock offsets.",
}


@dataclass(frozen=True)
class Column:
    """Column of a table: its title, what stands below that, and its alignment."""

    title: str
    small: str = ""
    text: bool = False  # else numbers, on the right
    key: str = ""  # of the status whose colour stands beside the title


@dataclass(frozen=True)
class Table:
    """A table of a page: the first column names the rows."""

    key: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[object]]  # a text, or a pair of it and a smaller one below
    kind: str = ""  # classes of the style sheet

    def without_empty_columns(self) -> Table:
        """Leave out columns in which no row has a value."""
        kept = [k for k in range(len(self.columns)) if any(row[k] not in _EMPTY for row in self.rows)]
        rows = [[row[k] for k in kept] for row in self.rows]
        return replace(self, columns=[self.columns[k] for k in kept], rows=rows)


def with_interval(
    value: float | None, ends: tuple[float, float] | None, digits: int = 1, *, signed: bool = False
) -> tuple[str, str]:
    """Format a mean and its interval, `4.2` and `4.0 to 4.4`; a dash and nothing where there is none."""
    if value is None:
        return ABSENT, ""
    plus = "+" if signed and round(value, digits) > 0 else ""
    return plus + fixed(value, digits), " to ".join(fixed(end, digits) for end in ends or ())


def fixed(value: float | None, digits: int = 1) -> str:
    """Format a number with fixed decimals and grouped thousands, no sign before zero; a dash for None."""
    return ABSENT if value is None else f"{value:z,.{digits}f}".replace(",", THIN).replace("-", "−")


def whole(value: float | None) -> str:
    """Format a count with grouped thousands; a dash for None."""
    return fixed(value, 0)


def significant(value: float) -> str:
    """Format a number with about three significant digits, never in powers of ten above 0.001."""
    if value == 0:
        return "0"
    if not 1e-3 <= abs(value) < 1e9:
        return f"{value:.3g}".replace("-", "−")
    before = len(str(int(abs(value)))) if abs(value) >= 1 else 0
    return fixed(value, max(3 - max(before, 1), 0))


def quantity(value: float | None, unit: str, digits: int = 1) -> str:
    """Format a number and its unit; a dash for None."""
    return ABSENT if value is None else f"{fixed(value, digits)}{THIN}{unit}"


def percent(share: float | None) -> str:
    """Format a share as percent with one decimal; neither 0 nor 100 unless it is exactly that."""
    if share is None:
        return ABSENT
    if 0 < share < 0.0005:
        return f"<{THIN}0.1{THIN}%"
    if 0.9995 <= share < 1:
        return f">{THIN}99.9{THIN}%"
    return quantity(100 * share, "%", 0 if share in {0, 1} else 1)


def plural(count: float, noun: str) -> str:
    """Format a count with its noun: `1 frame`, `2 frames`."""
    return f"{whole(count)} {noun if count == 1 else noun + 's'}"


def listing(words: Iterable[str]) -> str:
    """Join words: `a`, `a and b`, `a, b and c`."""
    *most, last = list(words) or [""]
    return f"{', '.join(most)} and {last}" if most else last


def shortened(label: str) -> str:
    """Shorten a name for a figure's label: printable, on one line, cut in the middle if it is long."""
    clean = "".join(c if c.isprintable() else " " for c in label).strip()
    half = (MAX_LABEL - 1) // 2
    return clean if len(clean) <= MAX_LABEL else f"{clean[:half]}…{clean[-half:]}"


def cell_text(value: object) -> object:
    """Return a CSV's cell such that no spreadsheet takes its text for a formula; numbers stay as they are.

    OWASP, "CSV Injection": a single quote before =, +, -, @, tab, carriage return, line feed and the
    full-width forms of the first four, also after semicolons, tabs and line breaks, where cells may begin.
    """
    return _FORMULA.sub("'", value) if isinstance(value, str) else value


def joint_label(name: str) -> str:
    """Write `left_big_toe` as `left big toe`."""
    return name.replace("_", " ")


def moment(t_ns: int | None) -> str:
    """Format a stamp as a date in UTC if it counts from the epoch, else as seconds of the log's clock."""
    if t_ns is None:
        return ABSENT
    if t_ns < EPOCH_SINCE_NS:
        return f"{fixed(t_ns / 1e9, 3)}{THIN}s on the log's own clock"
    seconds, rest = divmod(t_ns, 1_000_000_000)
    stamp = datetime.fromtimestamp(seconds, UTC)
    return f"{stamp:%Y-%m-%d %H:%M:%S}.{rest // 1_000_000:03d} UTC"


def flattened(value: object, prefix: str = "") -> list[tuple[str, str]]:
    """Flatten nested settings to rows of a dotted name and a text, in their own order."""
    if isinstance(value, Mapping):
        if not value:
            return [(prefix, "none")] if prefix else []
        return [
            row
            for key, inner in value.items()
            for row in flattened(inner, f"{prefix}.{key}" if prefix else str(key))
        ]
    return [(prefix, plain(value))]


def plain(value: object) -> str:
    """Format a value of JSON for a reader."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(plain(v) for v in value) or "none"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {plain(inner)}" for key, inner in value.items()) or "none"
    return str(value)


def environment() -> Environment:
    """Make the templates' environment: all inputs are escaped, and a missing one is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    made = Environment(
        loader=PackageLoader("pipelines.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters.update(
        fixed=fixed, whole=whole, percent=percent, kind_of=lambda it: type(it).__name__, markup=Markup
    )
    return made
