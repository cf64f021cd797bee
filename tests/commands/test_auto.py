"""`mocap reconstruct` without a method: every part takes part that can, and the rest is said."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tests.commands.runner import ingested, mocap, result_of, succeeds
from tests.real_data import fetch_networks
from tests.synthetic.flights import write_flight

SAMPLE = Path(__file__).parents[2] / "sample_data" / "mound_walk"
NOISE = {"white": {"position_m": 0.2, "rotation_deg": 0.7}}


def reconstructed(session: Path, *options: str) -> tuple[dict[str, Any], bytes]:
    """Reconstruct; return the metrics and the bytes of the skeleton."""
    metrics = result_of("reconstruct", session, *options)
    return metrics, (session / "reconstruct" / "skeleton.parquet").read_bytes()


def test_without_pictures_it_is_the_refinement(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=3, seconds=1.5, fps=15, pose_noise=NOISE)
    session = ingested(flight)
    unasked, skeleton = reconstructed(session)
    refined, of_refined = reconstructed(session, "--method", "refined")
    assert skeleton == of_refined
    assert unasked["method"] == "auto"
    used = unasked["method_used"]
    assert used["body"] == {"used": True, "reason": None}
    assert used["pose_noise"] == "stated"
    assert used["background"] == {"cameras": [], "reasons": {}}
    assert used["clocks"] == []
    assert unasked["mpjpe_mm"] == refined["mpjpe_mm"]


@pytest.mark.parametrize("static", [False, True], ids=["too short", "calibrated and still"])
def test_what_motion_and_bones_cannot_serve_is_left_to_robust(tmp_path: Path, static: bool) -> None:
    """Check the choices that the real recording supports (docs/estimate.md)."""
    flight = write_flight(tmp_path, seconds=1.0 if static else 0.5, static=static)
    for camera in flight.settings["cameras"].values():
        del camera["pose_noise"]
    flight.save()
    session = ingested(flight)
    unasked, skeleton = reconstructed(session)
    _, of_robust = reconstructed(session, "--method", "robust")
    assert skeleton == of_robust
    assert not unasked["method_used"]["body"]["used"]
    assert unasked["method_used"]["pose_noise"] == "none"
    if static:
        return
    assert unasked["method_used"]["body"]["reason"] == unasked["refinement"]["fallback"]
    said = mocap("reconstruct", session, "--force")
    assert unasked["method_used"]["summary"] in said.stdout


@pytest.mark.parametrize("method", ["refined", "dlt"])
def test_every_method_is_served_by_the_clocks_that_were_found(tmp_path: Path, method: str) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=3.0, static=True, pose_noise={})
    # Stamped 200 ms too early: at 1.2 m/s 240 mm beside one of two cameras; keypoints err by 26 mm.
    flight.settings["cameras"]["drone2"]["clock"] = {"offset_s": -0.2, "sigma_s": 0.2}
    flight.save()
    session = ingested(flight)
    metrics, _ = reconstructed(session, "--method", method)
    # 17 joints in 90 frames determine it to about 2 ms: two and a half of those.
    assert abs(metrics["clock_offsets_s"]["drone2"] - 0.2) < 0.005
    assert metrics["clock_offsets_s"]["drone1"] == 0.0
    assert metrics["method_used"]["clocks"] == ["drone2"]
    found = f"drone2 ({metrics['clock_offsets_s']['drone2']:+.3f} s, sigma "
    assert found in metrics["method_used"]["summary"]
    assert metrics["mpjpe_mm"] < 0.3 * 240


@pytest.mark.parametrize(
    ("cameras", "late_s", "within_s"),
    [(3, {"drone2": -0.05}, 0.005), (2, {"drone2": 0.2}, 0.02), (3, {}, 0.0)],
)
def test_a_stated_clock_that_is_wrong_is_moved_and_doubted(
    tmp_path: Path, cameras: int, late_s: dict[str, float], within_s: float
) -> None:
    """Question clocks that are stated as exact: wrong ones are found, right ones are not moved at all."""
    flight = write_flight(tmp_path, cameras=cameras, seconds=3.0 if cameras == 3 else 4.0, pose_noise={})
    for name, seconds in late_s.items():
        flight.settings["cameras"][name]["clock"]["offset_s"] = -seconds
    flight.save()
    session = ingested(flight)
    metrics, _ = reconstructed(session)
    moved = metrics.get("clocks_moved", {})
    assert moved.keys() == late_s.keys()
    assert [doubt["code"] for doubt in metrics["doubts"]] == ["clock"] * len(late_s)
    for name, seconds in late_s.items():
        assert moved[name]["by"] == "keypoints"
        assert abs(moved[name]["offset_s"] - seconds) < within_s
        (doubt,) = metrics["doubts"]
        assert doubt["remedy"].startswith(f"cameras.{name}.clock.offset_s: ")
        assert abs(float(doubt["remedy"].split()[-1])) < within_s
    assert all(
        metrics.get("clock_offsets_s", {}).get(name, 0.0) == 0.0 for name in {*flight.cameras} - {*late_s}
    )
    assert metrics["mpjpe_mm"] < 15


@pytest.mark.long
def test_backgrounds_and_ground_of_the_sample_flight_take_part(tmp_path: Path) -> None:
    """Require half of the error of `robust` (132 and 38 mm in the mean of two draws), on 4 s of 12."""
    fetch_networks("blazepose")
    session = tmp_path / "sample.session"
    succeeds("ingest", SAMPLE / "flight.yaml", "-o", session)
    span = ("--pictures", "6:10", "--workers", "2")
    unasked, _ = reconstructed(session, *span)
    used = unasked["method_used"]
    assert used["background"]["cameras"] == ["drone1", "drone2"]
    assert used["body"]["used"]
    assert {*used["ground"]["cameras"], *used["ground"]["reasons"]} == {"drone1", "drone2"}
    poses = pd.read_parquet(session / "reconstruct" / "cameras.parquet")
    assert set(poses["camera"]) == {"drone1", "drone2"}
    robust, _ = reconstructed(session, *span, "--method", "robust")
    assert unasked["mpjpe_mm"] < 0.7 * robust["mpjpe_mm"]
    assert unasked["acceleration_error_mm_s2"] < 0.2 * robust["acceleration_error_mm_s2"]
