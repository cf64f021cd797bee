"""The documentation is true: commands parse, files exist, tables are those of the code, and examples run."""

import argparse
import ast
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any
from unittest.mock import patch

import click
import pytest
from ruamel.yaml import YAML

from mocap_cli.main import mocap
from pipelines.geometry.triangulation import STATUS
from pipelines.session.manifest import Manifest
from pipelines.session.people import SKELETONS
from pipelines.simulation.scenario import Scenario
from tests.synthetic.flights import write_flight

_ROOT = Path(__file__).parents[1]
_DOCS = _ROOT / "docs"
_PAGES = [
    *(_ROOT / name for name in ("README.md", "CONTRIBUTING.md", "sample_data/README.md")),
    *sorted(_DOCS.rglob("*.md")),
]
_FOLDERS = ("benchmarks", "docs", "examples", "mocap_cli", "pipelines", "sample_data", "tests", "tools")
_FENCED = re.compile(r"^```(\w*).*?\n(.*?)^```", re.MULTILINE | re.DOTALL)
_SPAN = re.compile(r"`([^`]+)`")


def _text(page: str) -> str:
    return (_DOCS / page).read_text(encoding="utf-8")


def _spans(text: str) -> list[str]:
    """List the code spans of a page's prose, each on one line."""
    return [" ".join(span.split()) for span in _SPAN.findall(_FENCED.sub("", text))]


def _blocks_of_yaml() -> list[tuple[str, Any]]:
    found = []
    for page in _PAGES:
        for language, block in _FENCED.findall(page.read_text(encoding="utf-8")):
            if language == "yaml":
                found.append((page.name, YAML(typ="safe", pure=True).load(block)))
    return found


# --- commands ------------------------------------------------------------------------------------------
def _commands(page: Path) -> Iterator[tuple[str, bool]]:
    """Yield the commands of a page, and False for a span, which may leave out arguments."""
    text = page.read_text(encoding="utf-8")
    blocks = [block for language, block in _FENCED.findall(text) if language != "yaml"]
    blocks.append("\n".join(re.findall(r"^ {4}(.*)$", _FENCED.sub("", text), re.MULTILINE)))
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    for whole, line in [*((True, line) for line in lines), *((False, span) for span in _spans(text))]:
        for part in re.split(r" && | # |\s{2,}#", line):
            command = re.sub(r"^\s*(\w+=\S+ )*", "", part).strip()
            if re.match(r"(mocap|make|python -m benchmarks\S*|python docs)\b", command):
                yield re.sub(r"[\[\]]", "", command).replace(" N", " 1"), whole


