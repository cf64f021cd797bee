"""Write docs/api.md: the signatures and docstrings of the functions that docs/notebook.md uses.

python docs/api.py            # prints it
python docs/api.py --write    # and replaces docs/api.md
"""

import inspect
import re
import sys
from collections.abc import Callable
from pathlib import Path

from pipelines.export import Exported, export
from pipelines.ingest import Ingested, ingest
from pipelines.reconstruct import Reconstructed, Settings, reconstruct
from pipelines.session.errors import DataError

PAGE = Path(__file__).parent / "api.md"
OBJECTS: dict[str, tuple[Callable[..., object], ...]] = {  # by the module from which to import them
    "pipelines.ingest": (ingest, Ingested),
    "pipelines.reconstruct": (reconstruct, Settings, Reconstructed),
    "pipelines.export": (export, Exported),
    "pipelines.session.errors": (DataError,),
}


def plain(annotation: object) -> str:
    """Write a type without the modules of its names."""
    text = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    return re.sub(r"\b(?:\w+\.)+(\w+)", r"\1", text)


def head(thing: Callable[..., object]) -> list[str]:
    """Write the arguments of a function, or the fields of a class, one a line."""
    if not inspect.isfunction(thing):
        fields = getattr(thing, "__annotations__", {}).items()
        return [f"class {thing.__name__}", *(f"    {name}: {plain(kind)}" for name, kind in fields)]
    signature = inspect.signature(thing)
    lines = [f"{thing.__name__}("]
    starred = False
    for argument in signature.parameters.values():
        if argument.kind is argument.KEYWORD_ONLY and not starred:
            lines.append("    *,")
            starred = True
        default = "" if argument.default is argument.empty else f" = {argument.default!r}"
        lines.append(f"    {argument.name}: {plain(argument.annotation)}{default},")
    return [*lines, f") -> {plain(signature.return_annotation)}"]


def page() -> str:
    """Write the page from the docstrings."""
    parts = [
        "# Functions for notebooks",
        "`python docs/api.py --write` makes this page from the docstrings of what\n"
        "[the notebook](notebook.md) uses. These names and signatures are part of the promise of versions.",
    ]
    for module, things in OBJECTS.items():
        for thing in things:
            body = "\n".join(["```text", *head(thing), "", inspect.getdoc(thing) or "", "```"])
            parts += [f"## `{module}.{thing.__name__}`", body]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    if "--write" in sys.argv:
        PAGE.write_text(page(), encoding="utf-8", newline="\n")
    else:
        sys.stdout.write(page())
