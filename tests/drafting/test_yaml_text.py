from __future__ import annotations

from decimal import Decimal
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

from pipelines.drafting.manifest_text import commented, entry, flow

# Lone surrogates cannot be written to a file at all: names with them are left out before.
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=60)


def loaded(text: str) -> Any:
    return YAML(typ="safe", pure=True).load(text)


HOSTILE = [
    *("", " a", "a ", "true", "No", "null", "~", "1e5", "0x10", "1_000", "12:30:45", "2026-01-01", ".inf"),
    *("=", "<<", "---", "- a", "a: b", "a #b", "{a}", "[a", "*a", "&a", "!a", "'a", '"a', "%a", "@a", "`a"),
    *("a\\nb", "a\nb", "a\tb", "a\x00b", "a\x1b[2J", "a\u2028b", "a\x85b", "\ufeffa", "\U0001f600"),
]


@pytest.mark.parametrize("text", HOSTILE)
def test_texts_that_yaml_takes_for_something_else_read_back(text: str) -> None:
    assert loaded(f"key: {flow(text)}")["key"] == text
    assert loaded(flow({"a": [text, {text: text}]})) == {"a": [text, {text: text}]}
    assert len(flow(text).splitlines()) == 1


@pytest.mark.parametrize("text", ["drone1.mp4", "../a/b.json", "logs/drone 1.bag", "/drone1/odometry"])
def test_usual_names_stay_plain(text: str) -> None:
    assert flow(text) == text


@given(TEXT, TEXT)
def test_any_text_reads_back_whatever_the_comment(text: str, comment: str) -> None:
    line = entry("key", {"path": text, "list": [text]}, comment)
    assert len(line.splitlines()) == 1
    assert loaded(f"{line}\nnext: 1\n") == {"key": {"path": text, "list": [text]}, "next": 1}


def test_numbers_are_written_exactly() -> None:
    assert flow({"start": Decimal("1700000000.125"), "fps": 30, "on": True}) == (
        '{start: 1700000000.125, fps: 30, "on": true}'
    )


def test_comments_end_with_their_line() -> None:
    assert commented("a: 1", "x\ncameras: {}\x1b[31m") == "a: 1  # x cameras: {} [31m"
    assert commented("a: 1", "") == "a: 1"
