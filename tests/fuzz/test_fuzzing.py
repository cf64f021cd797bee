"""Damaged files are read or refused in one line; a short run of `python -m tests.fuzz`."""

import random
from pathlib import Path

import pytest

from pipelines.session.errors import DataError
from pipelines.session.registries import FORMATS
from tests.fuzz import reading
from tests.fuzz.fuzzing import format_of, fuzz
from tests.fuzz.mutations import damaged
from tests.fuzz.reading import NotOneLineError, read_or_refuse
from tests.fuzz.seeds import SEEDS, sown

SHORT = 60


def test_every_format_is_fuzzed_and_every_seed_is_sound(tmp_path: Path) -> None:
    assert {format_of(name) for name in SEEDS} >= set(FORMATS.names())
    for name, path in sown(tmp_path).items():
        read, _ = read_or_refuse(path, format_of(name))
        assert read, name


def test_damaged_files_are_read_or_refused(tmp_path: Path) -> None:
    found = fuzz(tmp_path, SHORT)
    assert not found.troubles, "\n".join(f"{trouble.seed}: {trouble.what}" for trouble in found.troubles)
    assert found.read > SHORT // 4, "damage that nothing survives tests the first line of a reader alone"
    assert found.refused > SHORT // 4


def test_damage_is_the_same_for_the_same_seed_and_is_damage() -> None:
    content = b"t_ns,x\n1,2.5\n2,3.5\n" * 20
    copies = [damaged(content, random.Random(seed)) for seed in range(50)]  # noqa: S311
    assert copies == [damaged(content, random.Random(seed)) for seed in range(50)]  # noqa: S311
    assert sum(copy != content for copy in copies) > 45


def test_what_is_no_refusal_in_one_line_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def on_two_lines() -> None:
        raise DataError("a", "is\nwrong")

    monkeypatch.setattr(reading, "_ways", lambda *_: [on_two_lines])
    with pytest.raises(NotOneLineError):
        read_or_refuse(tmp_path, "tum")
    monkeypatch.setattr(reading, "_ways", lambda *_: [lambda: 1 // 0])
    with pytest.raises(ZeroDivisionError):
        read_or_refuse(tmp_path, "tum")
