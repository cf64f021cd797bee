import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.reporting.wording import (
    THIN,
    cell_text,
    fixed,
    listing,
    moment,
    percent,
    plural,
    shortened,
    significant,
)


@given(st.floats(0, 1))
def test_percent_is_never_rounded_to_an_end(share: float) -> None:
    assert (percent(share) in {f"0{THIN}%", f"100{THIN}%"}) == (share in {0, 1})


@given(st.text())
def test_shortened_fits_a_label(name: str) -> None:
    label = shortened(name)
    assert len(label) <= 24
    assert label.isprintable()


@pytest.mark.parametrize("start", "=+-@\t\r\n＝＋－＠")
def test_texts_of_cells_are_no_formulas(start: str) -> None:
    assert cell_text(f"{start}1") == f"'{start}1"
    assert cell_text(f"a{start}1") == f"a{start}1"
    assert cell_text(f"a;{start}1") == f"a;'{start}1"
    assert cell_text(-1.5) == -1.5
    assert cell_text(None) is None


def test_numbers() -> None:
    assert fixed(1234567.89) == f"1{THIN}234{THIN}567.9"
    assert fixed(-0.5) == "−0.5"
    assert fixed(-0.04) == "0.0"
    assert fixed(None) == "–"
    assert significant(12345.6) == f"12{THIN}346"
    assert significant(0.0123) == "0.01"
    assert significant(1.5e-7) == "1.5e−07"
    assert plural(1, "frame") == "1 frame"
    assert plural(2000, "frame") == f"2{THIN}000 frames"
    assert listing(["a", "b", "c"]) == "a, b and c"
    assert listing([]) == ""


def test_moment_tells_the_epoch_from_a_clock_of_its_own() -> None:
    assert moment(1_700_000_000_123_000_000) == "2023-11-14 22:13:20.123 UTC"
    assert moment(12_500_000_000).startswith(f"12.500{THIN}s ")
