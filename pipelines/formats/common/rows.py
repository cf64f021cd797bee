"""Rows of text tables and logs: numbers, time stamps, and the rows that are dropped."""

import csv
import re
from bisect import bisect_left
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from decimal import ROUND_HALF_UP, Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.session.errors import DataError

SECONDS, MILLISECONDS, MICROSECONDS, NANOSECONDS = 9, 6, 3, 0
"""Units of time, each as the power of ten by which it exceeds a nanosecond."""

_UNITS = {"s": SECONDS, "sec": SECONDS, "ms": MILLISECONDS, "us": MICROSECONDS, "ns": NANOSECONDS}
_STAMP_NAMES = {"t", "time", "timestamp", "stamp", "utc", "datetime", "gps_time", "utc_time", "unix_time"}
_SPLIT_STAMP = re.compile(r"(?:(?:header_)?(?:t|time|timestamp|stamp)_)?(secs?|nsecs?|nanosecs?)")
# Stamps are int64, and this is its largest number.
_LARGEST = 2**63 - 1
_DATE = re.compile(r"(\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d)(?:[.,](\d{1,9}))?(Z|[+-]\d\d:?\d\d)?")
# Stamps count from this moment.
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}
"""Units of length, in metres."""

NORM_TOLERANCE = 0.1
"""Largest deviation of a quaternion from unit length: up to this rounding explains it, beyond not."""

GAP_STEPS = 5
"""A gap is a step of more than this many median steps."""


@dataclass(frozen=True)
class TextTable:
    """Columns of a text file: numbers as float64 with NaN for blank cells, the rest as text."""

    text: dict[str, pa.ChunkedArray]
    numbers: dict[str, Float]
    truncated: int  # 1 if the last line was incomplete and was left out

    def stack(self, names: Sequence[str]) -> Float:
        """Return some number columns side by side, [N, len(names)]."""
        return np.stack([self.numbers[name] for name in names], axis=-1)


def parse_table(
    path: Path,
    body: str,
    *,
    delimiter: str,
    columns: int,
    text: dict[str, int],
    numbers: dict[str, int],
    first_line: int,
) -> TextTable:
    """Read delimited rows of `columns` cells; blank lines and lines that begin with # are skipped.

    A last line that does not parse is counted in `truncated`. Where commas do not separate cells and the
    first row has no dot but in a date, commas before digits are decimal. `text` and `numbers` map names to
    columns; blank and "nan" are NaN.
    """
    body = re.sub(r"\n[ \t]*#[^\n]*", "\n", "\n" + body)[1:]
    if delimiter in ";\t" and "." not in _DATE.sub("", (body.strip() + "\n").partition("\n")[0]):
        body = re.sub(r",(?=\d)", ".", body)
    wanted = {**text, **numbers}
    for truncated in (0, 1):
        try:
            table = _parse_csv(body, delimiter, columns, text, numbers)
        except pa.ArrowInvalid as error:
            lines = body.rstrip().split("\n")
            bad = _first_bad_line(lines, delimiter, columns, numbers)
            if truncated or bad is None or bad[0] < len(lines) - 1:
                where, what = bad or (0, str(error).splitlines()[0])
                problem = f"line {first_line + where}: {what}"
                raise DataError(path, problem, "correct or delete that line") from error
            body = "\n".join(lines[:-1])
        else:
            return TextTable(
                text={name: table.column(str(wanted[name])) for name in text},
                numbers={
                    name: np.asarray(table.column(str(wanted[name])).to_numpy(), dtype=np.float64)
                    for name in numbers
                },
                truncated=truncated,
            )
    raise AssertionError("both attempts either return or raise")


def _parse_csv(
    body: str, delimiter: str, columns: int, text: dict[str, int], numbers: dict[str, int]
) -> pa.Table:
    import pyarrow.csv

    types = {str(index): pa.string() for index in text.values()}
    types |= {str(index): pa.float64() for index in numbers.values()}
    if not body.strip():
        return pa.table({name: pa.array([], type=kind) for name, kind in types.items()})
    names = [str(index) for index in range(columns)]
    return pyarrow.csv.read_csv(
        pa.BufferReader(body.encode()),
        # Arrow's threads may still start when a quick command ends, and then abort it.
        read_options=pyarrow.csv.ReadOptions(column_names=names, use_threads=False),
        parse_options=pyarrow.csv.ParseOptions(delimiter=delimiter),
        convert_options=pyarrow.csv.ConvertOptions(column_types=types, include_columns=list(types)),
    )


