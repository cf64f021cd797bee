"""Export to OpenSim: its inverse kinematics of a pendulum, scaled segments, and Pose2Sim's model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipelines.formats.skeletons import opensim_kinematics
from pipelines.formats.skeletons.opensim_kinematics import MODELS, Kinematics, scale_model, solve
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion
from pipelines.session.registries import Export, FetchesModels
from tests.formats.exported import recording
from tests.formats.skeletons.test_trc import opensim

WRITER: Export = opensim_kinematics.EXPORT
JOINTS = ("right_hip", "right_knee", "right_ankle", "right_heel")
PLACES = {
    "RHip": (0.0, 0.0, 0.0),
    "RKnee": (0.0, -0.4, 0.0),
    "RAnkle": (0.1, -0.8, 0.0),
    "RHeel": (0.0, -0.8, 0.1),
}
T_NS = 1_700_000_000_000_000_000 + np.arange(5) * 33_333_333


def pendulum(library: Any) -> Any:
    """Make a body that turns about OpenSim's z axis below the origin, with four markers."""
    model = library.Model()
    body = library.Body("shank", 1.0, library.Vec3(0), library.Inertia(1, 1, 1))
    joint = library.PinJoint("pin", model.getGround(), body)
    joint.updCoordinate().setName("swing")
    model.addBody(body)
    model.addJoint(joint)
    for name, place in PLACES.items():
        model.addMarker(library.Marker(name, body, library.Vec3(*place)))
    model.finalizeConnections()
    return model


def swung(angles_deg: Float, scale: float = 1.0) -> JointMotion:
    """Place the markers of the pendulum in the world, whose (y, z, x) are OpenSim's axes."""
    c, s = np.cos(np.radians(angles_deg)), np.sin(np.radians(angles_deg))
    x, y, z = scale * np.array(list(PLACES.values())).T
    turned = np.stack(
        [c[:, None] * x - s[:, None] * y, s[:, None] * x + c[:, None] * y, 0 * c[:, None] + z], -1
    )
    return JointMotion(T_NS, JOINTS, turned[:, None][..., [2, 0, 1]])


def solved(motion: JointMotion, weights: dict[str, float] | None = None) -> Kinematics:
    library = opensim()
    return solve(library, pendulum(library), weights or dict.fromkeys(PLACES, 1.0), motion, 0)


def test_the_angles_of_a_pendulum_come_back() -> None:
    angles = np.array([-20.0, 0.0, 15.0, 40.0, 70.0])
    found = solved(swung(angles))
    assert found.coordinates == ("swing",)
    np.testing.assert_array_equal(found.t_ns, T_NS)
    # The solver stops at 1e-5 of its goal; markers lie up to 0.8 m from the axis.
    np.testing.assert_allclose(found.value[:, 0], angles, atol=np.degrees(1e-4))
    assert found.error_m.max() < 1e-4


def test_times_with_too_few_markers_are_left_out() -> None:
    motion = swung(np.linspace(0, 40, 5))
    motion.position[2, 0, 1] = np.nan
    found = solved(motion)
    np.testing.assert_array_equal(found.t_ns, np.delete(T_NS, 2))
    np.testing.assert_allclose(found.value[:, 0], [0, 10, 30, 40], atol=np.degrees(1e-4))
    motion.position[:] = np.nan
    assert not len(solved(motion).t_ns)


def test_a_body_is_scaled_by_the_median_of_its_bone() -> None:
    library = opensim()
    model = pendulum(library)
    tool = library.ScaleTool()
    measurement = library.Measurement()
    measurement.setName("shank")
    measurement.setApply(True)
    pair = library.MarkerPair("RHip", "RAnkle")
    measurement.getMarkerPairSet().cloneAndAppend(pair)
    scale = library.BodyScale()
    scale.setName("shank")
    measurement.getBodyScaleSet().cloneAndAppend(scale)
    tool.getModelScaler().getMeasurementSet().cloneAndAppend(measurement)
    motion = swung(np.linspace(0, 40, 5), scale=1.25)
    motion.position[0, 0, 2] *= 3  # an outlier, which a median does not follow
    assert scale_model(library, model, tool, motion, 0) == []
    place = model.getMarkerSet().get("RAnkle").get_location().to_numpy()
    np.testing.assert_allclose(place, 1.25 * np.array(PLACES["RAnkle"]), rtol=1e-9)


def test_a_person_gets_a_model_and_its_motion(tmp_path: Path) -> None:
    opensim()
    assert isinstance(WRITER, FetchesModels)
    try:
        MODELS.fetch()
    except DataError as error:
        pytest.skip(f"no network: {error}")
    walked = recording(8)
    paths = WRITER.write(walked, tmp_path)
    assert [path.suffix for path in paths] == [".osim", ".mot", ".sto"]
    motion = pd.read_csv(paths[1], sep="\t", skiprows=6)
    assert len(motion) == 8
    assert {"time", "knee_angle_l", "hip_flexion_r", "elbow_flex_l"} <= set(motion)
    assert np.isfinite(motion.to_numpy()).all()
    errors = pd.read_csv(paths[2], sep="\t", skiprows=6)
    assert (errors["marker_error_max"] >= errors["marker_error_RMS"]).all()
