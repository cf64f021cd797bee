"""Verdicts without truth: the expected error follows the covariances, and the grade follows both."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from pipelines.reconstruction.results import GOOD_MM, USABLE_MM, verdict

FIGURES: dict[str, Any] = {
    "reconstructed_share": 0.99,
    "reprojection_px_per_camera": {"drone1": {}, "drone2": {}, "drone3": {}},
    "method_used": {"pose_noise": "stated", "background": {"cameras": ["drone1"]}},
    "doubts": [],
}


def judged(folder: Path, sigma_m: float, **figures: Any) -> dict[str, Any]:
    """Judge a skeleton of which each coordinate has this standard deviation; one joint is missing."""
    table = pd.DataFrame({name: [sigma_m**2, sigma_m**2, float("nan")] for name in ("cxx", "cyy", "czz")})
    table["status"] = ["ok", "ok", "few_views"]
    table.to_parquet(folder / "skeleton.parquet")
    return verdict(folder, FIGURES | figures)


def test_the_expected_error_grows_with_the_covariances(tmp_path: Path) -> None:
    near, far = (judged(tmp_path, sigma_m)["expected_error_mm"] for sigma_m in (0.01, 0.1))
    assert near[0] < near[1] < near[2]
    assert far == pytest.approx([10 * value for value in near], rel=0.02)  # rounded to 0.1 mm


@pytest.mark.parametrize(("sigma_m", "grade"), [(0.01, "good"), (0.08, "usable"), (0.5, "poor")])
def test_the_grade_follows_the_expected_error(tmp_path: Path, sigma_m: float, grade: str) -> None:
    found = judged(tmp_path, sigma_m)
    assert found["grade"] == grade
    assert found["why"] == []
    assert found["next"].startswith("mocap report")
    median_mm = found["expected_error_mm"][1]
    assert {"good": median_mm <= GOOD_MM, "poor": median_mm > USABLE_MM}.get(grade, True)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    alone = judged(
        tmp_path,
        0.01,
        reprojection_px_per_camera={"drone1": {}, "drone2": {}},
        method_used={"pose_noise": "estimated", "background": {"cameras": []}},
    )
    assert len(alone["why"]) == 3  # backgrounds, cameras, pose noise


def test_a_doubted_flight_is_wrong_and_little_is_poor(tmp_path: Path) -> None:
    doubt = {"what": "the positions are in ft", "remedy": "cameras.drone1.pose.unit: ft"}
    wrong = judged(tmp_path, 0.01, doubts=[doubt])
    assert wrong["grade"] == "wrong"
    assert wrong["why"][0] == doubt["what"]
    assert "--fix" in wrong["next"]
    assert judged(tmp_path, 0.01, reconstructed_share=0.3)["grade"] == "poor"
