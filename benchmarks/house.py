"""Measures the house against the aims of its upkeep, and fails where one is missed.

python -m benchmarks.house                      # the table; exit status 1 where a number is missed
python -m benchmarks.house --worst [planning]   # and the offenders behind each number, of one room only
python -m benchmarks.house --session S --times build/tests.xml
"""

import argparse
import ast
import contextlib
import importlib
import json
import os
import re
import sys
import tokenize
import typing
import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
TIMES = ROOT / "build" / "tests.xml"
SAMPLE = ROOT / "demo" / "mound_walk.session"
CONSTANTS_ARE = """\
A constant is a number in capitals at the top of a module of pipelines/ or mocap_cli/, or a field of a frozen
dataclass with numbers as most of its defaults. Its reason is the comment above or behind it, or the text
below it: a sentence of four words or more. In such tables and in formats, consecutive lines share it."""


@dataclass(frozen=True)
class Module:
    """A parsed file."""

    path: Path
    text: str
    tree: ast.Module

    @property
    def lines(self) -> int:
        return len(self.text.splitlines())

    @property
    def place(self) -> str:
        return self.path.relative_to(ROOT).as_posix()

    @property
    def room(self) -> str:
        """The folder below pipelines/, tests/ or benchmarks/; a file there stands for itself."""
        return "/".join(self.path.relative_to(ROOT).parts[:2])

    @property
    def name(self) -> str:
        parts = self.path.relative_to(ROOT).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@dataclass(frozen=True)
class Row:
    """One number with its aim; `value` None where it was not measured."""

    subject: str
    value: float | None
    most: float | None = None
    shown: str = ""
    offenders: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        if self.most is None:
            return ""
        if self.value is None:
            return "not measured"
        return "met" if self.value <= self.most else "MISSED"


def modules_of(folder: str) -> list[Module]:
    """Parse all modules of a folder of the repository."""
    found = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        found.append(Module(path, text, ast.parse(text)))
    return found


def longest_chain(modules: list[Module]) -> list[str]:
    """Find the longest chain of imports, also of those in functions; one met again in its chain ends it."""
    names = {module.name for module in modules}
    graph: dict[str, set[str]] = {}
    for module in modules:
        found: set[str] = set()
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= {name if name in names else node.module for name in inner}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
        graph[module.name] = (found & names) - {module.name}
    best: dict[str, list[str]] = {}
    above: set[str] = set()

    def below(name: str) -> list[str]:
        if name not in best:
            above.add(name)
            chains = [below(other) for other in sorted(graph[name]) if other not in above]
            above.discard(name)
            best[name] = [name, *max(chains, key=len, default=[])]
        return best[name]

    return max((below(name) for name in sorted(graph)), key=len)


def is_number(node: ast.expr | None) -> bool:
    """Recognise a number: a literal, a term of numbers and names, or a function of numbers."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    if isinstance(node, ast.BinOp):
        sides = (node.left, node.right)
        return any(map(is_number, sides)) and all(
            is_number(side) or isinstance(side, ast.Name | ast.Attribute) for side in sides
        )
    if isinstance(node, ast.Call):
        return bool(node.args) and all(map(is_number, node.args))
    return False


def is_frozen_table(node: ast.ClassDef) -> bool:
    """Recognise a frozen dataclass most of whose fields (two or more) have numbers as defaults."""
    frozen = any("frozen=True" in ast.unparse(decorator) for decorator in node.decorator_list)
    stated = [inner for inner in node.body if isinstance(inner, ast.AnnAssign)]
    numbers = sum(is_number(inner.value) for inner in stated)
    return frozen and numbers > 1 and numbers >= 0.75 * len(stated)


def constants(tree: ast.Module) -> Iterator[tuple[str, ast.stmt]]:
    """Find the numbers in capitals at the top of a module, and those in its frozen tables."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and is_frozen_table(node):
            for inner in node.body:
                if isinstance(inner, ast.AnnAssign) and is_number(inner.value):
                    assert isinstance(inner.target, ast.Name)
                    yield f"{node.name}.{inner.target.id}", inner
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            name = targets[0].id if isinstance(targets[0], ast.Name) else ""
            if re.fullmatch(r"_*[A-Z][A-Z0-9_]*", name) and is_number(node.value):
                yield name, node


def is_sentence(text: str) -> bool:
    """Recognise a sentence: a capital letter first, at least four words, a full stop at the end."""
    return bool(re.match(r"[A-Z]", text)) and len(text.split()) >= 4 and text.endswith(".")


