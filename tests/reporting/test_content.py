"""The cameras as used by a reconstruction: refined poses before logged ones, frames by estimated clocks."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.reporting.content import SessionContent, as_reconstructed
from pipelines.reporting.overlays import collect_moments
from pipelines.reporting.summary import summarise

from .conftest import ASIDE_PX, CAMERAS

TURN_RAD = 0.01
"""Error of the logged pose of drone1: 14 px at a focal length of 1400 px."""
OFFSET_S = 0.2


def _misplaced(content: SessionContent) -> SessionContent:
    """Turn the logged drone1 about its own x axis; the refined poses are right."""
    from scipy.spatial.transform import Rotation

    logged = content.poses["drone1"].copy()
    turn = Rotation.from_rotvec([TURN_RAD, 0, 0])
    columns = ["qx", "qy", "qz", "qw"]
    logged[columns] = (Rotation.from_quat(logged[columns].to_numpy()) * turn).as_quat()
    poses = content.poses | {"drone1": logged}
    return replace(content, poses=poses, refined={"drone1": content.poses["drone1"]})


def _residual_px(content: SessionContent, camera: str) -> float:
    medians = [
        view.median_px
        for moment in collect_moments(content, summarise(content), None)
        for view in moment.views
        if view.camera == camera and view.median_px is not None
    ]
    return float(np.median(medians))


def test_residuals_are_those_of_refined_poses(content: SessionContent) -> None:
    misplaced, aside = _misplaced(content), float(np.linalg.norm(ASIDE_PX))
    assert _residual_px(misplaced, "drone1") > aside + 4  # 14 px across or along 5 px leave 9 px at least
    assert _residual_px(as_reconstructed(misplaced), "drone1") == pytest.approx(aside, abs=0.05)
    assert _residual_px(as_reconstructed(misplaced), "drone2") == _residual_px(misplaced, "drone2")


def test_frames_come_by_the_clocks_that_were_estimated(content: SessionContent) -> None:
    early = content.frames["drone1"].assign(t_ns=content.frames["drone1"]["t_ns"] - round(OFFSET_S * 1e9))
    metrics = {**(content.metrics or {}), "clock_offsets_s": {"drone1": OFFSET_S, "drone2": None}}
    late = replace(content, frames=content.frames | {"drone1": early}, metrics=metrics)
    mended = as_reconstructed(late)
    for name in CAMERAS:
        assert mended.frames[name]["t_ns"].tolist() == content.frames[name]["t_ns"].tolist()
