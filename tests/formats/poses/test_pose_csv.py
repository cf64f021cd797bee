"""Poses as CSV: columns by name, EuRoC's header, covariances."""

from pathlib import Path

import numpy as np
import pytest

from pipelines.formats import poses as trajectory_files
from pipelines.formats.videos import frame_times
from pipelines.session.registries import TrajectoryFormat
from pipelines.session.tables import COVARIANCE_COLUMNS

READER: TrajectoryFormat = trajectory_files.POSE_CSV

EUROC = """#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []
1403636580838555648,4.688319,-1.786938,0.783338,0.534108,-0.153029,-0.827383,-0.082152
1403636580843555328,4.688177,-1.786770,0.787350,0.534640,-0.152990,-0.826976,-0.082863
"""


def write(folder: Path, text: str, name: str = "poses.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_euroc_ground_truth(tmp_path: Path) -> None:
    path = write(tmp_path, EUROC)
    assert READER.recognises(path)
    assert not trajectory_files.TUM.recognises(path), (
        "its order is w first: as TUM it would be another rotation"
    )
    poses = READER.read_trajectory(path)
    assert poses.t_ns.tolist() == [1403636580838555648, 1403636580843555328]
    # With six decimals per number the norm is within 4 * 0.5e-6 of one.
    np.testing.assert_allclose(
        poses.quaternion_xyzw[0], [-0.153029, -0.827383, -0.082152, 0.534108], rtol=0, atol=2e-6
    )


@pytest.mark.parametrize(
    "header",
    [
        "t,tx,ty,tz,qx,qy,qz,qw",
        "stamp;p_x;p_y;p_z;q_x;q_y;q_z;q_w",
        "time_s\tposition.x\tposition.y\tposition.z\torientation.x\torientation.y\torientation.z\torientation.w",
        "# t,x,y,z,qx,qy,qz,qw",
    ],
)
def test_spellings(tmp_path: Path, header: str) -> None:
    delimiter = next(mark for mark in ",;\t" if mark in header)
    path = write(tmp_path, f"{header}\n" + "1.5 1 2 3 0 0 0 1".replace(" ", delimiter) + "\n")
    assert READER.recognises(path)
    poses = READER.read_trajectory(path)
    assert poses.t_ns.tolist() == [1_500_000_000]
    assert poses.position.tolist() == [[1, 2, 3]]
    assert poses.quaternion_xyzw.tolist() == [[0, 0, 0, 1]]


FIELDS = "field.{0}position.x,field.{0}position.y,field.{0}position.z,field.{0}orientation.x,"
FIELDS += "field.{0}orientation.y,field.{0}orientation.z,field.{0}orientation.w"


@pytest.mark.parametrize(
    ("heading", "row", "t_ns"),
    [
        (
            "%time,field.header.seq,field.header.stamp,field.header.frame_id," + FIELDS.format("pose."),
            "1700000000500000000,7,1700000000123456789,map",
            1700000000123456789,
        ),
        (
            "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.child_frame_id,"
            + FIELDS.format("pose.pose."),
            "5500000000,7,5123456789,odom,base",  # simulation time
            5123456789,
        ),
        ("%time," + FIELDS.format(""), "5500000000", 5500000000),
    ],
)
def test_tables_of_ros_tools(tmp_path: Path, heading: str, row: str, t_ns: int) -> None:
    path = write(tmp_path, f"{heading}\n{row},1,2,3,0,0,0,1\n")
    assert READER.recognises(path)
    assert not frame_times.FORMAT.recognises(path)
    poses = READER.read_trajectory(path)
    assert poses.t_ns.tolist() == [t_ns]
    assert poses.position.tolist() == [[1, 2, 3]]
    assert poses.quaternion_xyzw.tolist() == [[0, 0, 0, 1]]


def test_covariance_is_symmetric_and_blank_means_unknown(tmp_path: Path) -> None:
    upper = np.arange(1.0, 22.0)
    header = "t_ns,x,y,z,qx,qy,qz,qw," + ",".join(COVARIANCE_COLUMNS)
    pose = "0,0,0,0,0,0,1,"
    text = "\n".join(
        [
            header,
            f"1,{pose}" + ",".join(map(str, upper)),
            f"2,{pose}" + "," * 20,
            f"3,{pose}nan" + ",1" * 20,
            "",
        ]
    )
    poses = READER.read_trajectory(write(tmp_path, text))
    assert poses.t_ns.tolist() == [1, 2]
    assert list(poses.dropped.values()) == [1]
    assert poses.covariance is not None
    np.testing.assert_array_equal(poses.covariance[0][np.triu_indices(6)], upper)
    np.testing.assert_array_equal(poses.covariance[0], poses.covariance[0].T)
    np.testing.assert_array_equal(poses.covariance[1], np.zeros((6, 6)))
