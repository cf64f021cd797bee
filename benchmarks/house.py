"""Measures the house: its lines, modules, imports, parameters, docstrings and the phrases its tests ask for.

python -m benchmarks.house            # prints the table
python -m benchmarks.house --write    # and puts it into CONTRIBUTING.md
python -m benchmarks.house --worst    # and names what makes each figure what it is
python -m benchmarks.house --beside evo rosbags FOLDER ...    # lines by kind, beside other packages
"""

import argparse
import ast
import importlib.util
import re
import statistics
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("mocap_cli", "pipelines")
PAGE = ROOT / "CONTRIBUTING.md"
BEGIN, END = "<!-- python -m benchmarks.house --write -->", "<!-- end -->"
OPENERS = {"What", "Where", "How", "Whether", "Who", "That", "Which", "When"}
Function = ast.FunctionDef | ast.AsyncFunctionDef


def parsed(folder: str) -> dict[Path, ast.Module]:
    """Parse all modules of a folder."""
    return {path: ast.parse(path.read_text()) for path in sorted((ROOT / folder).rglob("*.py"))}


def docstrings(tree: ast.Module) -> Iterator[ast.Constant]:
    """Find the docstrings of a module, its classes and its functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | Function) and ast.get_docstring(node) is not None:
            first = node.body[0]
            assert isinstance(first, ast.Expr)
            assert isinstance(first.value, ast.Constant)
            yield first.value


def code_lines(path: Path, tree: ast.Module) -> int:
    """Count the lines of a module that hold code: no blank lines, comments or docstrings."""
    documented = {
        line for text in docstrings(tree) for line in range(text.lineno, (text.end_lineno or text.lineno) + 1)
    }
    ignored = {
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENCODING,
        tokenize.ENDMARKER,
    }
    with path.open("rb") as file:
        held = {
            line
            for token in tokenize.tokenize(file.readline)
            if token.type not in ignored
            for line in range(token.start[0], token.end[0] + 1)
        }
    return len(held - documented)


def statements(tree: ast.Module) -> int:
    """Count the statements of a module, docstrings among them."""
    return sum(isinstance(node, ast.stmt) for node in ast.walk(tree))


def lines_by_kind(folder: Path) -> str:
    """Count the lines of a package by kind, and its statements; return a row of the table of decision 10.

    Tests within the package are left out. Words and formatting decide how many lines a statement has.
    """
    lines = code = documented = blank = stated = modules = 0
    for path in sorted(folder.rglob("*.py")):
        if "tests" in path.relative_to(folder).parts:
            continue
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        within = {n for d in docstrings(tree) for n in range(d.lineno, (d.end_lineno or d.lineno) + 1)}
        modules += path.name != "__init__.py"
        lines += len(text.splitlines())
        code += code_lines(path, tree)
        documented += len(within)
        blank += sum(not line.strip() for n, line in enumerate(text.splitlines(), 1) if n not in within)
        stated += statements(tree)
    kinds = (lines, code, documented, blank, lines - code - documented - blank, stated)
    thousands = " | ".join(f"{count / 1000:.1f}" for count in kinds)
    return f"| {folder.name} | {modules} | {thousands} | {lines / stated:.2f} |"


def folder_of(package: str) -> Path:
    """Find the folder of an installed package, or take a path as it is."""
    if Path(package).is_dir():
        return Path(package)
    found = importlib.util.find_spec(package)
    if found is None or not found.submodule_search_locations:
        sys.exit(f"{package}: neither a folder nor an installed package")
    return Path(found.submodule_search_locations[0])


def name_of(path: Path) -> str:
    """Name a module as an import does."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree: ast.Module, modules: set[str]) -> set[str]:
    """Find the modules of the project that a module imports, inside functions as well."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in modules else node.module)
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & modules


def longest_chains(graph: dict[str, set[str]]) -> dict[str, list[str]]:
    """Find the longest chain of imports below each module; one met again in its own chain ends it."""
    best: dict[str, list[str]] = {}
    open_modules: set[str] = set()

    def below(module: str) -> list[str]:
        if module in best:
            return best[module]
        open_modules.add(module)
        chains = [below(other) for other in sorted(graph[module]) if other not in open_modules]
        open_modules.discard(module)
        best[module] = [module, *max(chains, key=len, default=[])]
        return best[module]

    return {module: below(module) for module in sorted(graph)}


def parameters(node: Function) -> int:
    """Count the parameters of a function, without `self` and `cls`."""
    names = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return len([name for name in names if name.arg not in ("self", "cls")])


def is_phrase(text: str) -> bool:
    """Recognise English: two words beside each other, as no path, key, code or number has."""
    named = re.sub(r"\\?\.(?=\w)", "/", text)  # flight.session and poses\.parquet are names of files
    plain = re.sub(r"\\.|[.*?+^$()\[\]{}|]", " ", named)
    return bool(re.search(r"(?<![\w./:=-])[A-Za-z]{2,},? [a-z]{2,}(?![\w/:=])", plain))


def strings(node: ast.AST) -> Iterator[str]:
    """Find the literal strings below a node."""
    for inner in ast.walk(node):
        if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
            yield inner.value


def phrase_assertions(tree: ast.Module) -> list[int]:
    """Find the lines of a test module that assert an English phrase: `assert` or `match=`.

    The message of an `assert`, after its comma, is for the reader and does not count.
    """
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Assert):
            if any(map(is_phrase, strings(node.test))):
                found.append(node.lineno)
        elif (
            isinstance(node, ast.keyword) and node.arg == "match" and any(map(is_phrase, strings(node.value)))
        ):
            found.append(node.value.lineno)
    return sorted(found)


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the house.")
    parser.add_argument("--write", action="store_true", help="Put the table into CONTRIBUTING.md.")
    parser.add_argument("--worst", action="store_true", help="Name what makes each figure what it is.")
    parser.add_argument(
        "--beside", nargs="+", metavar="PACKAGE", help="Print lines by kind of these as well."
    )
    options = parser.parse_args()
    if options.beside:
        print("| package | modules | k lines | code | docstrings | blank | comments | k statements |", end="")
        print(" lines a statement |\n|" + " --- |" * 9)
        for folder in (ROOT / "pipelines", *map(folder_of, options.beside)):
            print(lines_by_kind(folder))
        return

    house = {path: tree for package in PACKAGES for path, tree in parsed(package).items()}
    rooms = {path: tree for path, tree in house.items() if path.is_relative_to(ROOT / "pipelines")}
    modules = {path: tree for path, tree in rooms.items() if path.name != "__init__.py"}
    lines = {path: len(path.read_text().splitlines()) for path in rooms}
    names = {name_of(path) for path in house}
    chains = longest_chains(
        {name_of(path): imported(tree, names) - {name_of(path)} for path, tree in house.items()}
    )
    chain = max(chains.values(), key=len)
    functions = [
        (parameters(node), f"{name_of(path)}.{node.name}")
        for path, tree in house.items()
        for node in ast.walk(tree)
        if isinstance(node, Function)
    ]
    docs = [
        (text.value, f"{path.relative_to(ROOT)}:{text.lineno}")
        for path, tree in house.items()
        for text in docstrings(tree)
    ]
    openers = [where for text, where in docs if str(text).split(maxsplit=1)[0].strip(",.:") in OPENERS]
    phrases = [
        f"{path.relative_to(ROOT)}:{line}"
        for path, tree in parsed("tests").items()
        for line in phrase_assertions(tree)
    ]
    rows = {
        "lines of Python in `pipelines/` (without blank lines, comments and docstrings)": (
            f"{sum(lines.values()) / 1000:.1f} k "
            f"({sum(code_lines(path, tree) for path, tree in rooms.items()) / 1000:.1f} k)"
        ),
        "lines for a statement": f"{sum(lines.values()) / sum(map(statements, rooms.values())):.2f}",
        "modules without `__init__`; median lines": (
            f"{len(modules)}; {statistics.median(lines[path] for path in modules):.0f}"
        ),
        "depth of the import graph, with `mocap_cli`": f"{len(chain)}",
        "most parameters of a function": f"{max(functions)[0]}",
        "docstrings that open with What, Where, How, Whether, Who, That, Which or When": (
            f"{len(openers)} of {len(docs)}"
        ),
        "test assertions on English phrases": f"{len(phrases)}",
    }
    table = "\n".join(["| | |", "| --- | --- |", *(f"| {name} | {value} |" for name, value in rows.items())])
    print(table)
    if options.worst:
        rooms_of = sorted({".".join(name.split(".")[:2]) for name in chains})
        print("\nlongest chains of imports:")
        for room in rooms_of:
            longest = max((c for n, c in chains.items() if n == room or n.startswith(f"{room}.")), key=len)
            print(f"{len(longest):3d} {room}: {' > '.join(longest)}")
        print("\nmost parameters:", *(f"{n:3d} {name}" for n, name in sorted(functions)[:-31:-1]), sep="\n  ")
        print("\ndocstrings:", *openers, sep="\n  ")
        print("\nphrases:", *phrases, sep="\n  ")
    if options.write:
        page = PAGE.read_text()
        if BEGIN not in page:
            sys.exit(f"{PAGE}: has no line {BEGIN}")
        before, rest = page.split(BEGIN, 1)
        PAGE.write_text(f"{before}{BEGIN}\n{table}\n{END}{rest.split(END, 1)[1]}")


if __name__ == "__main__":
    main()
