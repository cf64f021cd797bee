"""The page of formats: a row for every registered format, and the outcome for every real input."""

from __future__ import annotations

import re

import pytest

from benchmarks.formats import BEGIN, END, PAGE, table
from pipelines.session.registries import FORMATS
from tests.real_data import real_data

TEXT = PAGE.read_text(encoding="utf-8")


def test_the_page_has_a_row_for_every_format() -> None:
    before, _, after = TEXT.partition(BEGIN)
    assert END in after
    assert re.findall(r"(?m)^\| `(\w+)` \|", before) == FORMATS.names()


@pytest.mark.slow
def test_every_real_input_has_the_outcome_of_its_row() -> None:
    written = TEXT.partition(BEGIN)[2].partition(END)[0].strip().splitlines()[2:]
    assert written == table(real_data("facts.json").parent), "run python -m benchmarks.formats --write"
