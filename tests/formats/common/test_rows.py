"""Time stamps that keep every nanosecond, in every form."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.formats.common.rows import (
    NANOSECONDS,
    SECONDS,
    parse_stamps,
    parse_table,
)
from tests.formats.refusals import refuses

# An epoch stamp in float64 seconds has no room for nanoseconds (its step is 0.2 us).


def test_a_stamp_that_no_float_can_hold_survives() -> None:
    t_ns, readable = parse_stamps("log", ["1700000000.123456789"])
    assert t_ns.tolist() == [1700000000123456789]
    assert readable.all()


@pytest.mark.parametrize(
    ("stamp", "word"),
    [
        ("1700000000000", "milliseconds"),
        ("1700000000000000", "microseconds"),
        ("1700000000000000000", "nanoseconds"),
    ],
)
def test_epoch_stamps_that_are_not_seconds_are_refused(stamp: str, word: str) -> None:
    with refuses("log", word):
        parse_stamps("log", [stamp, stamp])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2023-11-14 22:13:20", 1_700_000_000_000_000_000),
        ("2023-11-14T22:13:20.123456789Z", 1_700_000_000_123_456_789),
        ("2023-11-14T23:13:20,5+01:00", 1_700_000_000_500_000_000),
        ("2023-11-14 16:43:20-0530", 1_700_000_000_000_000_000),
    ],
)
def test_dates_are_stamps_in_any_unit(text: str, expected: int) -> None:
    for unit in (SECONDS, NANOSECONDS):
        t_ns, readable = parse_stamps("log", [text, "2023-13-14 22:13:20"], unit)
        assert (t_ns.tolist(), readable.tolist()) == ([expected, 0], [True, False])


@pytest.mark.parametrize(("body", "expected"), [("1,5;2,25\n-3;4e-1\n", 2.25), ("1.5;2,25\n1.5;2.5\n", None)])
def test_commas_are_decimal_where_they_separate_nothing(body: str, expected: float | None) -> None:
    def read() -> float:
        columns = {"a": 0, "b": 1}
        table = parse_table(
            Path("a.csv"), body, delimiter=";", columns=2, text={}, numbers=columns, first_line=2
        )
        return float(table.numbers["b"][0])

    if expected is None:  # dots and commas in one row: the commas may separate thousands
        with refuses("a.csv", 2):
            read()
    else:
        assert read() == expected


@pytest.mark.parametrize("delimiter", [";", "\t"])
@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (["1,234 5", "2,345 -1,000"], None),  # 1.234 or 1234
        (["2023-11-14 22:13:20,500 1,234"], None),  # a date's comma says nothing of the others
        (["1,234,567 5"], None),
        (["1,234 0,5"], 1.234),
        (["1,234 12,3456"], 1.234),
        (["1,234 1234,567"], 1.234),
        (["1,234 -0,123"], 1.234),
        (["12 5", "1,5 6"], 12),
    ],
)
def test_numbers_whose_commas_may_separate_thousands_are_refused(
    rows: list[str], expected: float | None, delimiter: str
) -> None:
    dated = rows[0].startswith("2023")
    cells = [row.rsplit(" ", 1) for row in rows]
    body = "".join(delimiter.join(row) + "\n" for row in cells)
    text = {"t": 0} if dated else {}
    numbers = {"b": 1} if dated else {"a": 0, "b": 1}

    def read() -> float:
        table = parse_table(
            Path("a.csv"), body, delimiter=delimiter, columns=2, text=text, numbers=numbers, first_line=2
        )
        return float(table.numbers["a"][0])

    if expected is None:
        with refuses("a.csv", "1234" if "567" not in rows[0] else "1234567"):
            read()
    else:
        assert read() == expected
