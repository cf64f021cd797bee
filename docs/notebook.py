"""Makes examples/notebook.ipynb: the lines of notebook.md, run on the sample flight, with all their output.

`python docs/notebook.py --write` runs them in a copy of sample_data/mound_walk: about a minute.
"""

import base64
import contextlib
import io
import json
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib as mpl

PAGE = Path(__file__).with_name("notebook.md")
NOTEBOOK = PAGE.parents[1] / "examples" / "notebook.ipynb"
FLIGHT = PAGE.parents[1] / "sample_data" / "mound_walk"


def cells_of(page: str) -> list[str]:
    """Split the lines of code of a page where they are blank; imports stay together."""
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    parts: list[str] = []
    for part in code.strip().split("\n\n"):
        if parts and part.startswith(("import ", "from ")):
            parts[-1] += f"\n\n{part}"
        else:
            parts.append(part)
    return parts


def executed(code: str, number: int, names: dict[str, Any]) -> dict[str, Any]:
    """Run a cell in the current folder; return it with its output and the figures that it saved."""
    printed = io.StringIO()
    earlier = set(Path().glob("*.png"))
    with contextlib.redirect_stdout(printed):
        exec(compile(code, f"cell {number}", "exec"), names)  # noqa: S102  # the page's own lines
    outputs: list[dict[str, Any]] = [
        {
            "output_type": "display_data",
            "metadata": {},
            "data": {
                "image/png": base64.b64encode(path.read_bytes()).decode(),
                "text/plain": [path.name],
            },
        }
        for path in sorted(set(Path().glob("*.png")) - earlier)
    ]
    if printed.getvalue():
        text = printed.getvalue().splitlines(keepends=True)
        outputs.append({"output_type": "stream", "name": "stdout", "text": text})
    return {
        "cell_type": "code",
        "execution_count": number,
        "metadata": {},
        "outputs": outputs,
        "source": code.splitlines(keepends=True),
    }


def notebook() -> dict[str, Any]:
    """Run the page's lines on a copy of the sample flight; return the notebook (nbformat 4.4)."""
    mpl.use("agg")
    page = PAGE.read_text(encoding="utf-8")
    begun = Path.cwd()
    names: dict[str, Any] = {}
    intro = (
        "# The sample flight in a notebook\n\n"
        "The lines of `notebook.md` on the flight that `mocap init --example` copies (rendered, two drones)."
    )
    with tempfile.TemporaryDirectory() as folder:
        copy = shutil.copytree(FLIGHT, Path(folder) / "mound_walk")
        os.chdir(copy)
        try:
            cells = [executed(code, k, names) for k, code in enumerate(cells_of(page), 1)]
        finally:
            os.chdir(begun)
    return {
        "cells": [
            {"cell_type": "markdown", "metadata": {}, "source": intro.splitlines(keepends=True)},
            *cells,
        ],
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 4,
    }


if __name__ == "__main__":
    made = json.dumps(notebook(), indent=1) + "\n"
    if "--write" in sys.argv:
        NOTEBOOK.write_text(made, encoding="utf-8", newline="\n")
    else:
        sys.stdout.write(made)
