"""The compiled code's cache: found again, damaged, or without a place."""

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from pipelines.geometry.compilation import cached

SOURCE = """
from pipelines.geometry.compilation import cached, helper

@helper
def half(x):
    return 0.5 * x

@cached
def quarter(x):
    return half(half(x))
"""


@pytest.fixture(autouse=True)
def _cache_beside_the_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever the user keeps numba's cache."""
    monkeypatch.setattr("numba.config.CACHE_DIR", "")


@pytest.fixture
def load_quarter(tmp_path: Path) -> Callable[[], Callable[[float], float]]:
    """Import the module anew, as the next process would."""
    path = tmp_path / "quarters.py"
    path.write_text(SOURCE)

    def load() -> Callable[[float], float]:
        spec = importlib.util.spec_from_file_location("quarters", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["quarters"] = module
        spec.loader.exec_module(module)
        quarter: Callable[[float], float] = module.quarter
        return quarter

    return load


def cache_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("quarters.quarter-*") if path.suffix in (".nbi", ".nbc"))


@pytest.mark.parametrize("keep", [0.0, 0.5])
@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_a_cache_file_cut_short_is_compiled_again(
    tmp_path: Path, load_quarter: Callable[[], Callable[[float], float]], suffix: str, keep: float
) -> None:
    assert load_quarter()(2.0) == 0.5
    [victim] = [path for path in cache_files(tmp_path) if path.suffix == suffix]
    whole = victim.read_bytes()
    victim.write_bytes(whole[: int(keep * len(whole))])

    assert load_quarter()(2.0) == 0.5  # compiled for this process, the damaged cache emptied
    assert load_quarter()(2.0) == 0.5  # compiled and kept
    assert victim.stat().st_size > len(whole) / 2


def test_a_function_without_a_place_for_its_cache_still_runs() -> None:
    space: dict[str, Callable[[float], float]] = {}
    exec("def double(x):\n    return 2.0 * x", space)  # noqa: S102  # no file, so numba knows no place

    assert cached(space["double"])(2.0) == 4.0
