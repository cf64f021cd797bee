"""Restarts and steps of GPS time in the logs of autopilots: all times are right, and it is said."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.drone_logs import ardupilot, tlog, ulog
from pipelines.session.registries import TelemetryChoice, TelemetryFormat
from tests.synthetic.drone_logs import (
    DroneTruth,
    drone_of,
    ulog_rows,
    write_dataflash,
    write_tlog,
    write_ulog,
)
from tests.synthetic.flights import write_flight

Writer = Callable[[Path, DroneTruth], Path]
LOGS: dict[str, tuple[TelemetryFormat, Writer]] = {
    "bin": (ardupilot.FORMAT, write_dataflash),
    "tlog": (tlog.FORMAT, write_tlog),
    "ulg": (ulog.FORMAT, lambda path, truth: write_ulog(path, ulog_rows(truth))),
}


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> DroneTruth:
    return drone_of(write_flight(tmp_path_factory.mktemp("flight"), cameras=1, seconds=3.0, clean=True), 0)


@pytest.mark.parametrize("kind", LOGS)
@pytest.mark.parametrize("steps", [{20: -1}, {45: -1}, {20: 2}, {15: -1, 40: 1}, {45: 0.4}])
def test_after_a_step_of_gps_time_the_last_times_count(
    tmp_path: Path, truth: DroneTruth, monkeypatch: pytest.MonkeyPatch, kind: str, steps: dict[int, float]
) -> None:
    reader, write = LOGS[kind]
    true_ns, boot_us = truth.t_ns, truth.boot_us
    stepped = true_ns.copy()
    for row, step_s in steps.items():
        stepped[row:] += round(step_s * 10**9)
    monkeypatch.setattr(DroneTruth, "boot_us", boot_us)
    object.__setattr__(truth, "t_ns", stepped)
    path = write(tmp_path / f"a.{kind}", truth)
    object.__setattr__(truth, "t_ns", true_ns)
    telemetry = reader.read_telemetry(path, TelemetryChoice())
    late_ns = telemetry.position.t_ns - true_ns[-len(telemetry.position.t_ns) :]
    assert np.abs(late_ns - sum(steps.values()) * 10**9).max() < 2_500_000  # whole ms since boot and of GPS
    assert len([note for note in telemetry.notes if "GPS time steps" in note]) == 1
    assert telemetry.fit is not None
    assert telemetry.fit.steps_s == pytest.approx(tuple(steps.values()), abs=2e-3)


def restarted(truth: DroneTruth, monkeypatch: pytest.MonkeyPatch, rows: Sequence[int]) -> None:
    boot_us = truth.boot_us.copy()
    for row in rows:
        boot_us[row:] -= boot_us[row] - 300_000
    monkeypatch.setattr(DroneTruth, "boot_us", boot_us)


@pytest.mark.parametrize("rows", [[30], [10], [20, 60]])
def test_restarts_in_a_log_of_ardupilot(
    tmp_path: Path, truth: DroneTruth, monkeypatch: pytest.MonkeyPatch, rows: list[int]
) -> None:
    restarted(truth, monkeypatch, rows)
    path = write_dataflash(tmp_path / "a.bin", truth)
    telemetry = ardupilot.FORMAT.read_telemetry(path, TelemetryChoice())
    assert telemetry.dropped == {}
    assert np.abs(telemetry.position.t_ns - truth.t_ns).max() < 1_500_000  # GPS time has whole ms
    assert telemetry.body is not None
    assert np.abs(telemetry.body.t_ns - truth.t_ns).max() < 1_500_000
    assert len([note for note in telemetry.notes if f"restarted {len(rows)} times" in note]) == 1
    times = ardupilot.FORMAT.picture_times(path, TelemetryChoice())
    assert np.abs(times - truth.t_ns).max() < 1_500_000


def test_after_a_restart_without_gps_time_rows_are_left_out(
    tmp_path: Path, truth: DroneTruth, monkeypatch: pytest.MonkeyPatch
) -> None:
    restarted(truth, monkeypatch, [30])
    path = write_dataflash(tmp_path / "a.bin", truth, kinds=("POS", "ATT"))
    telemetry = ardupilot.FORMAT.read_telemetry(path, TelemetryChoice())
    np.testing.assert_array_equal(telemetry.position.t_ns, truth.boot_us[:30] * 1000)
    assert sum(telemetry.dropped.values()) == 2 * (len(truth.t_ns) - 30)
