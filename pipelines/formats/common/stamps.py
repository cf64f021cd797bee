"""Conversion of time stamps between text and int64 nanoseconds, without any float in between.

A float64 holds 1700000000.123456789 s only to 0.2 us, so seconds are read as text and split at the dot.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import ROUND_HALF_UP, Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.arrays import Bool
from pipelines.session.errors import DataError
from pipelines.session.records import Int64

if TYPE_CHECKING:
    import pyarrow as pa


SECONDS, MILLISECONDS, MICROSECONDS, NANOSECONDS = 9, 6, 3, 0
"""Units of time, each as the power of ten by which it exceeds a nanosecond."""

_UNITS = {"s": SECONDS, "sec": SECONDS, "ms": MILLISECONDS, "us": MICROSECONDS, "ns": NANOSECONDS}
_STAMP_NAMES = {"t", "time", "timestamp", "stamp"}
_LARGEST = 2**63 - 1


def parse_stamps(
    source: Path | str, texts: Sequence[str] | pa.ChunkedArray, unit: int = SECONDS
) -> tuple[Int64, Bool]:
    """Parse stamps as nanoseconds, rounded to the nearest (halves away from zero).

    Args:
        source: the file, for messages.
        texts: [N] decimal numbers, with an exponent or without.
        unit: SECONDS, MILLISECONDS, MICROSECONDS or NANOSECONDS.

    Returns:
        [N] nanoseconds (0 if the text is unusable), and [N] True if the text is a finite number that
        int64 nanoseconds can hold.

    Raises:
        DataError: most stamps are too large for the unit (after the year 2262), so the unit is wrong.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    column = texts if isinstance(texts, pa.ChunkedArray) else pa.chunked_array([pa.array(texts, pa.string())])
    column = pc.utf8_trim_whitespace(pc.fill_null(column, ""))
    t_ns, readable = _parse_plain(column, unit)
    too_large: list[Decimal] = []
    for index in np.flatnonzero(~readable):
        value = _decimal(column[int(index)].as_py())
        if value is None:
            continue
        exact = value.scaleb(unit)
        if abs(exact) > _LARGEST:
            too_large.append(abs(value))
            continue
        t_ns[index] = int(exact.to_integral_value(ROUND_HALF_UP))
        readable[index] = True
    if len(too_large) > np.count_nonzero(readable):
        raise _wrong_unit(source, sorted(too_large)[len(too_large) // 2])
    return t_ns, readable


def _parse_plain(column: pa.ChunkedArray, unit: int) -> tuple[Int64, Bool]:
    """Parse the stamps without an exponent, vectorised: sign, digits, dot, digits."""
    import pyarrow as pa
    import pyarrow.compute as pc

    parts = pc.extract_regex(column, r"^(?P<sign>[+-]?)(?P<whole>\d*)\.?(?P<fraction>\d*)$")
    sign, whole, fraction = (pc.fill_null(pc.struct_field(parts, [k]), "") for k in range(3))
    digits = pc.add(pc.utf8_length(whole), pc.utf8_length(fraction))
    # Below 10 ** (18 - unit) whole units nothing overflows; 10 digits suffice for today's seconds.
    safe_whole = pc.less_equal(pc.utf8_length(whole), 18 - unit if unit < SECONDS else 10)
    plain = np.asarray(pc.and_(pc.greater(digits, 0), safe_whole).to_numpy(), dtype=np.bool_)

    def integers(text: pa.ChunkedArray) -> Int64:
        held = pc.if_else(pa.chunked_array([pa.array(plain)]), text, "0")
        return np.asarray(pc.cast(held, pa.int64()).to_numpy(), dtype=np.int64)

    one_more = pc.utf8_slice_codeunits(pc.utf8_rpad(fraction, unit + 1, "0"), 0, unit + 1)
    units = integers(pc.if_else(pc.equal(whole, ""), "0", whole))
    plain &= units < _LARGEST // 10**unit
    magnitude = np.where(plain, units, 0) * 10**unit + (integers(one_more) + 5) // 10
    negative = np.asarray(pc.equal(sign, "-").to_numpy(), dtype=np.bool_)
    return np.where(plain, np.where(negative, -magnitude, magnitude), 0), plain


def _decimal(text: str) -> Decimal | None:
    try:
        value = Decimal(text)
    except InvalidOperation:
        return None
    # An exponent of billions would make an integer of as many digits.
    return value if value.is_finite() and abs(value.adjusted()) < 40 else None


def _wrong_unit(source: Path | str, typical: Decimal) -> DataError:
    unit = "nanoseconds" if typical > 10**17 else "microseconds" if typical > 10**14 else "milliseconds"
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


def stamp_column(header: Sequence[str]) -> tuple[int, int] | None:
    """Find the time column and its unit: t, time, timestamp or stamp, with _ns or [ns] and so on.

    A heading without a unit means seconds. If there are several columns, the finest unit is taken.
    """
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
