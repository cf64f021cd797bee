"""The lines of docs/notebook.md run as they stand, on a small flight."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

from tests.synthetic.flights import write_flight

PAGE = Path(__file__).parents[2] / "docs" / "notebook.md"


def test_the_page_of_functions_is_that_of_the_docstrings() -> None:
    made = runpy.run_path(str(PAGE.with_name("api.py")))["page"]()
    assert made == PAGE.with_name("api.md").read_text(encoding="utf-8"), "run `python docs/api.py --write`"


def test_the_lines_of_the_notebook_run(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
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
    assert {path.suffix for path in (tmp_path / "notebook.export").iterdir()} == {
        ".trc",
        ".csv",
        ".sto",
        ".json",
    }
