"""The documentation is true: commands parse, files exist, keys and columns are those of the code."""

from __future__ import annotations

import argparse
import re
import runpy
import shlex
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import click
import pytest
from pydantic import BaseModel
from ruamel.yaml import YAML

from mocap_cli.main import mocap
from pipelines.geometry.triangulation import STATUS
from pipelines.session import tables
from pipelines.session.manifest import Camera, Flight
from pipelines.session.registries import NOISE_MODELS
from pipelines.simulation.scenario import Scenario

_ROOT = Path(__file__).parents[1]
_DOCS = _ROOT / "docs"
_PAGES = [
    *(_ROOT / name for name in ("README.md", "CONTRIBUTING.md", "sample_data/README.md")),
    *sorted(_DOCS.rglob("*.md")),
]
_FOLDERS = ("benchmarks", "docs", "mocap_cli", "pipelines", "sample_data", "tests")
_FENCED = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_SPAN = re.compile(r"`([^`]+)`")


def _text(page: str) -> str:
    return (_DOCS / page).read_text(encoding="utf-8")


def _spans(text: str) -> list[str]:
    """List the code spans of a page's prose, each on one line."""
    return [" ".join(span.split()) for span in _SPAN.findall(_FENCED.sub("", text))]


def _code_words(text: str) -> set[str]:
    """List the words that stand as code: in spans, fenced and indented blocks."""
    blocks = [block for _, block in _FENCED.findall(text)] + re.findall(r"^ {4}.*$", text, re.MULTILINE)
    return {word for part in [*_spans(text), *blocks] for word in re.findall(r"[\w-]+", part)}


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
    if "ArgumentParser(" not in path.read_text(encoding="utf-8"):
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


@pytest.mark.parametrize(
    ("walk", "beside"),
    [
        ("A comparison", set()),
        ("A ROS pose", {"ros2_bag.py", "mcap_log.py"}),  # in the place of ros1_bag.py
        ("A keypoint", {"pipelines/ingest.py", "sources/files.py"}),  # of a keypoint file, without a video
    ],
)
def test_a_walk_names_as_many_files_as_its_heading_says(walk: str, beside: set[str]) -> None:
    text = _text("architecture.md")
    text = text[text.index(f"### {walk}") :]
    text = text[: text.index("\n##")]
    named = {file for span in _spans(text) for file in re.findall(r"[\w/]+\.py", span)}
    assert beside < named or not beside
    assert f": {len(named - beside)} files" in text.splitlines()[0]


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


@pytest.mark.parametrize("page", _PAGES, ids=lambda page: str(page.relative_to(_ROOT)))
def test_every_link_leads_to_a_section(page: Path) -> None:
    text = _FENCED.sub("", page.read_text(encoding="utf-8"))
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", text):
        linked = page.parent / target if target else page
        assert linked.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", linked.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {_anchor(heading) for heading in headings}, (target, anchor)


def _anchor(heading: str) -> str:
    """Name a heading as Python-Markdown's table of contents does."""
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower())


def test_the_diagram_shows_the_imports() -> None:
    drawn = runpy.run_path(str(_DOCS / "diagram.py"))["draw"]()
    assert _text("architecture.svg") == drawn, "run python docs/diagram.py"


# --- flight.yaml, scenarios, tables ---------------------------------------------------------------------


def _keys(model: type[BaseModel]) -> set[str]:
    """Collect every key of a manifest's part, also those of its own parts."""
    keys: set[str] = set()
    for name, field in model.model_fields.items():
        keys.add(field.alias or name)
        for part in _parts(field.annotation):
            keys |= _keys(part)
    return keys


def _parts(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [part for argument in getattr(annotation, "__args__", ()) for part in _parts(argument)]


def _rows(text: str) -> dict[str, str]:
    """Map the code words of each table row's first cell to the rest of the rows."""
    rows: dict[str, str] = {}
    for line in text.splitlines():
        if line.startswith("| `"):
            first, rest = line[1:].split(" |", 1)
            for key in _SPAN.findall(first):
                rows[key] = rows.get(key, "") + rest
    return rows


def test_every_key_of_a_manifest_is_explained_where_it_belongs() -> None:
    text = _text("flight.md")
    rows = _rows(text)
    sections = {"pose": text[text.index("`pose` is one of") : text.index("### Rolling")]}
    for name, field in Camera.model_fields.items():
        explained = rows[name] + sections.get(name, "")
        for part in _parts(field.annotation):
            assert _keys(part) - {"assumed"} <= _code_words(explained), name  # explained once, for all
    assert _keys(Flight) <= _code_words(text)


def test_no_key_is_explained_that_a_manifest_does_not_have() -> None:
    noise = {*NOISE_MODELS.names()}
    words = {word for key in _rows(_text("flight.md")) for word in re.split(r"[.\s]+", key) if word}
    assert words - noise <= _keys(Flight)


def test_every_noise_model_and_its_parameters_are_explained() -> None:
    rows = _rows(_text("flight.md"))
    for name, model in zip(NOISE_MODELS.names(), NOISE_MODELS.all(), strict=True):
        assert set(model.__dataclass_fields__) <= _code_words(rows[name]), name


def test_every_example_of_a_manifest_or_scenario_is_valid() -> None:
    kinds = []
    for page, example in _blocks_of_yaml():
        if "cameras" in example:
            named = {name: camera for name, camera in example["cameras"].items() if camera != "..."}
            Flight.model_validate(example | {"cameras": named})
        else:
            Scenario.model_validate({"schema": 2, "duration_s": 6} | example)
        kinds.append(page)
    assert {"README.md", "flight.md", "simulation.md"} <= set(kinds)


@pytest.mark.parametrize(
    ("file", "table"),
    [
        ("cameras/<camera>/frames.parquet", "FRAMES"),
        ("cameras/<camera>/poses.parquet", "POSES"),
        ("cameras/<camera>/keypoints.parquet", "KEYPOINTS"),
        ("actor.parquet", "ACTOR"),
        ("truth.parquet", "TRUTH"),
        ("plan.parquet", "PLAN"),
        ("replan/<arm>/seen.parquet", "SEEN"),
        ("replan/cost_map.parquet", "COST_MAP"),
    ],
)
def test_every_column_of_a_table_is_named(file: str, table: str) -> None:
    assert set(getattr(tables, table).names) <= set(_SPAN.findall(_rows(_text("session.md"))[file]))


def test_the_columns_of_replayed_trajectories_are_named() -> None:
    named = _SPAN.findall(_rows(_text("session.md"))["replan/<arm>/trajectories.parquet"])
    pose = {"x", "y", "z", "qx", "qy", "qz", "qw"}  # the page says "pose"
    assert set(named) == set(tables.REPLAN.names) - pose


def test_the_columns_and_statuses_of_a_skeleton_are_those_of_the_page() -> None:
    text = _text("session.md")
    section = text[text.index("## skeleton.parquet") : text.index("## metrics.json of reconstruct")]
    columns, statuses = section.split("| status | means |")
    assert set(_rows(columns)) == set(tables.SKELETON.names)
    assert set(_rows(statuses)) == set(STATUS)
