"""Cost and order of imports, which only a fresh process can show."""

import resource
import subprocess
import sys

from tests.commands.runner import MOCAP

# Without the order set in pipelines/__init__.py, this hangs or aborts if pycolmap is imported first.
PNG_AFTER_PYCOLMAP = """
import pipelines
import pycolmap
import zlib, cv2, numpy
data = numpy.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=numpy.uint8)
ok, png = cv2.imencode(".png", data)
assert ok and (cv2.imdecode(png, cv2.IMREAD_COLOR) == data).all()
assert zlib.decompress(zlib.compress(data.tobytes())) == data.tobytes()
"""

NO_TERMINAL_IN_PIPELINES = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("click", "rich"):
            raise ImportError(name)
sys.meta_path.insert(0, Refuse())
import pipelines.ingest, pipelines.reconstruct, pipelines.report, pipelines.export, pipelines.survey
import pipelines.replan, pipelines.simulate, pipelines.study
"""

LIGHT_HELP = """
import sys
import mocap_cli.main
heavy = {"numpy", "pandas", "scipy", "cv2", "numba", "matplotlib", "pycolmap", "pyarrow", "rich"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""


def run(code: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr


def test_png_encoding_survives_pycolmap() -> None:
    run(PNG_AFTER_PYCOLMAP)


def test_pipelines_run_without_the_terminal_libraries() -> None:
    run(NO_TERMINAL_IN_PIPELINES)


def test_help_loads_nothing_heavy() -> None:
    run(LIGHT_HELP)


def test_help_costs_at_most_300_ms_more_than_python_itself() -> None:
    """Compare the least CPU seconds of several runs, because a busy machine slows every run."""

    def least_s(command: list[str]) -> float:
        return min(_cpu_s_of(command) for _ in range(5))

    assert least_s([MOCAP, "--help"]) - least_s([sys.executable, "-c", "pass"]) < 0.3


def _cpu_s_of(command: list[str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, capture_output=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