def constants_without_reason(module: Module) -> tuple[list[str], int]:
    """Find the constants of a module whose reason is missing or a fragment; count all."""
    lines = module.text.splitlines()
    comments = {
        token.start[0]: token.string.lstrip("#: ")
        for token in tokenize.generate_tokens(iter(f"{line}\n" for line in lines).__next__)
        if token.type == tokenize.COMMENT
    }
    alone = {number for number in comments if lines[number - 1].lstrip().startswith("#")}
    documented = {
        before.end_lineno or before.lineno: " ".join(str(after.value.value).split())
        for before, after in pairwise(module.tree.body)
        if isinstance(after, ast.Expr)
        and isinstance(after.value, ast.Constant)
        and isinstance(after.value.value, str)
    }
    missing: list[str] = []
    reasoned: set[int] = set()  # last lines of constants whose comment above is a sentence
    count = 0
    for name, node in constants(module.tree):
        count += 1
        first = node.lineno
        while first - 1 in alone and not comments[first - 1].startswith("---"):
            first -= 1
        above = " ".join(comments[number] for number in range(first, node.lineno))
        end = node.end_lineno or node.lineno
        together = module.room == "pipelines/formats" or "." in name  # a standard's, or a table's
        shared = together and not above and node.lineno - 1 in reasoned
        if is_sentence(above) or shared:
            reasoned.add(end)
        elif not is_sentence(comments.get(end, "")) and not is_sentence(documented.get(end, "")):
            missing.append(
                f"{module.place}:{node.lineno} {name}  # {above or comments.get(end, '')}".rstrip(" #")
            )
    return missing, count


def duplicate_classes(modules: list[Module]) -> list[str]:
    """Find names of classes of pipelines/ that stand for two things or more; `_Track` and `Track` are one."""
    places: dict[str, list[str]] = defaultdict(list)
    for module in modules:
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ClassDef):
                places[node.name.lstrip("_")].append(f"{module.place}:{node.lineno}")
    return [f"{name}: {', '.join(found)}" for name, found in sorted(places.items()) if len(found) > 1]


def command_options(name: str) -> tuple[str, ...]:
    """Return the options of a command of `mocap`, without --help."""
    import click

    main = importlib.import_module("mocap_cli.main")
    group = next(value for value in vars(main).values() if isinstance(value, click.Group))
    command = group.get_command(click.Context(group), name)
    assert command is not None
    return tuple(p.opts[0] for p in command.params if isinstance(p, click.Option))


def manifest_keys() -> tuple[str, ...]:
    """Return the keys of flight.yaml with the model that declares each; options beside a file count."""
    from pydantic import BaseModel

    from pipelines.session import manifest
    from pipelines.session.yaml_models import YamlModel

    def named(annotation: Any) -> Iterator[type[BaseModel]]:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield annotation
        for argument in typing.get_args(annotation):
            yield from named(argument)

    options = [value for value in vars(manifest).values() if isinstance(value, type)]
    waiting: list[type[BaseModel]] = [model for model in options if issubclass(model, YamlModel)]
    models: list[type[BaseModel]] = []
    while waiting:
        model = waiting.pop()
        if model not in models:
            models.append(model)
            waiting += [base for base in model.__bases__ if issubclass(base, YamlModel)]
            waiting += [inner for field in model.model_fields.values() for inner in named(field.annotation)]
    return tuple(
        f"{model.__name__}.{field.alias or key}"
        for model in models
        for key, field in model.model_fields.items()
        if key in vars(model).get("__annotations__", {})
    )


def leaves(value: object) -> int:
    """Count the values of a JSON document."""
    if isinstance(value, dict):
        return sum(map(leaves, value.values()))
    return sum(map(leaves, value)) if isinstance(value, list) else 1


