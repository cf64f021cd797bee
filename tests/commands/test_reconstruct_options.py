"""Options of `mocap reconstruct`: disturbed poses, filled gaps, smoothing, logged covariances."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result
from scipy.stats import t

from mocap_cli.main import Mocap
from mocap_cli.reconstruct import reconstruct_command
from pipelines.session.storage import read_json
from tests.commands.runner import ingested, succeeds
from tests.synthetic.flights import SyntheticFlight, write_flight


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> tuple[SyntheticFlight, Path]:
    """Ingest a flight without errors, whose first camera misses the left wrist for four frames."""
    folder = tmp_path_factory.mktemp("clean")
    flight = write_flight(folder, cameras=2, seconds=2.0, clean=True)
    keypoints = json.loads((folder / "drone1.json").read_text(encoding="utf-8"))
    wrist = flight.joints.index("left_wrist")
    for entry in keypoints:
        if 20 <= int(Path(entry["image_id"]).stem) < 24:
            entry["keypoints"][3 * wrist : 3 * wrist + 3] = [0.0, 0.0, 0.0]
    (folder / "drone1.json").write_text(json.dumps(keypoints), encoding="utf-8")
    session = folder / "flight.session"
    succeeds("ingest", flight.manifest, "-o", session)
    return flight, session


def command(session: Path, *options: str) -> Result:
    """Run the command in this process, because starting one takes longer than the work."""
    arguments = ["reconstruct", str(session), "--workers", "1", "--method", "robust", *options]
    return CliRunner().invoke(Mocap(commands=[reconstruct_command]), arguments)


def run(session: Path, *options: str) -> dict[str, Any]:
    done = command(session, *options, "--json")
    assert done.exit_code == 0, (done.output, done.exception)
    told: dict[str, Any] = json.loads(done.stdout)
    return told


def stage(session: Path) -> dict[str, Any]:
    return read_json(session / "reconstruct" / "stage.json")


def test_disturbed_poses_err_as_their_model_says(clean: tuple[SyntheticFlight, Path]) -> None:
    flight, session = clean
    model = "bias:position_m=0.1"
    metrics = run(session, "--disturb-poses", f"{model} x4 seed=3")
    trials = metrics["trials"]
    assert trials["count"] == len(trials["each"]) == 4
    assert trials["disturb_poses"] == model
    assert trials["each"][0]["mpjpe_mm"] == metrics["mpjpe_mm"]
    errors = [each["mpjpe_mm"] for each in trials["each"]]
    assert trials["mean"]["mpjpe_mm"] == pytest.approx(np.mean(errors))
    assert trials["std"]["mpjpe_mm"] == pytest.approx(np.std(errors, ddof=1))
    low, high = trials["intervals"]["mpjpe_mm"]
    half = t.ppf(0.975, 3) * np.std(errors, ddof=1) / 2  # Student's interval of the mean of four
    assert (low, high) == pytest.approx((np.mean(errors) - half, np.mean(errors) + half))
    # Two rays at a right angle, 15 deg up, each off by 0.1 m per axis: RMS = 0.1 sqrt(2.51) = 158 mm (the
    # trace of docs/results.md). Four draws of three numbers scatter by 1 / sqrt(2 x 12) = 20 %.
    rms = np.sqrt(np.mean([each["e_recon_per_joint_frame_m2"] for each in trials["each"]]))
    assert rms == pytest.approx(0.158, rel=0.6)
    # The first trial is stored, and a warning of the stage says so.
    skeleton = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    points = skeleton[["x", "y", "z"]].to_numpy().reshape(len(flight.t_ns), -1, 3)
    distance = np.linalg.norm(points - flight.position, axis=-1)
    assert np.nanmean(distance) * 1e3 == pytest.approx(metrics["mpjpe_mm"], rel=1e-6)
    record = stage(session)
    assert record["settings"]["disturb_poses"] == f"{model} x4 seed=3"
    assert any(model in warning for warning in record["warnings"])
    # The same again is the same; another seed is not.
    assert run(session, "--disturb-poses", f"{model} x4 seed=3") == metrics
    other = run(session, "--disturb-poses", f"{model} x2 seed=4")
    assert other["trials"]["each"] != trials["each"][:2]


def test_people_beyond_those_asked_for_are_counted_and_said(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=3, bystander=True, clean=True)
    session = ingested(flight)
    times = len(flight.t_ns)
    passing = {
        name: len(json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8"))) - times
        for name in flight.cameras
    }
    assert run(session)["people"] == {
        "asked": 1,
        "phantoms": {},
        "doubted": {},
        "names": ["person0"],
        "seen_at_once": 2,
        "times": times,
        "times_with_more": times,
        "detections_not_used": passing,
    }
    (line,) = [line for line in stage(session)["warnings"] if "--persons" in line]
    assert f"drone1 {passing['drone1']}, drone2 {passing['drone2']}" in line
    assert re.search(rf"\b2\b.*\b1\b.*\b{times}\b.*\b{times}\b.*--persons 2\b", line)
    both = run(session, "--persons", "2")["people"]
    assert both["seen_at_once"] == both["asked"] == 2
    assert both["times_with_more"] == 0
    assert set(both["detections_not_used"].values()) == {0}
    assert not any("--persons" in line for line in stage(session)["warnings"])


def test_gaps_stay_open_until_somebody_asks(clean: tuple[SyntheticFlight, Path]) -> None:
    flight, session = clean
    open_gap = run(session)
    assert open_gap["status_counts"]["few_views"] == 4
    assert open_gap["filled"] is None
    assert stage(session)["counts"]["filled"] is None
    closed = run(session, "--smooth", "fill:max_s=0.2")
    assert closed["status_counts"] == {
        "all": open_gap["status_counts"]["all"],
        "ok": open_gap["status_counts"]["ok"],
        "filled": 4,
    }
    assert stage(session)["counts"]["filled"]["joint_frames"] == 4
    # Filled joints change no figure of the measured ones.
    assert closed["mpjpe_mm"] == open_gap["mpjpe_mm"]
    assert closed["reconstructed_share"] == open_gap["reconstructed_share"]
    skeleton = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    filled = skeleton[skeleton["status"] == "filled"]
    assert set(filled["joint"]) == {"left_wrist"}
    assert (filled["views"] == 0).all()
    assert filled["reprojection_px"].isna().all()
    rows = np.searchsorted(flight.t_ns, filled["t_ns"].to_numpy())
    truth = flight.position[rows, flight.joints.index("left_wrist")]
    error = np.linalg.norm(filled[["x", "y", "z"]].to_numpy() - truth, axis=1)
    assert closed["filled_mpjpe_mm"] == pytest.approx(1e3 * error.mean(), rel=1e-4)  # truth.csv is rounded
    sigma = np.sqrt(filled[["cxx", "cyy", "czz"]].sum(axis=1).to_numpy())
    assert (error < 4 * sigma).all()


def test_smoothing_is_said_and_lowers_what_noise_does(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=3, seconds=1.0, pose_noise={"white": {"position_m": 0.1}})
    session = ingested(flight)
    rough = run(session)
    assert rough["smoothing"] is None
    smooth = run(session, "--smooth", "butterworth:cutoff_hz=4,order=4")
    assert smooth["smoothing"]["filter"] == "butterworth"
    assert stage(session)["counts"]["smoothing"] == smooth["smoothing"]
    assert smooth["status_counts"] == rough["status_counts"]
    # White noise at 30 Hz through 4 Hz keeps sqrt(4/15) = 0.52 of it; acceleration falls far more.
    assert smooth["mpjpe_mm"] < 0.8 * rough["mpjpe_mm"]
    assert smooth["acceleration_error_mm_s2"] < 0.2 * rough["acceleration_error_mm_s2"]
    assert smooth["reprojection_px"]["mean"] != rough["reprojection_px"]["mean"]


def test_intervals_are_about_their_figures(clean: tuple[SyntheticFlight, Path]) -> None:
    _, session = clean
    metrics = run(session, "--disturb-poses", "white:position_m=0.05")
    intervals = metrics["intervals"]
    assert (intervals["level"], intervals["seed"]) == (0.95, 0)
    assert intervals["stretch_s"] == pytest.approx(0.4)  # a fifth of two seconds
    for name in (
        "mpjpe_mm",
        "root_mpjpe_mm",
        "pa_mpjpe_mm",
        "e_recon_m2",
        "pck150",
        "acceleration_error_mm_s2",
    ):
        low, high = intervals[name]
        assert low <= metrics[name] <= high
    stored = pd.read_parquet(session / "reconstruct" / "joint_errors.parquet")
    nose = stored[(stored["joint"] == "nose") & (stored["figure"] == "mpjpe_mm")]
    assert (nose["low"] < nose["value"]).all()
    assert (nose["value"] < nose["high"]).tolist() == [True]
    bones = pd.read_parquet(session / "reconstruct" / "bones.parquet")
    assert bones["median_mm"].between(50, 600).all()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--disturb-poses", "white"), "--disturb-poses"),
        (("--disturb-poses", "white:position_m=0"), "disturbs nothing"),
        (("--smooth", "fill:max_s=60"), "--smooth"),
        (("--smooth", "kalman:q=1"), "no such filter"),
        (("--smooth", "butterworth:cutoff_hz=15"), "half the skeleton's rate"),
    ],
)
def test_nonsense_is_refused_in_a_line(
    clean: tuple[SyntheticFlight, Path], options: tuple[str, ...], said: str
) -> None:
    done = command(clean[1], *options)
    assert done.exit_code == 1, (done.output, done.exception)
    (line,) = done.stderr.strip().splitlines()
    assert said in line
