"""Cache of compiled code: found again, damaged, or not writable."""

import importlib
import importlib.util
import inspect
import logging
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from pipelines import precompile
from pipelines.geometry import compilation
from pipelines.geometry.compilation import (
    EVERY_PROCESSOR,
    LOGGER,
    _Announcement,
    cached,
    dispatcher_of,
    has_every_feature,
)
from pipelines.precompile import Outcome, compile_function, entry_of, listed, type_of
from pipelines.session.progress import Silent

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


@pytest.mark.parametrize("left", [None, "# nothing any more"], ids=["no module", "no name"])
def test_a_cache_whose_types_moved_to_another_module_is_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: str | None
) -> None:
    """Read a cache as after an update: its index names types in their old modules."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    kind = "from typing import NamedTuple\n\nclass Pair(NamedTuple):\n    a: float\n    b: float\n"
    outermost = "from pipelines.geometry.compilation import cached\n\n@cached\ndef add(pair):\n"

    def add(module: str) -> float:
        (tmp_path / f"{module}.py").write_text(kind)
        body = f"from {module} import Pair\n{outermost}    return pair.a + pair.b\n"
        (tmp_path / "adding.py").write_text(body)
        for name in ("earlier_kinds", "later_kinds", "adding"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        adding = importlib.import_module("adding")
        total: float = adding.add(adding.Pair(1.0, 2.0))
        return total

    assert add("earlier_kinds") == 3.0
    (tmp_path / "earlier_kinds.py").unlink()
    if left is not None:
        (tmp_path / "earlier_kinds.py").write_text(left)
    assert add("later_kinds") == 3.0


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


def test_the_first_compilation_of_a_process_is_announced_and_no_other(
    load_quarter: Callable[[], Callable[[float], float]],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(_Announcement, "_done", False)
    for listener in importlib.import_module("numba.core.event")._registered["numba:compile"]:
        if isinstance(listener, _Announcement):
            monkeypatch.setattr(listener, "_done", False)
    with caplog.at_level(logging.INFO, logger=LOGGER.name):
        load_quarter()(2.0)
        load_quarter()(2)  # another type is compiled as well
    assert [record.name for record in caplog.records] == [LOGGER.name]


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
            dispatcher = dispatcher_of(sys.modules["quarters"].quarter)
            os._exit(sum(dispatcher.stats.cache_misses.values()) if right else 100)
        children.append(child)
    os.close(begin)
    misses = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    os.close(began)
    assert sorted(misses) == [0, 0, 0, 1]


def test_what_was_compiled_ahead_is_found_in_the_cache(
    load_quarter: Callable[[], Callable[[float], float]],
) -> None:
    load_quarter()
    assert compile_function("quarters:quarter", [["float64"]]) is Outcome.COMPILED
    load_quarter()
    assert compile_function("quarters:quarter", [["float64"]]) is Outcome.CACHED


def test_a_function_is_compiled_once_its_code_is_in_the_cache(
    load_quarter: Callable[[], Callable[[float], float]],
) -> None:
    quarter = load_quarter()
    assert not precompile.is_compiled("quarters:quarter")
    quarter(2.0)
    assert precompile.is_compiled("quarters:quarter")
    assert precompile.is_compiled("quarters:gone")  # nothing that could be compiled ahead


SHIPPING = """
import sys
from pathlib import Path
from pipelines.geometry import compilation
compilation.SHIPPED = Path("shipped").absolute()
sys.path.insert(0, "")
from quarters import quarter
known = compilation.has_code(quarter)
assert quarter(2.0) == 0.5
print(known, sum(compilation.dispatcher_of(quarter).stats.cache_misses.values()))
"""


def start(folder: Path, **environment: str) -> str:
    """Run a process with a cache of its own; return if there was code, and how often it compiled."""
    variables = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache"), **environment}
    done = subprocess.run(
        [sys.executable, "-c", SHIPPING],
        cwd=folder,
        env=variables,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


@pytest.mark.skipif(not has_every_feature(), reason="this processor cannot run the code that is shipped")
@pytest.mark.parametrize("change", ["nothing", "source", "index", "data", "numba"])
def test_code_that_comes_with_the_program_is_not_compiled_again(tmp_path: Path, change: str) -> None:
    """Compile for every processor, and start anew, after a change of the source or of the shipped files."""
    source = tmp_path / "quarters.py"
    source.write_text(SOURCE)
    assert start(tmp_path, NUMBA_CPU_NAME=EVERY_PROCESSOR, NUMBA_CPU_FEATURES="") == "False 1"
    [index] = tmp_path.glob("shipped/quarters/*.nbi")
    [data] = tmp_path.glob("shipped/quarters/*.nbc")
    assert not [*tmp_path.glob("cache/**/*.nb[ci]")]
    match change:
        case "source":
            source.write_text(f"{SOURCE}# another line\n")
        case "index" | "data":
            victim = index if change == "index" else data
            victim.write_bytes(victim.read_bytes()[:-20])
        case "numba":
            index.write_bytes(pickle.dumps("0.1", protocol=-1) + b"of another version")
    os.utime(source, ns=(0, 0))  # as after a copy: it is the contents that count
    of_data = change == "data"
    assert start(tmp_path) == ("True 0" if change == "nothing" else f"{of_data} 1")
    assert start(tmp_path) == "True 0"  # what was compiled is in the cache


def test_code_of_functions_that_are_gone_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "SHIPPED", tmp_path)
    name = "pipelines.reconstruction.refinement.kernels:turned"
    function = importlib.import_module(name.partition(":")[0]).turned
    index = compilation._shipped_index(dispatcher_of(function)._cache)
    index.parent.mkdir()
    tag = index.stem.rpartition(".")[2]
    kept = [index, index.with_suffix(".1.nbc"), index.parent / "kernels.turned-1.py39.nbi"]
    gone = [index.parent / f"kernels.turned-1.{tag}.nbi", index.parent / f"kernels.gone-7.{tag}.1.nbc"]
    for path in (*kept, *gone):
        path.touch()
    assert sorted(compilation.outdated_files([function])) == sorted(gone)


@pytest.mark.parametrize(("there", "compiled"), [(0, True), (1, True), (2, False)])
def test_a_stage_compiles_its_own_functions_ahead_where_most_are_missing(
    monkeypatch: pytest.MonkeyPatch, there: int, compiled: bool
) -> None:
    of_stage = ["pipelines.planning.search:a", "pipelines.planning.local:b", "pipelines.planning.local:c"]
    names = [*of_stage, "pipelines.geometry.x:d"]
    done: list[list[str]] = []
    monkeypatch.setattr(precompile, "listed", lambda: {name: [] for name in names})
    monkeypatch.setattr(precompile, "is_compiled", lambda name: name in names[:there])
    monkeypatch.setattr(precompile, "precompile", lambda _workers, _progress, some: done.append(some))
    precompile.precompile_for("replan", Silent())
    assert done == ([of_stage] if compiled else [])


@pytest.mark.parametrize("entry", ["float64 1A", "float64"])
def test_a_list_older_than_the_code_is_named_without_a_traceback(
    load_quarter: Callable[[], Callable[[float], float]], entry: str
) -> None:
    load_quarter()
    name = "quarters:quarter" if entry != "float64" else "quarters:gone"
    assert compile_function(name, [[entry, entry]]) is Outcome.OUTDATED


@pytest.mark.parametrize("name", sorted(listed()))
def test_the_list_names_functions_with_their_arguments(name: str) -> None:
    """Compare with the code; a list that lags behind it costs time at the first use, and nothing else."""
    module, _, function = name.partition(":")
    compiled = dispatcher_of(getattr(importlib.import_module(module), function))
    for signature in listed()[name]:
        assert len(signature) == len(inspect.signature(compiled.py_func).parameters)
        assert [entry_of(type_of(entry)) for entry in signature] == signature