def files_of_keypoint() -> tuple[str, ...]:
    """Return the files that the walk of a keypoint in docs/architecture.md names."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    # The numbered steps below the heading; what follows them is another way.
    walk = re.search(r"^#+ A keypoint.*?^1\. .*?(?=\n\n|\Z)", text, flags=re.MULTILINE | re.DOTALL)
    return tuple(sorted(set(re.findall(r"`([\w/]+\.py)`", walk.group()))) if walk else ())


def minutes(junit: Path) -> float | None:
    """Add up the minutes of all tests in a JUnit file of pytest, which are those of the processors."""
    if not junit.exists():
        return None
    return sum(float(case.get("time", 0)) for case in ET.parse(junit).iter("testcase")) / 60  # noqa: S314


def by_room(modules: list[Module]) -> tuple[str, ...]:
    """Add up lines and modules of each room."""
    lines: Counter[str] = Counter()
    count: Counter[str] = Counter()
    for module in modules:
        lines[module.room] += module.lines
        count[module.room] += 1
    return tuple(f"{n:6d} lines {count[room]:4d} modules  {room}" for room, n in lines.most_common())


def largest(modules: list[Module]) -> tuple[str, ...]:
    """Name the modules from the largest to the smallest."""
    return tuple(f"{m.lines:6d} {m.place}" for m in sorted(modules, key=lambda m: -m.lines))


def rows_of(options: argparse.Namespace) -> Iterator[Row]:
    """Measure all that the table has."""
    house, cli = modules_of("pipelines"), modules_of("mocap_cli")
    benchmarks, tests = modules_of("benchmarks"), modules_of("tests")
    lines = sum(module.lines for module in house)
    yield Row("`pipelines/`, lines of Python", lines, 66_000, "", by_room(house))
    yield Row("modules of `pipelines/`, `__init__` among them", len(house), 200, "", largest(house)[::-1])
    chain = longest_chain(house + cli)
    yield Row("depth of the imports, from `mocap_cli`", len(chain), 11, "", tuple(chain))

    lines = sum(module.lines for module in benchmarks)
    yield Row("benchmarks, lines", lines, 4_000, "", largest(benchmarks))
    commands = tuple(m.place for m in benchmarks if "if __name__ ==" in m.text)
    yield Row("benchmarks, commands", len(commands), 8, "", commands)
    importing = [m.place for m in tests if re.search(r"(?m)^\s*(from|import) benchmarks", m.text)]
    yield Row("tests that import benchmarks", len(importing), 0, "", tuple(importing))

    lines = sum(module.lines for module in tests)
    yield Row("tests, lines", lines, 36_000, "", (*by_room(tests), *largest(tests)))
    yield Row(f"`make test`, processor minutes ({options.times.name})", minutes(options.times), 9)

    pages = sorted((ROOT / "docs").rglob("*.md")) + [
        ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")
    ]
    words = {
        page.relative_to(ROOT).as_posix(): len(page.read_text(encoding="utf-8").split())
        for page in pages
        if page.exists()
    }
    longest = tuple(f"{n:6d} {page}" for page, n in sorted(words.items(), key=lambda item: -item[1]))
    yield Row("docs, README, CONTRIBUTING, CHANGELOG: words", sum(words.values()), 24_000, "", longest)
    yield Row("docs, README, CONTRIBUTING, CHANGELOG: pages", len(words), 15)

    for command, most in (("reconstruct", 14), ("replan-compare", 12)):
        names = command_options(command)
        yield Row(f"options of `{command}`", len(names), most, "", names)
    for subject, measured, most in (
        ("keys of flight.yaml", manifest_keys, 90),
        (
            "settings of the planner",
            lambda: importlib.import_module("pipelines.planning.config").SETTINGS,
            20,
        ),
        ("files that a keypoint passes (docs/architecture.md)", files_of_keypoint, 20),
    ):
        found: tuple[str, ...] | None = None
        with contextlib.suppress(ImportError, AttributeError, FileNotFoundError):
            found = measured()
        yield Row(subject, None if found is None else len(found), most, "", found or ())
    metrics = options.session / "reconstruct" / "metrics.json"
    values = leaves(json.loads(metrics.read_text())) if metrics.exists() else None
    yield Row(f"values of reconstruct/metrics.json in {options.session.name}", values, 300)

    doubled = duplicate_classes(house)
    yield Row("class names used for two things or more", len(doubled), 15, "", tuple(doubled))
    missing: list[str] = []
    count = 0
    for module in house + cli:
        found_missing, constants_here = constants_without_reason(module)
        missing += found_missing
        count += constants_here
    subject = "constants whose reason is a fragment or missing"
    bare = sum("  #" not in line for line in missing)
    shown = f"{len(missing)} of {count} ({bare} without any)"
    yield Row(subject, len(missing), 0, shown, tuple(missing))


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the house.", epilog=CONSTANTS_ARE)
    parser.add_argument("--worst", nargs="?", const="", metavar="PART", help="Name offenders [of PART].")
    parser.add_argument("--session", type=Path, default=SAMPLE, help="Session with the sample's metrics.")
    parser.add_argument("--times", type=Path, default=TIMES, help="JUnit file of `make test`.")
    options = parser.parse_args()
    os.environ.setdefault("NUMBA_DISABLE_JIT", "1")  # nothing is computed here

    rows = list(rows_of(options))
    print("| | measured | at most | |\n| --- | --- | --- | --- |")
    for row in rows:
        shown = row.shown or (
            "" if row.value is None else f"{row.value:.4g}" if row.value % 1 else f"{row.value:.0f}"
        )
        print(f"| {row.subject} | {shown} | {'' if row.most is None else f'{row.most:g}'} | {row.verdict} |")
    print(f"\n{CONSTANTS_ARE}")
    if options.worst is not None:
        for row in rows:
            offenders = [line for line in row.offenders if options.worst in line]
            if offenders:
                print(f"\n{row.subject}:", *offenders, sep="\n  ")
    sys.exit(any(row.verdict == "MISSED" for row in rows))


if __name__ == "__main__":
    main()
