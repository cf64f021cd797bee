"""Cost and order of imports, which only a fresh process can show."""

import ast
import re
import resource
import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

from pipelines.session.errors import DataError
from pipelines.session.registries import install_command, need
from tests.commands.runner import MOCAP

# Without the order set in pipelines/__init__.py, this hangs or aborts if pycolmap is imported first.
PNG_AFTER_PYCOLMAP = """
import pipelines
import pycolmap
import zlib, cv2, numpy
data = numpy.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=numpy.uint8)
ok, png = cv2.imencode(".png", data)
assert ok and (cv2.imdecode(png, cv2.IMREAD_COLOR) == data).all()
assert zlib.decompress(zlib.compress(data.tobytes())) == data.tobytes()
"""

NO_TERMINAL_IN_PIPELINES = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("click", "rich"):
            raise ImportError(name)
sys.meta_path.insert(0, Refuse())
import pipelines.ingest, pipelines.reconstruct, pipelines.report, pipelines.export, pipelines.survey
import pipelines.replan, pipelines.simulate, pipelines.study
"""

LIGHT_HELP = """
import sys
import mocap_cli.main
heavy = {"numpy", "pandas", "scipy", "cv2", "numba", "matplotlib", "pycolmap", "pyarrow", "rich"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""


def run(code: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr


def test_png_encoding_survives_pycolmap() -> None:
    run(PNG_AFTER_PYCOLMAP)


def test_pipelines_run_without_the_terminal_libraries() -> None:
    run(NO_TERMINAL_IN_PIPELINES)


def test_help_loads_nothing_heavy() -> None:
    run(LIGHT_HELP)


def test_help_costs_at_most_300_ms_more_than_python_itself() -> None:
    """Compare the least CPU seconds of several runs, because a busy machine slows every run."""

    def least_s(command: list[str]) -> float:
        return min(_cpu_s_of(command) for _ in range(5))

    assert least_s([MOCAP, "--help"]) - least_s([sys.executable, "-c", "pass"]) < 0.3


def _cpu_s_of(command: list[str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, capture_output=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


ROOT = Path(__file__).resolve().parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
ALTERNATIVES = {"onnxruntime-gpu"}  # builds of a library of ours that pages name beside it


def name_of(requirement: str) -> str:
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert found, requirement
    return re.sub(r"[-_.]+", "-", found[0]).lower()


def users_libraries() -> set[str]:
    """List the libraries that users install, without those for tests and pages."""
    listed = [PROJECT["dependencies"], *(EXTRAS[extra] for extra in EXTRAS.keys() - {"dev", "docs"})]
    return {name_of(requirement) for requirements in listed for requirement in requirements}


def calls() -> list[tuple[str, str]]:
    """Find module and extra of every call of `need` in the program."""
    found = []
    for path in sorted((ROOT / "pipelines").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "need(" in text else ():
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "need":
                module, extra = (ast.literal_eval(argument) for argument in node.args)
                found.append((module, extra))
    return sorted(set(found))


def test_hints_install_the_libraries_that_are_imported() -> None:
    distributions = packages_distributions()
    for module, extra in calls():
        command, *requirements = shlex.split(install_command(extra).removeprefix("pip "))
        assert command == "install"
        assert sorted(requirements) == sorted(EXTRAS[extra])
        brought = {name_of(requirement) for requirement in requirements}
        assert brought & {name_of(name) for name in distributions[module.partition(".")[0]]}, module


def test_what_is_missing_is_one_line_with_the_command() -> None:
    with pytest.raises(DataError) as caught:
        need("pyulog.no_such_part", "drones")
    assert str(caught.value).endswith(f"`{install_command('drones')}`")
    with pytest.raises(ValueError, match="'dron'"):
        install_command("dron")


def test_every_command_on_a_page_names_what_there_is() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    sources = sorted((ROOT / "pipelines").rglob("*.py")) + sorted((ROOT / "mocap_cli").rglob("*.py"))
    named = []
    for path in pages + sources:
        for words in re.findall(r"pip install ([^`\n]+)`", path.read_text(encoding="utf-8")):
            if "{" not in words:  # those are made from pyproject.toml, see above
                named += [(path.name, name_of(word)) for word in shlex.split(words)]
    assert len(named) > 5
    known = users_libraries() | ALTERNATIVES
    unknown = [(page, name) for page, name in named if name not in known]
    assert not unknown  # and this package, which is on no index, is none of them