def _first_bad_line(
    lines: Sequence[str], delimiter: str, columns: int, numbers: dict[str, int]
) -> tuple[int, str] | None:
    """Return the index of the first line that is no valid row, and its problem; None if all are valid."""
    for index, line in enumerate(lines):
        if not line.strip():
            continue
        try:
            cells = next(csv.reader([line], delimiter=delimiter), [])
        except csv.Error as error:  # most often a cell of more than 131072 characters
            return index, str(error)
        if len(cells) != columns:
            return index, f"{len(cells)} columns instead of {columns}"
        for name, column in numbers.items():
            try:
                float(cells[column] or "nan")
            except ValueError:
                return index, f"{cells[column][:40]!r} is not a number ({name})"
    return None


def parse_stamps(
    source: Path | str,
    texts: Sequence[str] | pa.ChunkedArray,
    unit: int = SECONDS,
    *,
    unit_stated: bool = True,
) -> tuple[Int64, Bool]:
    """Parse decimal stamps [N] as nanoseconds, rounded to the nearest (halves away from zero).

    The result is 0 where the second array is False: the text is no finite number that int64 nanoseconds can
    hold. If the file does not state its unit, stamps after the year 2262 are read in the unit in which they
    are not. Dates with times by ISO 8601 are read whatever the unit; without a zone they are UTC.
    """
    cells = texts if isinstance(texts, Sequence) else texts.to_pylist()
    t_ns, readable = np.zeros(len(cells), np.int64), np.zeros(len(cells), np.bool_)
    too_large: list[Decimal] = []
    for index, cell in enumerate(cells):
        text = (cell or "").strip()
        value = _decimal(text)
        exact = _date_ns(text) if value is None else int(value.scaleb(unit).to_integral_value(ROUND_HALF_UP))
        if exact is not None and abs(exact) <= _LARGEST:
            t_ns[index], readable[index] = exact, True
        elif value is not None:
            too_large.append(abs(value))
    if len(too_large) > np.count_nonzero(readable):
        typical = sorted(too_large)[len(too_large) // 2]
        if not unit_stated and typical < 10**20:
            return parse_stamps(source, cells, _likely_unit(typical))
        raise _wrong_unit(source, typical)
    return t_ns, readable


def since_epoch_ns(moment: datetime) -> int:
    """Return the ns since 1970 of a moment with a zone, exact to its microseconds."""
    return (moment - _EPOCH) // timedelta(microseconds=1) * 1000


def _date_ns(text: str) -> int | None:
    """Parse a date with a time by ISO 8601, also with a blank for the T, as ns since the epoch, or None."""
    match = _DATE.fullmatch(text)
    if match is None:
        return None
    try:
        whole = datetime.fromisoformat(match[1].replace(" ", "T") + (match[3] or "+00:00"))
    except ValueError:
        return None
    t_ns = since_epoch_ns(whole) + int((match[2] or "0").ljust(9, "0"))
    return t_ns if abs(t_ns) <= _LARGEST else None


def _decimal(text: str) -> Decimal | None:
    try:
        value = Decimal(text)
    except InvalidOperation:
        return None
    # An exponent of billions would make an integer of as many digits.
    return value if value.is_finite() and abs(value.adjusted()) < 40 else None


def _likely_unit(typical: Decimal) -> int:
    """Return the unit in which a stamp too large for seconds is a time of our days."""
    return NANOSECONDS if typical > 10**17 else MICROSECONDS if typical > 10**14 else MILLISECONDS


def _wrong_unit(source: Path | str, typical: Decimal) -> DataError:
    unit = {NANOSECONDS: "nanoseconds", MICROSECONDS: "microseconds"}.get(
        _likely_unit(typical), "milliseconds"
    )
    return DataError(
        source,
        f"time stamps of about {typical:.3g} are too large for their unit; they look like {unit}",
        "convert them, or save a CSV whose column is named t_ns, t_us or t_ms",
    )


def format_seconds(t_ns: Int64) -> list[str]:
    """Format stamps as seconds with nine decimals, exactly."""
    return [f"{'-' * (t < 0)}{abs(t) // 10**9}.{abs(t) % 10**9:09d}" for t in t_ns.tolist()]


def cell_name(cell: str) -> tuple[str, str]:
    """Split a column heading into lower-case name and unit: "#timestamp [ns]" is ("timestamp", "ns")."""
    match = re.fullmatch(
        r"#?\s*[\"']?([^\[(\"']*?)\s*(?:[\[(]([^\])]*)[\])])?\s*[\"']?", cell.strip().lower()
    )
    if match is None:
        return cell.strip().lower(), ""
    return re.sub(r"[./\s]+", "_", match[1]).strip("_"), (match[2] or "").strip()


@dataclass(frozen=True)
class Heading:
    """Line above a table that names its columns, the time among them."""

    line: int  # its index in the file
    delimiter: str
    columns: int
    stamp: int  # the time's column
    unit: int  # the time's
    names: dict[str, int]  # columns by the names of `cell_name`; the first of each name
    nanoseconds: int | None = None  # column of the nanoseconds beside whole seconds in the time's column
    unit_stated: bool = True  # False if seconds are only assumed


def find_heading(line: str, index: int = 0, delimiters: str = ",;\t") -> Heading | None:
    """Parse a line as a heading, separated by the first of the delimiters in it; None if it names no time."""
    delimiter = next((mark for mark in delimiters if mark in line), delimiters[0])
    cells = line.split(delimiter)
    stamp = stamp_column(cells)
    names: dict[str, int] = {}
    for column, cell in enumerate(cells):
        names.setdefault(_plain_name(cell), column)
    if stamp is None:
        return None
    name, unit = cell_name(cells[stamp[0]])
    stated = bool(unit) or name not in _STAMP_NAMES or stamp[1] != SECONDS
    return Heading(index, delimiter, len(cells), *stamp, names, _column_of_nanoseconds(cells), stated)


def rows_below(
    path: Path, heading: Heading, text: str, columns: dict[str, int], numbers: dict[str, int]
) -> TextTable:
    """Apply `parse_table` to the rows of a text below its heading; the stamps are the text column "stamp".

    Whole seconds and their nanoseconds in a column of their own become one number.
    """
    lines = text.split("\n", heading.line + 1)
    split = {} if heading.nanoseconds is None else {"nanoseconds": heading.nanoseconds}
    table = parse_table(
        path,
        lines[-1] if len(lines) > heading.line + 1 else "",
        delimiter=heading.delimiter,
        columns=heading.columns,
        text={"stamp": heading.stamp, **split, **columns},
        numbers=numbers,
        first_line=heading.line + 2,
    )
    if split:
        table.text["stamp"] = _joined(table.text["stamp"], table.text.pop("nanoseconds"))
    return table


def _joined(seconds: pa.ChunkedArray, nanoseconds: pa.ChunkedArray) -> pa.ChunkedArray:
    """Join whole seconds and nanoseconds to decimal seconds; blank where one of them is no whole number."""
    whole, rest = (
        pc.replace_substring_regex(pc.utf8_trim_whitespace(column), r"\.0*$", "")
        for column in (seconds, nanoseconds)
    )
    valid = pc.and_(pc.match_substring_regex(whole, r"^\d+$"), pc.match_substring_regex(rest, r"^\d{1,9}$"))
    return pc.if_else(valid, pc.binary_join_element_wise(whole, pc.utf8_lpad(rest, 9, "0"), "."), "")


def _column_of_nanoseconds(header: Sequence[str]) -> int | None:
    """Find the column of nanoseconds that belongs to whole seconds; None if the time has one column."""
    split = _split_stamp(header)
    return split[1] if split and _whole_stamp(header) is None else None


def _split_stamp(header: Sequence[str]) -> tuple[int, int] | None:
    """Find columns `sec` and `nanosec` (also secs, nsecs; alone, or behind stamp_ or header_stamp_)."""
    found: dict[bool, int] = {}
    for index, cell in enumerate(header):
        if match := _SPLIT_STAMP.fullmatch(_plain_name(cell)):
            found.setdefault(match[1].startswith("n"), index)
    return (found[False], found[True]) if len(found) == 2 else None


def _plain_name(cell: str) -> str:
    """Return the name of a column without the `field.` that `rostopic echo -p` writes before it."""
    return cell_name(cell)[0].removeprefix("field_")


def stamp_column(header: Sequence[str]) -> tuple[int, int] | None:
    """Find the time column and its unit: t, time, timestamp or stamp, with _ns or [ns] and so on.

    Of several the finest unit is taken. A table of `rostopic echo -p` has `field.header.stamp`, else `%time`,
    in ns. Without any of them, `sec` beside `nanosec` counts.
    """
    if (whole := _whole_stamp(header)) is not None:
        return whole
    split = _split_stamp(header)
    return (split[0], SECONDS) if split else None


def _whole_stamp(header: Sequence[str]) -> tuple[int, int] | None:
    if header and header[0].strip() == "%time":
        return next(
            (k for k, cell in enumerate(header) if cell.strip() == "field.header.stamp"), 0
        ), NANOSECONDS
    found: dict[int, int] = {}
    for index, cell in enumerate(header):
        name, unit = cell_name(cell)
        base, _, suffix = name.rpartition("_")
        if base in _STAMP_NAMES and suffix in _UNITS:
            found.setdefault(_UNITS[suffix], index)
        elif name in _STAMP_NAMES and (unit or "s") in _UNITS:
            found.setdefault(_UNITS[unit or "s"], index)
    if not found:
        return None
    finest = min(found)
    return found[finest], finest


def drop_rows(keep: Bool, bad: Bool, cause: str, dropped: MutableMapping[str, int]) -> None:
    """Remove the bad rows from `keep`, in place, and count those that were still in it."""
    count = int(np.count_nonzero(keep & bad))
    if count:
        dropped[cause] = count
        keep[bad] = False


def kept_rows(
    t_ns: Int64, causes: Mapping[str, Bool], dropped: MutableMapping[str, int], prefix: str = ""
) -> Bool:
    """Mark the usable rows [N]; count the others in `dropped` under the first cause that applies.

    After `causes` come "duplicate stamp" (the first stays) and "stamp out of order", behind `prefix`.
    """
    keep = np.ones(len(t_ns), dtype=np.bool_)
    for cause, bad in causes.items():
        drop_rows(keep, bad, cause, dropped)
    rows = np.flatnonzero(keep)
    if len(rows) > 1:
        stamps = t_ns[rows]
        duplicate, late = np.zeros((2, len(t_ns)), dtype=np.bool_)
        duplicate[rows[1:][stamps[1:] == stamps[:-1]]] = True
        late[rows[~longest_rising(stamps)]] = True
        drop_rows(keep, duplicate, f"{prefix}duplicate stamp", dropped)
        drop_rows(keep, late, f"{prefix}stamp out of order", dropped)
    return keep


def longest_rising(stamps: Int64) -> Bool:
    """Mark the longest strictly rising chain of stamps, so that one wrong stamp costs one row only.

    Patience sorting (Fredman 1975). Of equally long chains, the one with the smallest last stamp is taken.
    """
    if (np.diff(stamps) > 0).all():
        return np.ones(len(stamps), dtype=np.bool_)
    tails: list[int] = []  # smallest last stamp of a chain of each length
    places: list[int] = []  # and the row of that stamp
    before = np.full(len(stamps), -1, dtype=np.int64)
    for place, stamp in enumerate(stamps.tolist()):
        length = bisect_left(tails, stamp)
        if length < len(tails) and tails[length] == stamp:
            continue  # of equal stamps the first stays
        before[place] = places[length - 1] if length else -1
        tails[length : length + 1] = [stamp]
        places[length : length + 1] = [place]
    chain = np.zeros(len(stamps), dtype=np.bool_)
    place = places[-1]
    while place >= 0:
        chain[place] = True
        place = int(before[place])
    return chain


def median_step_ns(t_ns: Int64) -> float | None:
    """Return the median time between rows; None for fewer than two rows."""
    return float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else None


def describe_times(t_ns: Int64) -> dict[str, object]:
    """Return first and last stamp, span, rate, number of gaps and the longest, for rising stamps."""
    if not len(t_ns):
        return {}
    step = median_step_ns(t_ns)
    summary: dict[str, object] = {
        "first_ns": int(t_ns[0]),
        "last_ns": int(t_ns[-1]),
        "span_s": round((int(t_ns[-1]) - int(t_ns[0])) / 1e9, 6),
    }
    if step is not None:
        steps = np.diff(t_ns)
        gaps = steps[steps > GAP_STEPS * step]
        summary["rate_hz"] = round(1e9 / step, 3)
        summary["gaps"] = len(gaps)
        if len(gaps):
            summary["longest_gap_s"] = round(float(gaps.max()) / 1e9, 3)
    return summary


def bounding_box(position: Float) -> dict[str, object]:
    """Return the smallest and largest coordinates of the finite points [N, 3]."""
    finite = position[np.isfinite(position).all(axis=1)]
    if not len(finite):
        return {}
    return {
        "box_min_m": [round(v, 4) for v in finite.min(axis=0).tolist()],
        "box_max_m": [round(v, 4) for v in finite.max(axis=0).tolist()],
    }
