"""Crafted files are read or refused in little time and memory: some classes of `tests.fuzz --crafted`."""

from itertools import chain, islice
from pathlib import Path

from pipelines.session.registries import FORMATS
from tests.fuzz.attacking import MOST_MB, MOST_S, attack
from tests.fuzz.crafted import Crafted, crafted
from tests.fuzz.foreign import KINDS, foreign
from tests.fuzz.fuzzing import format_of, fuzz
from tests.fuzz.reading import read_or_refuse
from tests.fuzz.seeds import SEEDS, sown

QUICK = ("messages: JSON and protobuf", "videos: boxes")
REFUSED_AT_ONCE = {"other telemetry": 1, "ROS 1: records": 3, "YAML: calibrations": 2}
"""Number of the first inputs of a class that are refused by a count, before any of their content is read."""


def test_quick_classes_make_no_trouble(tmp_path: Path) -> None:
    def write(folder: Path) -> None:
        (folder / "a.tum").write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n", encoding="utf-8")

    sound = Crafted("sound", "a trajectory", "tum", write, "a.tum")
    counted = [list(islice(crafted([kind]), number)) for kind, number in REFUSED_AT_ONCE.items()]
    first, *met = attack(chain([sound], *counted, crafted(QUICK)), tmp_path)
    assert (first.read, first.refused, first.trouble) == (2, 0, "")
    assert 50 < first.mb < MOST_MB
    assert {each.kind for each in met} == {*QUICK, *REFUSED_AT_ONCE}
    assert not any(each.read for each in met if each.kind in REFUSED_AT_ONCE)
    assert [(each.what, each.trouble) for each in met if each.trouble] == []
    hiding = {f"mdhd: a time scale of {scale}" for scale in (0, 1, 2**32 - 1)}  # one picture of 15
    assert {each.what for each in met if each.refused and not each.read} >= hiding
    assert max(each.cpu_s for each in met) < MOST_S
    assert max(each.mb for each in met) < MOST_MB


SHORT = 60


def test_every_format_is_fuzzed_and_every_seed_is_sound(tmp_path: Path) -> None:
    assert {format_of(name) for name in SEEDS} >= set(FORMATS.names())
    for name, path in sown(tmp_path).items():
        read, _ = read_or_refuse(path, format_of(name))
        assert read, name


def test_damaged_files_are_read_or_refused(tmp_path: Path) -> None:
    met = list(fuzz(tmp_path, SHORT))
    assert [each for each in met if each.trouble] == []
    read = sum(each.read for each in met)
    assert read > SHORT // 4, "damage that nothing survives tests the first line of a reader alone"
    assert sum(each.refused for each in met) > SHORT // 4


def test_foreign_sessions_and_flights_are_harmless(tmp_path: Path) -> None:
    met = list(foreign(tmp_path, [0, 1, 2, 3, 4, 5, 6, 7, 8, 17]))  # two of each class
    assert {each.kind for each in met} == set(KINDS)
    assert [each for each in met if each.trouble] == []
