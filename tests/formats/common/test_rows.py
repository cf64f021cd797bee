"""Time stamps that keep every nanosecond, in every form."""

from pathlib import Path

import pytest

from pipelines.formats.common.rows import NANOSECONDS, SECONDS, parse_stamps, parse_table
from tests.raising import refused

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
    with refused("data", "log", word):
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


def test_commas_are_decimal_where_they_separate_nothing() -> None:
    def read(body: str) -> float:
        columns = {"a": 0, "b": 1}
        table = parse_table(
            Path("a.csv"), body, delimiter=";", columns=2, text={}, numbers=columns, first_line=2
        )
        return float(table.numbers["b"][0])

    assert read("1,5;2,25\n-3;4e-1\n") == 2.25
    with refused("data", "a.csv", 2):  # dots and commas in one row
        read("1.5;2,25\n1.5;2.5\n")
