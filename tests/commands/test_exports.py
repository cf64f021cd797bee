"""`mocap export` as a command: every format at once, what may be replaced, C3D as truth."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from filelock import FileLock
from rosbags.highlevel import AnyReader

from pipelines.export import export
from pipelines.formats.skeletons import c3d, joint_files, trc
from pipelines.formats.skeletons.joint_files import at_even_times, write_sto
from pipelines.geometry.joint_angles import ANGLES
from pipelines.session.progress import Silent
from pipelines.session.records import JointMotion
from pipelines.session.storage import read_json
from tests.commands.runner import content, mocap, refused, result_of, succeeds
from tests.commands.test_overlay import filmed_flight, session_of
from tests.formats.skeletons.test_trc import opensim
from tests.synthetic.flights import START_NS, write_flight

RECORD = "export.json"


def read_trc(path: Path) -> JointMotion:
    return trc.FORMAT.read_joints(path, unit=None, axes=None)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a reconstructed session of 12 frames with videos beside it."""
    return session_of(filmed_flight(tmp_path_factory.mktemp("filmed")))


def test_all_formats_at_once_with_a_record_of_what_they_are(filmed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    names = "angles,bvh,c3d,csv,mcap,rerun,trc,tum"
    result = result_of("export", filmed, "--to", names, "-o", out, "--pictures-hz", "5")
    written = {Path(path).name for path in result["written"]}
    record = read_json(out / RECORD)["files"]
    assert set(record) | {RECORD} == written | {RECORD} == {path.name for path in out.iterdir()}
    stated = {(facts["format"], facts["unit"], facts["axes"]) for facts in record.values()}
    assert {
        ("bvh", "cm", "y-up"),
        ("c3d", "mm", "z-up"),
        ("trc", "m", "y-up"),
        ("mcap", "m", "z-up"),
        ("angles", "deg", "none"),
    } <= stated
    (log,) = out.glob("*.mcap")
    with AnyReader([log]) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
    # 0.4 s of video at 5 pictures per second.
    assert counts["/drone1/image/video"] == counts["/drone1/camera_info"] == 2


def test_files_written_in_parts_are_those_written_at_once(
    filmed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Write 12 frames in parts of 5, the last of them of 2."""
    at_once, parts = tmp_path / "at_once", tmp_path / "parts"
    export(filmed, ["trc", "csv", "tum"], at_once)
    for module, name in ((trc, "_FRAMES_AT_ONCE"), (joint_files, "_TIMES_AT_ONCE")):
        monkeypatch.setattr(module, name, 5)
    export(filmed, ["trc", "csv", "tum"], parts)
    assert content(parts) == content(at_once)


@pytest.mark.parametrize("name", ["csv", "mcap", "rerun"])
def test_a_session_without_a_skeleton_gives_the_cameras_and_says_so(tmp_path: Path, name: str) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.2, clean=True)
    succeeds("ingest", flight.manifest)
    result = mocap("export", tmp_path / "flight.session", "--to", name)
    assert (result.returncode, "mocap reconstruct" in result.stderr) == (0, True)
    files = read_json(tmp_path / "flight.export" / RECORD)["files"]
    assert all(len(facts["notes"]) == 1 for facts in files.values())
    assert refused("export", tmp_path / "flight.session", "--to", "trc").count("mocap reconstruct") == 1


def test_what_a_killed_export_left_goes_and_a_second_one_at_once_is_refused(
    filmed: Path, tmp_path: Path
) -> None:
    target = tmp_path / "out"
    (target / ".writing" / "csv").mkdir(parents=True)
    (target / ".writing" / "csv" / "half.csv").write_text("1,2")
    succeeds("export", filmed, "--to", "csv", "-o", target)
    assert not [path.name for path in target.iterdir() if path.name.startswith(".")]
    before = content(target)
    (target / ".writing").mkdir()
    with FileLock(target / ".writing" / "lock"):
        line = refused("export", filmed, "--to", "trc", "-o", target)
    assert str(target) in line
    assert "process" in line
    assert content(target).items() >= before.items()


def test_units_and_axes_only_where_there_is_a_choice(filmed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for formats, option, value, names in (
        ("csv,tum,trc", "--unit", "mm", ["csv", "--unit"]),
        ("trc", "--unit", "inch", ["trc", "inch", "m, cm, mm"]),
        ("bvh", "--axes", "x-up", ["bvh", "x-up", "y-up, z-up"]),
    ):
        line = refused("export", filmed, "--to", formats, option, value, "-o", out)
        assert all(name in line for name in names), line
    assert not out.exists()


def test_seconds_count_from_the_first_picture_or_the_epoch(filmed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = {}
    for choice, zero_ns in (((), START_NS), (("--time", "zero"), START_NS), (("--time", "epoch"), 0)):
        succeeds("export", filmed, "--to", "trc", *choice, "-o", out)
        (path,) = out.glob("*.trc")
        facts = read_json(out / RECORD)["files"][path.name]
        assert facts["zero_ns"] == zero_ns
        first[facts["time"]] = read_trc(path).t_ns + zero_ns
    np.testing.assert_array_equal(first["zero"], first["epoch"])
    assert first["epoch"][0] == START_NS
    assert "csv" in refused("export", filmed, "--to", "trc,csv", "--time", "zero", "-o", out)
    assert "zero, epoch" in refused("export", filmed, "--to", "trc", "--time", "noon", "-o", out)


def test_c3d_is_truth(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, seconds=0.5)
    since_start = JointMotion(flight.t_ns - START_NS, flight.joints, flight.position[:, None])
    even = at_even_times("x", since_start, Silent())
    c3d.write_joints(tmp_path / "truth.c3d", even, 0, unit="cm", axes="y-up")
    flight.settings["truth"] = {"file": "truth.c3d", "unit": "cm", "up": "y", "offset_s": START_NS // 10**9}
    flight.save()
    succeeds("ingest", flight.manifest)
    table = pd.read_parquet(tmp_path / "flight.session" / "truth.parquet")
    nose = table[table["joint"] == "nose"]
    assert np.abs(nose["t_ns"].to_numpy() - flight.t_ns).max() <= 1
    truth = flight.position[:, flight.joints.index("nose")]
    np.testing.assert_allclose(nose[["x", "y", "z"]], truth, rtol=2.0**-24)
    said = succeeds("info", tmp_path / "truth.c3d")
    assert "(C3D)" in said
    assert "POINT:UNITS" in said
    flight.settings["truth"]["up"] = "z"
    flight.save()
    succeeds("ingest", flight.manifest)
    assert "up: y" in mocap("reconstruct", tmp_path / "flight.session").stderr


def test_opensim_reads_the_angles_of_the_session(filmed: Path, tmp_path: Path) -> None:
    """The STO holds the table's degrees at seconds since the first picture."""
    library = opensim()
    written = export(filmed, ["angles"], tmp_path).written
    assert [path.suffix for path in written] == [".csv", ".sto"]
    table = pd.read_parquet(filmed / "reconstruct" / "angles.parquet")
    pd.testing.assert_frame_equal(pd.read_csv(written[0]), table, check_dtype=False)
    knee = table[table["angle"] == "left_knee_flexion"]
    read = library.TimeSeriesTable(str(written[1]))
    stamps = np.array(read.getIndependentColumn())
    of_table = (knee["t_ns"].to_numpy() - START_NS) / 1e9
    there = np.isin(of_table.round(9), stamps.round(9))  # the others lack an angle
    knee = knee[there]
    assert len(knee) == len(stamps) > 0.8 * len(of_table)
    for name, column in (("left_knee_flexion", "value_deg"), ("left_knee_flexion_sigma", "sigma_deg")):
        values = read.getDependentColumn(name).to_numpy()
        np.testing.assert_allclose(values, knee[column], rtol=0, atol=0.51e-6)  # six decimals
    assert (knee["sigma_deg"] > 0).all()


def test_opensims_storage_reads_every_row_of_angles_with_gaps(tmp_path: Path) -> None:
    """It stops at the first NaN: a hidden ankle must not cost the rest of the flight."""
    library = opensim()
    value = np.tile(np.arange(len(ANGLES), dtype=float), (40, 1))
    value[0, 0] = value[7, :] = np.nan  # one angle at one time, all at another
    value[:, 3] = np.nan  # one that is never known
    value[::2, 5] = np.nan  # and one that is known half of the time, but once
    value[2, 5] = np.nan
    left_out = write_sto(tmp_path / "a.sto", np.arange(40) * 10**7, value, np.full_like(value, 0.5))
    stored = library.Storage(str(tmp_path / "a.sto"))
    assert stored.getSize() == 38
    assert stored.getColumnLabels().getSize() == 1 + 2 * (len(ANGLES) - 2)
    assert left_out.split(", ") == ["2 times", "2 angles"]
