"""Calibrated confidences of a detector: they change the weights of keypoints, not which are used or drawn."""

from pathlib import Path

import pytest

import pipelines.export
import pipelines.reporting.overlays
from pipelines.export import export
from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.report import report
from pipelines.reporting.overlays import FilmedCamera, views_of
from pipelines.session.tables import JOINT_ERRORS, figures_by_joint, read_table
from tests.keypoints.spotted_flights import CAMERAS, spot_detector, write_spotted_flight


def test_keypoints_of_little_worth_are_used_and_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The calibrated confidence of wrists is always 0.1, below the least confidence; that of others is 0.9.
    measured = tmp_path / "measured.csv"
    head = "# made by: a test\n# probability that a joint is near\njoints,confidence,probability,count\n"
    measured.write_text(f"{head}*,0.5,0.9,100\nwrist,0.5,0.1,100\n", encoding="utf-8")
    for place in ("pipelines.keypoints.corrections", "pipelines.reconstruct"):
        monkeypatch.setattr(f"{place}.measured_for", lambda _: measured)
    session = tmp_path / "flight.session"
    ingest(write_spotted_flight(tmp_path, 6), session)
    reconstruct(session, ReconstructSettings(detector=spot_detector(tmp_path)))
    stored = read_table(session / "reconstruct" / "joint_errors.parquet", JOINT_ERRORS)
    for joint in ("left_wrist", "left_elbow"):
        assert figures_by_joint(stored)[joint]["reconstructed_share"] == 1

    drawn: list[FilmedCamera] = []

    def watched(camera: FilmedCamera, *others: object) -> object:
        drawn.append(camera)
        return views_of(camera, *others)  # type: ignore[arg-type]

    for module in (pipelines.export, pipelines.reporting.overlays):
        monkeypatch.setattr(module, "views_of", watched)
        drawn.clear()
        if module is pipelines.export:
            export(session, ["overlay"])
        else:
            report(session)
        assert {camera.name for camera in drawn} == set(CAMERAS)
        for camera in drawn:
            joints = set(camera.keypoints["joint"])
            assert {"left_elbow", "left_wrist", "right_wrist"} <= joints
