"""The real detector on real pictures, from video files to a skeleton, as commands."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pipelines.formats.skeletons.trc import FORMAT as TRC
from pipelines.session.registries import find_detector
from pipelines.session.tables import motion_from
from tests.commands.runner import content, measured, mocap_process, refused, succeeds
from tests.real_data import real_data

EVERY = 20


def _fetch() -> None:
    if None in find_detector("blazepose").models().values():
        fetched = mocap_process("models", "fetch", "blazepose", timeout=300)
        if fetched.returncode:
            pytest.skip(f"the detector's networks cannot be fetched here: {fetched.stderr.strip()}")


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Make a flight of four videos with their calibration, without keypoints."""
    _fetch()
    recording = real_data("pose2sim_single")
    shutil.copytree(recording / "videos", tmp_path / "videos")
    calibration = recording / "calibration" / "Calib_qualisys.toml"
    lines = ["schema: 1", "name: Detected", "cameras:"]
    for name in ("cam01", "cam02", "cam03", "cam04"):
        where = f"pose: {{file: {calibration}}}, intrinsics: {calibration}"
        lines.append(f"  {name}: {{video: videos/{name}.mp4, {where}}}")
    path = tmp_path / "flight.yaml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    succeeds("ingest", path)
    return path


@pytest.mark.slow
def test_detector_and_triangulation_agree_with_the_peers_skeleton(flight: Path) -> None:
    session = flight.with_suffix(".session")
    result = measured(session, "--pictures", f"::{EVERY}")
    assert result["reconstructed_share"] > 0.95
    peer = TRC.read_joints(real_data("pose2sim_single/pose-3d/single_0-99.trc"), unit=None, axes=None)
    ours = motion_from(pd.read_parquet(session / "reconstruct" / "skeleton.parquet"), peer.joints)
    apart_mm = 1e3 * np.linalg.norm(ours.position - peer.position[::EVERY], axis=-1)
    # Two detectors do not mean the same places by hips and shoulders: some centimetres, never a limb.
    assert np.nanmedian(apart_mm) < 60
    assert np.isfinite(apart_mm[..., peer.joints.index("left_knee")]).mean() > 0.9

    # Not the detector's again: its keypoints are kept while pictures and settings are the same.
    (flight.parent / "videos" / "cam01.mp4").unlink()
    succeeds("reconstruct", session, "--pictures", f"::{EVERY}", "--method", "dlt")
    assert "cam01.mp4" in refused(
        "reconstruct", session, "--method", "robust", "--pictures", f"::{2 * EVERY}"
    )


@pytest.mark.long
def test_keypoints_do_not_depend_on_workers(flight: Path) -> None:
    session = flight.with_suffix(".session")
    results = []
    for workers in ("1", "2"):
        shutil.rmtree(session / "detect", ignore_errors=True)
        succeeds(
            "reconstruct",
            session,
            "--method",
            "robust",
            "--pictures",
            "::50",
            "--workers",
            workers,
            "--force",
        )
        results.append(content(session))
    assert results[0] == results[1]
