"""Write the reference tables of the pages from the code.

    python docs/made.py            # names the tables that are not current, and exits 1
    python docs/made.py --write    # writes them

A table stands between `<!-- made: NAME -->` and `<!-- end -->`. Keys and settings come from the models with
their docstrings or comments, formats and exports from the registries, columns and codes of doubts from
`session`, the figures of README from docs/results.json.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import re
import sys
import textwrap
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

from pipelines import api
from pipelines.planning.config import Imperfections, PlannerConfig
from pipelines.session import camera_poses, registries, tables
from pipelines.session.errors import read_codes
from pipelines.session.manifest import FileSource, Manifest, option_models

DOCS = Path(__file__).parent
PAGES = (DOCS.parent / "README.md", *sorted(DOCS.glob("*.md")))
_MARKED = re.compile(r"(<!-- made: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
_KINDS = (  # what a format reads, and the part of flight.yaml that names such files
    ("open_log", "log"),
    ("read_telemetry", "drone's own log"),
    ("index", "video"),
    ("read_trajectory", "poses"),
    ("read_calibration", "calibration"),
    ("read_keypoints", "keypoints"),
    ("read_map", "map"),
    ("read_joints", "true joints"),
    ("", "times of pictures"),
)


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Write a table in Markdown."""
    lines = [header, ("---",) * len(header), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def sentence(text: str) -> str:
    """Begin a text with a capital letter, unless its first word is a name, and end it with a full stop."""
    first = text.partition(" ")[0]
    begun = text[:1].upper() + text[1:] if first.isalpha() and first.islower() else text
    return begun + ("" if begun.endswith((".", ")")) or not begun else ".")


def meanings(thing: type) -> dict[str, str]:
    """Find the meaning of each field: the docstring or comment beside it, of the class or of one above it."""
    found: dict[str, str] = {}
    for each in reversed(thing.__mro__):
        if each.__module__.startswith("pipelines."):
            found |= _meanings_of(each)
    return found


def _meanings_of(thing: type) -> dict[str, str]:
    source = textwrap.dedent(inspect.getsource(thing))
    lines = source.splitlines()
    body = next(node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef))
    found = {}
    for node, following in zip(body.body, [*body.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            beside = lines[(node.end_lineno or 0) - 1][node.end_col_offset or 0 :].partition("#")[2]
            above = [line.strip() for line in _comment_above(lines[: node.lineno - 1])]
            found[node.target.id] = sentence(_text_of(following) or beside.strip() or " ".join(above))
    return found


def _comment_above(lines: list[str]) -> list[str]:
    comment: list[str] = []
    while lines and lines[-1].strip().startswith("# ") and "---" not in lines[-1]:
        comment.insert(0, lines[-1].strip().removeprefix("# "))
        lines = lines[:-1]
    return comment


def _text_of(node: ast.stmt | None) -> str:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return " ".join(str(node.value.value).split())
    return ""


# --- flight.yaml ---------------------------------------------------------------------------------------


def flight() -> str:
    """List the keys of flight.yaml, part by part."""
    places: dict[type[BaseModel], list[str]] = {Manifest: ["The flight"], FileSource: ["A source"]}
    rows = {}
    for model in iter(lambda: next((each for each in places if each not in rows), None), None):
        (place, *_) = places[model]
        rows[model], nested = _rows_of(model, "" if model is Manifest else place, "")
        for inside, part in nested:
            places.setdefault(part, []).append(inside)
    sections = []
    for model, named in places.items():
        is_source = issubclass(model, FileSource) and model is not FileSource
        said = _first_line(model) + (" It is [a source](#a-source)." if is_source else "")
        keys = [table(_KEYS, rows[model])] if rows[model] else []
        sections.append("\n\n".join([f"### {', '.join(named)}", said, *keys]).rstrip())
    return "\n" + "\n\n".join([*sections, _options()]) + "\n"


_KEYS = ("key", "value", "meaning")


def _options() -> str:
    """List the options that stand beside a file, part by part."""
    rows: dict[str, tuple[str, ...]] = {}
    for part in ("pose", "gimbal", "intrinsics", "keypoints", "map"):
        for model in option_models(part):
            beside = _first_line(model).removeprefix("Options of ").rstrip(".")
            for key, value, meaning in _rows_of(model, "", "")[0]:
                rows.setdefault(f"{part}{key}", (f"`{part}`", key, value, meaning, beside))
    lines = table(("part", "key", "value", "meaning", "beside"), list(rows.values()))
    return f"### Options of formats\n\nThey stand beside `file`.\n\n{lines}"


def _rows_of(
    model: type[BaseModel], place: str, before: str
) -> tuple[list[tuple[str, ...]], list[tuple[str, type[BaseModel]]]]:
    """Write the rows of a model's keys, and return the parts that have a table of their own."""
    rows: list[tuple[str, ...]] = []
    nested: list[tuple[str, type[BaseModel]]] = []
    own = meanings(model)
    for name, field in model.model_fields.items():
        key = field.alias or name
        if key == "assumed" or (model is not FileSource and name in FileSource.model_fields):
            continue
        inner, many = _part_of(field.annotation)
        path = f"{place}.{key}" if place else key
        meaning = field.description or own[name] or (_first_line(inner) if inner else "")
        if inner is not None and not many and len(inner.model_fields) <= _FEW:
            inside, deeper = _rows_of(inner, path, f"{before}{key}.")
            rows += inside
            nested += deeper
            continue
        if inner is not None:
            nested.append((f"{path}.NAME" if many else path, inner))
        rows.append((f"`{before}{key}`", _value(name, field.annotation, field.default, inner), meaning))
    return rows, nested


_FEW = 3  # keys of a part that stand among those of the part around it


def _first_line(model: type[BaseModel]) -> str:
    return (inspect.getdoc(model) or "").split("\n\n")[0].replace("\n", " ")


def _part_of(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """Find the model in an annotation, and if several of it stand there by name."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, False
    for argument in get_args(annotation):
        inner, _ = _part_of(argument)
        if inner is not None:
            return inner, get_origin(annotation) is dict
    return None, False


def _value(name: str, annotation: Any, default: Any, inner: type[BaseModel] | None) -> str:
    """Say what may stand there, and what counts if nothing does."""
    if inner is not None or isinstance(default, BaseModel):
        return ""
    kinds = ["seconds"] if name.endswith("_ns") else list(dict.fromkeys(_kinds(annotation)))
    shown = "" if default in (None, "", [], {}) or repr(default) == "PydanticUndefined" else _plain(default)
    return ", ".join(kinds) + (f"; default {shown}" if shown else "")


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(_plain, value))
    return f"{value:g}" if isinstance(value, float) else str(value).lower()


def _kinds(annotation: Any) -> Iterator[str]:
    """Name what an annotation allows: words, or kinds of values."""
    origin = get_origin(annotation)
    if origin is Literal:
        yield from (f"`{word}`" for word in get_args(annotation))
    elif origin in (Union, UnionType):
        for argument in get_args(annotation):
            yield from _kinds(argument)
    elif origin is Annotated:
        yield from _kinds(get_args(annotation)[0])
    else:
        names = {
            str: "text",
            float: "number",
            int: "number",
            Fraction: "number",
            list: "list",
            dict: "mapping",
        }
        kind = "true, false" if annotation is bool else names.get(origin or annotation, "")
        yield from [kind] if kind else []


_KIND_OF_TYPE: dict[object, str] = {
    bool: "true, false",
    str: "text",
    int: "number",
    float: "number",
    Fraction: "number",
    list: "list",
    dict: "mapping",
}


# --- other tables --------------------------------------------------------------------------------------


def noise() -> str:
    """List the models of pose noise with their parameters."""
    rows = []
    for name, model in zip(camera_poses.NOISE_MODELS.names(), camera_poses.NOISE_MODELS.all(), strict=True):
        parameters = ", ".join(f"`{field.name}`" for field in dataclasses.fields(model))
        rows.append((f"`{name}`", parameters, (inspect.getdoc(model) or "").split("\n")[0]))
    return table(("model", "parameters", "is"), rows)


def formats() -> str:
    """List the formats that are read."""
    rows = []
    for order, (method, kind) in enumerate(_KINDS):
        for each in registries.FORMATS.all():
            if (not method or hasattr(each, method)) and each.name not in [name for _, name, *_ in rows]:
                names = ", ".join(suffix or "folder" for suffix in each.suffixes)
                rows.append((order, each.name, kind, sentence(each.title), names))
    cells = [(kind, f"`{name}`", title, names) for _, name, kind, title, names in sorted(rows)]
    return table(("kind", "`format:`", "is", "usual names"), cells)


def exports() -> str:
    """List the formats that are written, with their choices."""
    rows = []
    for export in registries.EXPORTS.all():
        there = export.choices if isinstance(export, registries.ExportWithChoices) else {}
        choices = (", ".join(there.get(what, ())) for what in ("unit", "axes"))
        rows.append((f"`{export.name}`", sentence(export.title), *choices))
    return table(("`--to`", "is", "unit", "axes"), rows)


def columns() -> str:
    """List the tables of a session with their columns."""
    rows = []
    for name, stored in tables.TABLES.items():
        columns = ", ".join(f"`{column}`" for column in getattr(tables, name).names)
        rows.append((f"`{stored['file']}`", columns, sentence(" ".join(stored["holds"].split()))))
    return table(("file", "columns", "holds"), rows)


def codes() -> str:
    """List the codes of doubts."""
    rows = [
        (f"`{code}`", meaning, ", ".join(f"`{key}`" for key in keys.split(", ") if key))
        for code, (meaning, keys) in read_codes("doubts").items()
    ]
    return table(("code", "means", "change"), rows)


def figures() -> str:
    """List the five figures of README, as docs/results.json has them."""
    poses, corpus, gimbals = _cells("sample-poses", 1), _cells("corpus-model", 2), _cells("gimbals-kept", 3)
    mistakes, worlds = _cells("mistakes-kept", 1), _cells("planner-worlds", 1)
    sample = [f"{float(poses[f'logged poses, `{method}`']['MPJPE']):.0f} mm" for method in ("auto", "robust")]
    kept = [f"{corpus[f'kept {method}']['MPJPE']} mm" for method in ("auto", "robust")]
    real = [
        f"{float(gimbals[f'0.5 deg yes {method}']['distance mm']):.0f} mm" for method in ("auto", "robust")
    ]
    named = mistakes["3"]
    flights, touched = (sum(int(row[key]) for row in worlds.values()) for key in ("flights", "touched"))
    rows = [
        ("the sample flight, logged poses off by 0.05 m and 0.3 deg (rendered, tuned on)", *sample),
        ("twelve flights with six kinds of pose errors (rendered, kept aside; noise stated)", *kept),
        ("real pictures of cameras that turn, attitudes off by 0.5 deg (kept aside)", *real),
    ]
    said = (
        f"`mocap check` names the mistake in {named['named first']} of {named['mistakes that count']}"
        " flights that are described with one (modelled, three drones, kept aside).\n"
        f"In {flights} replays of planners in random worlds {touched or 'no'} drone touches anything"
        " (simulated)."
    )
    header = ("mean error of a joint", "`mocap reconstruct`", "triangulation alone")
    return f"{table(header, rows)}\n{said}\n"


def _cells(name: str, words: int) -> dict[str, dict[str, str]]:
    """Read a table of docs/results.json: its rows by their first cells, each by the header."""
    lines = json.loads((DOCS / "results.json").read_text(encoding="utf-8"))[name]["lines"]
    lines = [line for line in lines if line.startswith("|")]
    header, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    return {" ".join(row[:words]): dict(zip(header, row, strict=True)) for row in rows}


def functions() -> str:
    """List the public functions with the first sentences of their docstrings."""
    there = {name: getattr(api, name) for name in dir(api)}
    rows = [
        (f"`{name}`", sentence(" ".join((inspect.getdoc(each) or "").split("\n\n")[0].split())))
        for name, each in there.items()
        if inspect.isfunction(each)
    ]
    return table(("function", "does"), rows)


def planner() -> str:
    """List the settings of the planner."""
    rows = []
    fields = [(PlannerConfig, "", field) for field in dataclasses.fields(PlannerConfig)]
    fields += [(Imperfections, "imperfections.", field) for field in dataclasses.fields(Imperfections)]
    for kind, prefix, field in fields:
        if field.name not in ("tuning", "imperfections"):
            default = field.default if isinstance(field.default, tuple) else (field.default,)
            shown = " ".join(f"{each:g}" if isinstance(each, float) else str(each) for each in default)
            shown = "none" if field.default is None else shown
            rows.append((f"`{prefix}{field.name}`", shown or "none", meanings(kind)[field.name]))
    return table(("key", "default", "meaning"), rows)


TABLES: dict[str, Callable[[], str]] = {
    "figures": figures,
    "flight": flight,
    "noise": noise,
    "formats": formats,
    "exports": exports,
    "tables": columns,
    "codes": codes,
    "planner": planner,
    "functions": functions,
}


def current(page: str) -> str:
    """Return a page with its tables as the code has them now."""
    return _MARKED.sub(lambda found: found[1] + TABLES[found[2]]() + found[3], page)


def stale() -> dict[Path, str]:
    """Return the pages whose tables are not current, as they ought to be."""
    pages = {path: path.read_text(encoding="utf-8") for path in PAGES}
    return {path: made for path, text in pages.items() if (made := current(text)) != text}


if __name__ == "__main__":
    found = stale()
    for path, text in found.items():
        if "--write" in sys.argv:
            path.write_text(text, encoding="utf-8", newline="\n")
        else:
            sys.stdout.write(f"{path}: not current\n")
    sys.exit("--write" not in sys.argv and bool(found))
