"""Tests of arrays that wait in files."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.session.parallel import Waiting


@dataclass(frozen=True)
class Held:
    name: str
    values: dict[str, Float]
    nothing: None = None


def resident_bytes() -> int:
    """Return the memory that the process has, pages of files included."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_waiting_arrays_keep_their_values_and_changes(tmp_path: Path) -> None:
    waiting = Waiting(tmp_path)
    values = {"a": np.arange(12.0).reshape(3, 4), "b": np.empty((0, 2)), "c": np.full(3, np.nan)}
    held = waiting.put(Held("drone1", values))
    assert held.name == "drone1"
    held.values["a"][1, 2] = -1.0
    waiting.release()
    expected = values["a"].copy()
    expected[1, 2] = -1.0
    np.testing.assert_array_equal(held.values["a"], expected)
    np.testing.assert_array_equal(held.values["c"], values["c"])
    assert held.values["b"].shape == (0, 2)
    assert values["a"][1, 2] == 6.0  # a copy
    assert all(array.ctypes.data % 64 == 0 and array.flags.writeable for array in held.values.values())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system does not say it there")
def test_waiting_arrays_take_no_memory_until_they_are_used(tmp_path: Path) -> None:
    """Compare 64 MB in use and waiting; a quarter of that is left for everything else."""
    waiting = Waiting(tmp_path)
    held = waiting.put(np.ones(8 << 20))
    assert float(held.sum()) == 8 << 20
    used = resident_bytes()
    waiting.release()
    assert used - resident_bytes() > 48e6
    assert float(held.sum()) == 8 << 20
