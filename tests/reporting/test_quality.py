"""The table of data quality, against errors that were put in."""

from dataclasses import replace

import numpy as np

from pipelines.reporting.content import SessionContent
from pipelines.reporting.summary import summarise, table_of_quality
from pipelines.reporting.wording import THIN
from pipelines.session.tables import COVARIANCE_COLUMNS

from .conftest import described, make_poses, make_session

STATED, OFFSET, SIGMA, DETECTED, CONFIDENT = range(1, 6)


def _rows(content: SessionContent) -> dict[str, list[str]]:
    """Return the rows of the table by camera."""
    rows = table_of_quality(content, summarise(content)).rows
    return {str(row[0]): [str(cell) for cell in row] for row in rows}


def test_who_states_the_pose_noise_is_said(content: SessionContent) -> None:
    session = make_session()
    cameras = session["cameras"]
    assert isinstance(cameras, dict)
    noise = {"white": {"position_m": 0.1, "rotation_deg": 0.5}, "bias": {"frame": "body", "position_m": 0.2}}
    cameras["drone1"]["pose_noise"] = noise
    logged = make_poses()["drone2"]
    logged[list(COVARIANCE_COLUMNS)] = np.eye(6)[np.triu_indices(6)] * 0.04
    stated = _rows(replace(content, session=described(session), poses=content.poses | {"drone2": logged}))
    white, bias = stated["drone1"][STATED].split("; ")
    assert white == "white position_m 0.1, rotation_deg 0.5"
    assert bias == "bias frame body, position_m 0.2"
    assert stated["drone2"][STATED].endswith(f"log: 0.200{THIN}m, {np.degrees(0.2):.2f}{THIN}deg")
    # Nobody states the noise of a camera that stands still, and of one that moves.
    assert stated["mast"][STATED].endswith("still")
    assert _rows(content)["drone1"][STATED] == "nothing"


def test_clocks_and_detections(content: SessionContent) -> None:
    keypoints = content.keypoints["mast"].copy()
    keypoints.loc[: len(keypoints) // 4 - 1, "confidence"] = 0.1
    clocks = {"clock_offsets_s": {"drone2": -0.05}, "clock_offset_sigmas_s": {"drone2": 0.004}}
    metrics = {**(content.metrics or {}), **clocks}
    rows = _rows(
        replace(
            content,
            metrics=metrics,
            keypoints=content.keypoints | {"mast": keypoints},
        )
    )
    assert rows["drone2"][OFFSET] == f"0.120{THIN}s −0.050{THIN}s"
    assert rows["drone2"][SIGMA].startswith(f"±{THIN}0.200{THIN}s")
    assert rows["drone2"][SIGMA].endswith(f"±{THIN}0.004{THIN}s")
    assert rows["drone1"][SIGMA].count("±") <= 1  # not estimated
    assert rows["mast"][DETECTED:] == [f"95.0{THIN}%", f"75.0{THIN}%"]
