"""The first flight of docs/index.md, run from its own text: commands work and print what the page shows."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "index.md"


class Step(NamedTuple):
    """Commands of the page, and the end of the output that it shows below them; empty where it shows none."""

    script: str
    shown: list[str]


def steps_of(page: str) -> list[Step]:
    """Return the indented commands and the blocks of Python of a page, in order."""
    shell = r"(?P<shell>(?:^ {4}\S.*\n(?: {4,}.*\n)*)+)"
    python = r"^```python\n(?P<python>(?:(?!```).*\n)*)```\n"
    output = r"(?:\n*```text\n(?P<shown>(?:(?!```).*\n)*)```\n)?"
    found = re.finditer(f"(?:{shell}|{python}){output}", page, re.MULTILINE)
    return [
        Step(each["shell"] or f"python - <<'END'\n{each['python']}END\n", (each["shown"] or "").splitlines())
        for each in found
    ]


def without_numbers(lines: list[str]) -> list[str]:
    """Replace numbers, whose last digits differ between processors, and the blanks that align them."""
    return [" ".join(re.sub(r"run-\w+|-?\d[\d.]*", "#", line).split()) for line in lines]


@pytest.mark.long
def test_the_first_flight_goes_as_the_page_says(tmp_path: Path) -> None:
    steps = steps_of(PAGE.read_text(encoding="utf-8"))
    assert sum(bool(step.shown) for step in steps) >= 5
    # Rendering the films again takes minutes; the sample is what the first command writes.
    assert "mocap simulate --example mound_walk -o field_day" in steps[0].script
    shutil.copytree(ROOT / "sample_data" / "mound_walk", tmp_path / "field_day")
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for step in steps[1:]:
        done = subprocess.run(
            ["bash", "-e", "-c", step.script],
            cwd=tmp_path,
            env={**os.environ, "PATH": programs, "COLUMNS": "100"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        assert done.returncode == 0, (step.script, done.stdout)
        printed = without_numbers(done.stdout.splitlines())
        assert printed[len(printed) - len(step.shown) :] == without_numbers(step.shown), step.script