@pytest.mark.parametrize("page", _PAGES, ids=lambda page: str(page.relative_to(_ROOT)))
def test_every_command_is_understood(page: Path) -> None:
    for command, whole in _commands(page):
        program, *words = shlex.split(command, comments=True)
        if program == "mocap":
            _parse_mocap(words, whole=whole)
        elif program == "make":
            targets = re.findall(r"^(\w+):", (_ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
            assert {word for word in words if word.islower()} <= set(targets), command
        elif words[0] == "-m":
            _parse_benchmark(words[1], words[2:])
        else:
            assert (_ROOT / words[0]).is_file(), command


def _parse_mocap(words: list[str], *, whole: bool) -> None:
    """Parse by the real command, for which every path exists."""
    with patch.object(click.Path, "convert", lambda _, value, *__: Path(value)):
        command: click.Command = mocap
        context = click.Context(mocap)
        while isinstance(command, click.Group) and words and not words[0].startswith("-"):
            name, *words = words
            found = command.get_command(context, name)
            assert found is not None, name
            command, context = found, click.Context(found, parent=context, info_name=name)
        try:
            command.make_context(command.name, list(words))
        except click.MissingParameter:
            assert not whole, words
        except click.exceptions.NoArgsIsHelpError:
            pass


class _ParsedError(Exception):
    """Signal that the command line of a benchmark was understood: its work is not done here."""


def _parse_benchmark(module: str, words: list[str]) -> None:
    """Parse by the benchmark's own parser; one without a parser takes no arguments."""
    path = _ROOT / f"{module.replace('.', '/')}.py"
    assert path.is_file(), module
    if "parse_args()" not in path.read_text(encoding="utf-8"):
        assert not words, (module, words)
        return
    parse = argparse.ArgumentParser.parse_args

    def only_parse(parser: argparse.ArgumentParser, *_: object) -> None:
        parse(parser, words)
        raise _ParsedError

    with patch.object(argparse.ArgumentParser, "parse_args", only_parse), pytest.raises(_ParsedError):
        import_module(module).main()


# --- files and links -----------------------------------------------------------------------------------
@pytest.mark.parametrize("page", _PAGES, ids=lambda page: str(page.relative_to(_ROOT)))
def test_every_file_of_the_repository_that_is_named_exists(page: Path) -> None:
    for span in _spans(page.read_text(encoding="utf-8")):
        if not re.fullmatch(r"[\w./-]+", span):
            continue
        folder, *inside = span.split("/")
        if folder in _FOLDERS and inside:
            assert (_ROOT / span).exists(), span
        elif span.endswith(".py"):  # beside or below the stages
            assert any(path.as_posix().endswith(f"/{span}") for path in _modules()), span


def _modules() -> list[Path]:
    return [path for folder in ("pipelines", "mocap_cli") for path in (_ROOT / folder).rglob("*.py")]


def test_the_walk_names_as_many_files_as_its_heading_says() -> None:
    text = _text("architecture.md")
    text = text[text.index("## A keypoint") : text.index("## Other ways")]
    named = {file for span in _spans(text) for file in re.findall(r"[\w/]+\.py", span)}
    assert f": {len(named)} files" in text.splitlines()[0]


def test_every_page_that_code_names_exists() -> None:
    for folder in (*_FOLDERS, "."):
        pattern = "*" if folder == "." else "**/*"
        for path in (_ROOT / folder).glob(pattern):
            if path.suffix in {".py", ".yaml", ".toml", ".md"} and "CHANGELOG" not in path.name:
                for named in re.findall(r"docs/[\w/-]+\.md", path.read_text(encoding="utf-8")):
                    assert (_ROOT / named).is_file(), (path, named)


def test_the_navigation_has_every_page_once() -> None:
    navigation = re.findall(r"[\w/-]+\.md", (_ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    assert sorted(navigation) == sorted(page.relative_to(_DOCS).as_posix() for page in _DOCS.rglob("*.md"))


def test_the_diagram_shows_the_imports() -> None:
    drawn = runpy.run_path(str(_DOCS / "diagram.py"))["draw"]()
    assert _text("architecture.svg") == drawn, "run python docs/diagram.py"


@pytest.mark.parametrize("script", sorted(_DOCS.glob("*.py")), ids=lambda script: script.name)
def test_every_script_of_the_pages_can_be_imported(script: Path) -> None:
    runpy.run_path(str(script))


# --- tables, examples, figures ---------------------------------------------------------------------------
def test_made_tables_are_current() -> None:
    stale = runpy.run_path(str(_DOCS / "made.py"))["stale"]()
    assert not list(stale), "run python docs/made.py --write"


def test_every_made_table_is_shown() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in _PAGES)
    marked = re.findall(r"<!-- made: (\w+) -->", text)
    assert sorted(marked) == sorted(runpy.run_path(str(_DOCS / "made.py"))["TABLES"])


@pytest.mark.parametrize("name", ["flight", "noise", "tables", "codes", "planner"])
def test_every_key_column_and_code_has_a_meaning(name: str) -> None:
    made = runpy.run_path(str(_DOCS / "made.py"))["TABLES"][name]()
    for lines in re.findall(r"(?:^\|.*\n)+", made, re.MULTILINE):
        header, _, *rows = ([cell.strip() for cell in line.split(" | ")] for line in lines.splitlines())
        (column,) = (
            k for k, cell in enumerate(header) if cell.strip("| ") in {"meaning", "is", "holds", "means"}
        )
        assert rows
        assert not [row[0] for row in rows if not row[column].strip("| ")]


def test_every_status_is_explained() -> None:
    section = _text("session.md").partition("| status | means |")[2].partition("\n\n")[0]
    assert re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE) == list(STATUS)


def test_every_skeleton_is_named() -> None:
    assert set(SKELETONS) <= set(_spans(_text("formats.md")))


def test_every_example_of_a_manifest_or_scenario_is_valid() -> None:
    kinds = []
    for page, example in _blocks_of_yaml():
        if "cameras" in example:
            named = {name: camera for name, camera in example["cameras"].items() if camera != "..."}
            Manifest.model_validate(example | {"cameras": named})
        else:
            Scenario.model_validate({"schema": 2, "duration_s": 6} | example)
        kinds.append(page)
    assert {"README.md", "flight.md", "simulation.md"} <= set(kinds)


def test_the_lines_for_python_run_and_the_page_names_all_figures(tmp_path: Path) -> None:
    cells = json.loads((_ROOT / "examples" / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    parts = [block for language, block in _FENCED.findall(_text("api.md")) if language == "python"]
    parts += ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    code = "\n".join(parts)
    assert set(re.findall(r"pipelines[.\w]*", code)) == {"pipelines.api"}
    write_flight(tmp_path, seconds=0.5)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=tmp_path,
        env=os.environ | {"MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "mpjpe_mm" in done.stdout
    assert (tmp_path / "knee.png").stat().st_size > 1000
    made = {path.suffix for path in (tmp_path / "notebook.export").iterdir()}
    assert made == {".trc", ".csv", ".sto", ".json"}
    metrics = json.loads((tmp_path / "notebook.session" / "reconstruct" / "metrics.json").read_text())
    page = _text("session.md").partition("## metrics.json of reconstruct")[2].partition("\n## ")[0]
    assert set(metrics) <= set(_spans(page))


def test_every_dependency_is_imported() -> None:
    imported = set()
    for path in _modules():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                imported |= {node.module.partition(".")[0]}
    brought = {
        re.sub(r"[-_.]+", "-", distribution).lower()
        for module, distributions in packages_distributions().items()
        if module in imported
        for distribution in distributions
    }
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = {re.split(r"[<>=!\[; ]", each)[0].lower() for each in project["dependencies"]}
    assert {re.sub(r"[-_.]+", "-", name) for name in wanted} <= brought
