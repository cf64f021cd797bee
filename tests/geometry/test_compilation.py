"""Cache of compiled code: found again, damaged, or not writable."""

import importlib
import importlib.util
import os
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
    """Put numba's cache beside the source, whatever the user has set."""
    monkeypatch.setattr("numba.config.CACHE_DIR", "")


@pytest.fixture
def load_quarter(tmp_path: Path) -> Callable[[], Callable[[float], float]]:
    """Return a function that imports the module again, as the next process would."""
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


def test_a_change_of_a_helper_in_another_file_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Change a helper that is two files away, without a change of its file's length."""
    helper = "from pipelines.geometry.compilation import helper\n\n@helper\ndef "
    (tmp_path / "doubting.py").write_text(f"{helper}doubt(x):\n    return 2.0 * x\n")
    (tmp_path / "passing.py").write_text(
        f"from doubting import doubt\n{helper}pass_on(x):\n    return doubt(x)\n"
    )
    outermost = "from passing import pass_on\nfrom pipelines.geometry.compilation import cached\n"
    (tmp_path / "asking.py").write_text(f"{outermost}@cached\ndef ask(x):\n    return pass_on(x)\n")
    monkeypatch.syspath_prepend(str(tmp_path))

    def ask() -> float:
        for name in ("doubting", "passing", "asking"):
            sys.modules.pop(name, None)
        answer: float = importlib.import_module("asking").ask(1.0)
        return answer

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    assert ask() == 2.0
    helpers = tmp_path / "doubting.py"
    helpers.write_text(helpers.read_text().replace("2.0", "3.0"))
    importlib.invalidate_caches()
    assert ask() == 3.0


def test_a_function_without_a_place_for_its_cache_still_runs() -> None:
    space: dict[str, Callable[[float], float]] = {}
    exec("def double(x):\n    return 2.0 * x", space)  # noqa: S102  # no file, so numba knows no place

    assert cached(space["double"])(2.0) == 4.0


@pytest.mark.parametrize("of_others", [False, True])
def test_where_no_cache_can_be_written_temporary_files_hold_it_unless_others_may_write_them(
    tmp_path: Path,
    load_quarter: Callable[[], Callable[[float], float]],
    monkeypatch: pytest.MonkeyPatch,
    of_others: bool,
) -> None:
    caching = importlib.import_module("numba.core.caching")
    monkeypatch.setattr(
        caching.CacheImpl, "_locator_classes", [caching.UserProvidedCacheLocator], raising=True
    )
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    folder = tmp_path / "tmp" / f"mocap-numba-{os.getuid()}"
    (folder if of_others else folder.parent).mkdir(parents=True, mode=0o755)

    assert load_quarter()(2.0) == 0.5
    assert bool(cache_files(folder)) is not of_others


def test_of_processes_that_start_together_one_compiles(
    load_quarter: Callable[[], Callable[[float], float]],
) -> None:
    began, begin = os.pipe()
    children = []
    for _ in range(4):
        child = os.fork()
        if not child:
            os.close(begin)
            os.read(began, 1)  # until the parent closes its end: all at once
            right = load_quarter()(2.0) == 0.5
            [inner] = [cell.cell_contents for cell in sys.modules["quarters"].quarter.__closure__]
            os._exit(sum(inner.stats.cache_misses.values()) if right else 100)
        children.append(child)
    os.close(begin)
    misses = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    os.close(began)
    assert sorted(misses) == [0, 0, 0, 1]
