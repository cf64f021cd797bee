"""Export to Rerun, read back by Rerun's own reader."""

import subprocess
import sys
from dataclasses import replace
from typing import Any

import av
import numpy as np
import pytest

from pipelines.formats.scenes import rerun_writing
from pipelines.session.registries import Export
from tests.formats.exported import LENS, SIGMA_M, angles_of_two, flown, recording, stamps

rerun_chunk = pytest.importorskip("rerun.chunk", reason="the extra rerun is not installed")
WRITER: Export = rerun_writing.EXPORT
FLOAT32 = 2.0**-24


@pytest.fixture(scope="module")
def chunks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """Return record batches by entity."""
    made = replace(recording(), angles=angles_of_two, doubts=lambda: ["one", "two"])
    (path,) = WRITER.write(made, tmp_path_factory.mktemp("rerun"))
    assert path.name == "Mound_walk.rrd"
    verify = [sys.executable, "-m", "rerun_cli", "rrd", "verify", str(path)]
    done = subprocess.run(verify, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    found: dict[str, list[Any]] = {}
    for chunk in rerun_chunk.RrdReader(str(path)).stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def column(chunks: dict[str, list[Any]], entity: str, name: str) -> list[Any]:
    """Return a column of an entity, row by row."""
    batches = [batch for batch in chunks[entity] if name in batch.schema.names]
    return [row for batch in batches for row in batch.column(name).to_pylist()]


def test_sigmas_and_angles_are_series(chunks: dict[str, list[Any]]) -> None:
    name = "Scalars:scalars"
    knee = "/angles/person0/left_knee_flexion"
    assert column(chunks, knee, name) == [[180.0], [60.0]]
    assert column(chunks, f"{knee}/sigma", name) == [[18.0]]
    assert column(chunks, knee.replace("person0", "person1"), name) == [[90.0]]
    assert not any("hip_flexion" in entity for entity in chunks)
    wrist = column(chunks, "/sigma/person0/left_wrist", name)
    assert len(wrist) == 59  # it is missing in frame 7
    np.testing.assert_allclose(wrist, np.sqrt(np.mean(np.square(SIGMA_M))), rtol=1e-12)


def test_joints_and_ellipsoids_come_back(chunks: dict[str, list[Any]]) -> None:
    motion = recording().motion
    assert motion is not None
    entity = "/world/person0/skeleton"
    (batch,) = chunks[entity]
    times = np.asarray(batch.column("time").to_numpy(zero_copy_only=False)).astype(np.int64)
    assert times.tolist() == motion.t_ns.tolist()
    wrist = motion.joints.index("left_wrist")
    for row, (points, ids) in enumerate(
        zip(
            column(chunks, entity, "Points3D:positions"),
            column(chunks, entity, "Points3D:keypoint_ids"),
            strict=True,
        )
    ):
        assert ids == [k for k in range(19) if not (row == 7 and k == wrist)]
        measured = motion.position[row, 0, [k for k in ids if k < 17]]
        np.testing.assert_allclose(points[: len(measured)], measured, rtol=FLOAT32)
    half = np.array(column(chunks, "/world/person0/uncertainty", "Ellipsoids3D:half_sizes")[0])
    np.testing.assert_allclose(np.sort(half[0]), np.sqrt(7.815) * np.sort(SIGMA_M), rtol=1e-6)


def test_cameras_move_and_show_their_pictures(chunks: dict[str, list[Any]]) -> None:
    entity = "/world/cameras/cam\\-1" if "/world/cameras/cam\\-1" in chunks else "/world/cameras/cam-1"
    moved = np.array([row[0] for row in column(chunks, entity, "Transform3D:translation")])
    np.testing.assert_allclose(moved, flown().position, rtol=FLOAT32, atol=1e-7)
    images = f"{entity}/image"
    units = column(chunks, images, "VideoStream:sample")
    keys = column(chunks, images, "VideoStream:is_keyframe")
    assert [bool(key) for (key,) in keys] == [True, False, False, False]
    decoder = av.VideoCodecContext.create("h264", "r")
    packets = [av.Packet(np.asarray(unit, np.uint8).tobytes()) for (unit,) in units]
    shown = [frame for packet in [*packets, None] for frame in decoder.decode(packet)]
    assert [(frame.width, frame.height) for frame in shown] == [(960, 540)] * 4
    times = [
        int(stamp)
        for batch in chunks[images]
        if "VideoStream:sample" in batch.schema.names
        for stamp in np.asarray(batch.column("time").to_numpy(zero_copy_only=False)).astype(np.int64)
    ]
    assert times == stamps(60)[::15].tolist()
    ((matrix,),) = column(chunks, images, "Pinhole:image_from_camera")
    assert matrix[0] == pytest.approx(LENS.fx * 0.75)  # stored column by column
    ((resolution,),) = column(chunks, images, "Pinhole:resolution")
    assert resolution == [960, 540]
