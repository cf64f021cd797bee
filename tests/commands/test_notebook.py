"""The lines of docs/notebook.md run as they stand, on a small flight."""

from __future__ import annotations

import base64
import json
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


def test_the_executed_notebook_has_the_lines_of_the_page() -> None:
    made = json.loads((PAGE.parents[1] / "examples" / "notebook.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in made["cells"] if cell["cell_type"] == "code"]
    expected = runpy.run_path(str(PAGE.with_suffix(".py")))["cells_of"](PAGE.read_text(encoding="utf-8"))
    assert ["".join(cell["source"]) for cell in cells] == expected, "run `python docs/notebook.py --write`"
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} == {"display_data", "stream"}
    (figure,) = (output["data"]["image/png"] for output in outputs if "data" in output)
    assert base64.b64decode(figure).startswith(b"\x89PNG")


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
