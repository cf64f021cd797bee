"""The whole pipeline from files to a measured skeleton, as commands."""

import json
import re
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tests.commands.runner import ingested, mocap, succeeds
from tests.synthetic.flights import SyntheticFlight, write_flight

METHODS = ("dlt", "midpoint", "robust")


def metrics(session: Path, *options: str) -> dict[str, Any]:
    result: dict[str, Any] = json.loads(succeeds("reconstruct", session, "--json", "-q", *options))
    return result


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> SyntheticFlight:
    return write_flight(tmp_path_factory.mktemp("flight"), cameras=3, seconds=0.5)


@pytest.fixture(scope="module")
def session(flight: SyntheticFlight) -> Path:
    """Return a session with a skeleton by `robust`."""
    succeeds("ingest", flight.manifest)
    folder = flight.manifest.with_suffix(".session")
    succeeds("reconstruct", folder, "--method", "robust")
    return folder


@pytest.mark.parametrize(
    ("cameras", "static", "keypoints", "poses"),
    [(2, False, "alphapose", "tum"), (3, False, "openpose", "csv"), (5, True, "coco", "tum")],
)
def test_flight_without_noise_is_reconstructed_below_half_a_millimetre(
    tmp_path: Path, cameras: int, static: bool, keypoints: str, poses: str
) -> None:
    # What is left is rounding of pixels to 0.001 px (0.01 mm at 10 m) and pose interpolation (3 um).
    flight = write_flight(
        tmp_path,
        cameras=cameras,
        static=static,
        clean=True,
        keypoint_format=keypoints,
        pose_format=poses,
        seconds=0.5,
    )
    session = ingested(flight)
    for method in METHODS:
        result = metrics(session, "--method", method)
        assert result["method"] == method
        assert result["mpjpe_mm"] < 0.5
        assert result["reconstructed_share"] == 1.0
        assert result["reprojection_px"]["median"] < 0.05


def test_bystander_whom_one_camera_misses_is_not_the_actor(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=4, bystander=True, clean=True, seconds=0.5)
    # The bystander stands first in every frame, but drone4's detector does not report him.
    keypoints = tmp_path / "drone4.json"
    people = json.loads(keypoints.read_text(encoding="utf-8"))
    keypoints.write_text(json.dumps([p for p in people if p["idx"] == 1]), encoding="utf-8")
    session = ingested(flight)
    assert metrics(session)["mpjpe_mm"] < 0.5
    both = metrics(session, "--persons", "2")
    assert both["mpjpe_mm"] < 0.5
    assert both["status_counts"]["all"] == 2 * metrics(session)["status_counts"]["all"]


def test_tables_are_read_by_pandas_alone(flight: SyntheticFlight, session: Path) -> None:
    skeleton = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    assert len(skeleton) == len(flight.t_ns) * len(flight.joints)
    assert list(skeleton["t_ns"].unique()) == list(flight.t_ns)
    missing = skeleton["status"] != "ok"
    assert skeleton.loc[missing, ["x", "y", "z", "czz"]].isna().all(axis=None)
    assert skeleton.loc[~missing, ["x", "y", "z", "czz", "reprojection_px"]].notna().all(axis=None)
    assert (skeleton.loc[~missing, "views"] >= 2).all()
    frames = pd.read_parquet(session / "cameras" / "drone1" / "frames.parquet")
    assert list(frames.columns) == ["frame", "t_ns", "pts_ns"]


def test_unchanged_stages_are_skipped_and_changed_settings_replace(
    flight: SyntheticFlight, session: Path
) -> None:
    assert "unchanged" in succeeds("ingest", flight.manifest)
    assert "unchanged" in succeeds("reconstruct", session, "--method", "robust")
    assert "written" in succeeds("reconstruct", session, "--method", "robust", "--force")
    replaced = mocap("reconstruct", session, "--method", "dlt")
    assert re.search(r"\bmethod\b.*\brobust\b.*\bdlt\b", replaced.stderr)
    assert "written" in replaced.stdout
