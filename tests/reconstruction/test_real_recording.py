"""A real recording with four still cameras, against the result that Pose2Sim 0.10.49 published of it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipelines.formats.skeletons.trc import FORMAT as TRC
from pipelines.session.tables import motion_from
from tests.commands.runner import succeeds
from tests.real_data import real_data

PEER_MEDIAN_PX = 10.7  # Pose2Sim's points over all views, rejected ones included


def manifest_of(folder: Path, keypoints: str | None = None) -> Path:
    """Write a flight.yaml of a dozen lines, as a user would; of the videos where no keypoints are named."""
    recording = real_data("pose2sim_single")
    calibration = recording / "calibration" / "Calib_qualisys.toml"
    lines = ["schema: 1", "name: Pose2Sim demo", "cameras:"]
    for name in ("cam01", "cam02", "cam03", "cam04"):
        seen = (
            f"keypoints: {recording / keypoints / name}_json, frame_times: {{fps: 60}}"
            if keypoints
            else f"video: {recording / 'videos' / name}.mp4"
        )
        lines += [f"  {name}: {{intrinsics: {calibration}, pose: {{file: {calibration}}}, {seen}}}"]
    path = folder / f"{keypoints or 'videos'}.yaml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def associated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ingest the keypoints of the one person whom Pose2Sim chose."""
    manifest = manifest_of(tmp_path_factory.mktemp("associated"), "pose-associated")
    succeeds("ingest", manifest)
    return manifest.with_suffix(".session")


def reconstructed(session: Path, *options: str) -> tuple[pd.DataFrame, dict[str, Any]]:
    metrics: dict[str, Any] = json.loads(succeeds("reconstruct", session, "--json", *options))
    return pd.read_parquet(session / "reconstruct" / "skeleton.parquet"), metrics


def test_a_right_recording_is_not_doubted_and_its_mistakes_are(tmp_path: Path) -> None:
    def doubted(text: str) -> list[dict[str, Any]]:
        manifest.write_text(text, encoding="utf-8")
        found: list[dict[str, Any]] = json.loads(succeeds("check", manifest, "--json"))["doubts"]
        return found

    manifest = manifest_of(tmp_path, "pose-associated")
    right = manifest.read_text(encoding="utf-8")
    assert doubted(right) == []
    late = right.replace("{fps: 60}", "{fps: 60, start: 0.3}", 1)
    first = doubted(late)[0]
    assert (first["code"], first["cameras"]) == ("clock", ["cam01"])
    offset_s = float(first["remedy"].removeprefix("cameras.cam01.clock.offset_s: "))
    assert offset_s == pytest.approx(-0.3, abs=1 / 60)  # a picture
    exchanged = right.replace("/cam01_json", "/?").replace("/cam02_json", "/cam01_json")
    assert doubted(exchanged.replace("/?", "/cam02_json"))[0]["code"] == "videos_swapped"


def distance_to_peer_mm(skeleton: pd.DataFrame) -> Any:
    peer = TRC.read_joints(real_data("pose2sim_single/pose-3d/single_0-99.trc"), unit=None, axes=None)
    ours = motion_from(skeleton, peer.joints)
    return 1e3 * np.linalg.norm(ours.position - peer.position, axis=-1)


def test_dlt_is_the_peers_triangulation(associated: Path) -> None:
    # The equations are the same where the peer left no camera out, but it weighs them by confidence: 7.6 mm.
    skeleton, _ = reconstructed(associated, "--method", "dlt")
    assert np.nanmedian(distance_to_peer_mm(skeleton)) < 10.0


def test_default_disagrees_less_with_the_pictures_than_the_peer(associated: Path) -> None:
    skeleton, metrics = reconstructed(associated)
    assert metrics["reprojection_px"]["median"] < PEER_MEDIAN_PX
    assert metrics["reconstructed_share"] > 0.98
    assert np.nanmedian(distance_to_peer_mm(skeleton)) < 25.0


def test_letterboxed_videos_get_the_intrinsics_of_their_pictures(tmp_path: Path) -> None:
    """The picture that each camera was calibrated with, found again in its video, says what happened to it.

    `camNN_ext.png` of the wheel pose2sim 0.8.4 has the calibration's 1088 x 1920 px. An affine map fitted to
    519 and 1156 matches of its background in the videos of cam01 and cam02 multiplies x by 0.9928 and 0.9926,
    y by 0.9926 and 0.9925 (standard deviations up to 0.0001), and moves y by 7.1 and 7.2 px (0.1 px).
    """
    succeeds("ingest", manifest_of(tmp_path))
    cameras = json.loads((tmp_path / "videos.session" / "session.json").read_text("utf-8"))["cameras"]
    for name, fx, cy in (("cam01", 1681.2449, 948.1374), ("cam02", 1673.7296, 963.2259)):
        lens = cameras[name]["intrinsics"]
        assert lens["fx"] / fx == pytest.approx(0.9926, abs=2e-4)
        assert lens["cy"] == pytest.approx(0.9926 * cy + 7.15, abs=0.3)
    assert cameras["cam03"]["intrinsics"]["cy"] == pytest.approx(955.0051, abs=1e-3)


def test_raw_detections_with_bystanders_give_the_same_person(associated: Path, tmp_path: Path) -> None:
    chosen, _ = reconstructed(associated, "--method", "robust")
    succeeds("ingest", manifest_of(tmp_path, "pose"))
    raw, metrics = reconstructed(tmp_path / "pose.session", "--method", "robust")
    assert metrics["reconstructed_share"] > 0.98
    joints = tuple(dict.fromkeys(raw["joint"]))
    apart = np.linalg.norm(motion_from(raw, joints).position - motion_from(chosen, joints).position, axis=-1)
    # The folders differ in single frames (which half of a split person is taken), and with them the noise
    # level that is estimated over all frames: a change far below a millimetre.
    assert np.nanmedian(apart) < 1e-3
    assert np.nanmean(apart > 0.05) < 0.02
