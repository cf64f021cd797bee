"""Seeds to damage: a small valid file, or folder, of every format and of its variants."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipelines.formats import poses as trajectory_files
from pipelines.formats.scenes import mcap_writing
from pipelines.formats.skeletons import joint_files, trc
from pipelines.session.registries import Export
from tests.formats.calibrations import (
    test_anipose_toml,
    test_camodocal,
    test_colmap,
    test_kalibr,
    test_opencv_yaml,
    test_orbslam,
    test_ros_camera_info,
)
from tests.formats.drone_logs import test_dji_records, test_place_tracks
from tests.formats.exported import flown, recording, walking
from tests.formats.keypoint_files import test_coco_results, test_mmpose, test_other_programs
from tests.formats.log_entries import entries
from tests.formats.maps import test_grid_npz, test_las, test_octomap, test_pcd, test_ply, test_ros_map
from tests.formats.poses import test_pose_csv
from tests.formats.skeletons import test_bvh, test_c3d, test_trc
from tests.formats.videos import test_picture_folder
from tests.synthetic import drone_logs, logs, map_logs, video_tracks, videos
from tests.synthetic.flights import write_flight
from tests.synthetic.logged_flights import write_logged_flight

Writer = Callable[[Path], object]
"""Writer into an empty folder. A single entry is then read itself; of several entries, the folder is read."""


HEADS = frozenset({"map.yaml", "flight.yaml", "00.txt", "intri.yml"})
"""Files that name others beside them, or need them."""

TREE = test_octomap.at([7] * 13, [3.5, None, -2.0, [3.5, None] * 4, *[None] * 4])
"""A block of 8 x 8 x 8 of the finest voxels: a whole octant of the world would be refused."""
MMPOSE = test_mmpose.video(
    [test_mmpose.instance(1.0), test_mmpose.instance(2.0)], [], [test_mmpose.instance()]
)


def _text(name: str, text: str | bytes) -> Writer:
    return lambda folder: (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())


def _json(name: str, content: object) -> Writer:
    return _text(name, json.dumps(content))


def _export(writer: Export, frames: int = 12) -> Writer:
    return lambda folder: writer.write(recording(frames), folder)


def _openpose(folder: Path) -> None:
    write_flight(folder / "f", cameras=1, seconds=0.1, keypoint_format="openpose")
    shutil.move(folder / "f" / "drone1", folder / "drone1")
    shutil.rmtree(folder / "f")


def _keypoints(kind: str) -> Writer:
    def write(folder: Path) -> None:
        write_flight(folder / "f", cameras=1, seconds=0.2, keypoint_format=kind)
        shutil.move(folder / "f" / "drone1.json", folder / "drone1.json")
        shutil.rmtree(folder / "f")

    return write


def _truth(folder: Path) -> drone_logs.DroneTruth:
    truth = drone_logs.drone_of(write_flight(folder / "f", cameras=1, seconds=0.3, clean=True), 0)
    shutil.rmtree(folder / "f")
    return truth


def _ulog(folder: Path) -> None:
    drone_logs.write_ulog(folder / "a.ulg", drone_logs.ulog_rows(_truth(folder)))


def _tlog(folder: Path) -> None:
    truth = _truth(folder)
    path = drone_logs.write_tlog(folder / "a.tlog", truth)
    path.write_bytes(path.read_bytes() + drone_logs.tlog_pictures(truth))


def _colmap(kind: str) -> Writer:
    def write(folder: Path) -> None:
        every = dict(enumerate(test_colmap.PARAMETERS.items(), start=1))
        made = test_colmap.model(every, {f"{name}_a.jpg": k for k, (name, _) in every.items()})
        getattr(made, f"write_{kind}")(str(folder))

    return write


def _logged_flight(folder: Path) -> None:
    write_logged_flight(folder, "mcap-cdr", seconds=0.2)
    (folder / "truth.csv").unlink()
    flight = folder / "flight.yaml"
    text = flight.read_text(encoding="utf-8")
    flight.write_text(text[: text.index("truth:")], encoding="utf-8")


def _map_log(folder: Path) -> None:
    grid = np.full((4, 4), 100, np.int8)
    cloud = map_logs.cloud_fields(np.eye(3))
    maps = [
        map_logs.octomap_entry(test_octomap.file_of(TREE), 10**9),
        map_logs.grid_entry(grid, 2 * 10**9),
        map_logs.cloud_entry(cloud, 3 * 10**9),
        map_logs.transform_entry("map", "odom", map_logs.AT_REST, 4 * 10**9),
    ]
    logs.write_mcap(folder / "maps.mcap", maps, "cdr", compression="none")


SEEDS: dict[str, Writer] = {
    "airsim": _text(
        "airsim_rec.txt",
        "VehicleName\tTimeStamp\tPOS_X\tPOS_Y\tPOS_Z\tQ_W\tQ_X\tQ_Y\tQ_Z\tImageFile\n"
        + "".join(f"Drone1\t17000000000{k}0\t1\t2\t-34\t1\t0\t0\t0\ta.png\n" for k in range(9)),
    ),
    "airsim_settings": _text("settings.json", test_anipose_toml.AIRSIM),
    "alphapose": _keypoints("alphapose"),
    "anipose": _text("calib.toml", test_anipose_toml.CAMERA),
    "ardupilot": lambda folder: drone_logs.write_dataflash(folder / "a.bin", _truth(folder)),
    "bvh": _text("a.bvh", test_bvh.TEXT),
    "c3d": lambda folder: test_c3d.write(folder / "a.c3d", walking(12)),
    "caliscope_keypoints": _text("xy_halpe26.csv", test_other_programs.caliscope()),
    "camera_info": lambda folder: test_ros_camera_info.stored(folder / "left.yaml"),
    "camera_info as ini": _text("left.ini", test_ros_camera_info.INI),
    "camodocal": _text("cam.yaml", test_camodocal.HEAD.format("MEI") + test_camodocal.mei()),
    "coco": _keypoints("coco"),
    "coco data set": _json("set.json", test_coco_results.dataset()),
    "colmap": _colmap("binary"),
    "colmap as text": _colmap("text"),
    "csv": _text("poses.csv", test_pose_csv.EUROC * 2),
    "deeplabcut": lambda folder: test_other_programs.deeplabcut(folder / "a.csv", individuals=True),
    "dji": lambda folder: drone_logs.write_srt(folder / "a.SRT", _truth(folder)),
    "dji_record": lambda folder: test_dji_records.airdata(folder / "a.csv"),
    "easymocap": test_opencv_yaml.write_easymocap,
    "easymocap_keypoints": test_other_programs.easymocap,
    "flight": lambda folder: write_flight(folder, seconds=0.2),
    "flight from logs": _logged_flight,
    "frame_times": _text("f.csv", "frame,t_ns\n" + "".join(f"{k},17000000001{k}3456789\n" for k in range(9))),
    "gopro": lambda folder: video_tracks.write_gopro(folder / "a.mp4", _truth(folder)),
    "gopro without telemetry": lambda folder: videos.write_video(folder / "a.mp4", videos.even_ticks(15)),
    "gpx": _text("a.gpx", test_place_tracks.GPX_TEXT),
    "joints_csv": lambda folder: joint_files.write_joints(folder / "joints.csv", walking(4)),
    "kalibr": lambda folder: test_kalibr.chain(folder / "chain.yaml"),
    "las": lambda folder: test_las.write(folder / "a.las"),
    "las, compressed": lambda folder: test_las.write(folder / "a.laz"),
    "map log": _map_log,
    "mcap": lambda folder: logs.write_mcap(folder / "a.mcap", entries(0.2), "cdr", compression="none"),
    "mcap in chunks": lambda folder: logs.write_log(folder, "a", "mcap-ros1", entries(0.2)),
    "mcap of ours": _export(mcap_writing.EXPORT, 8),
    "mmpose": _json("walk.json", MMPOSE),
    "npz": lambda folder: test_grid_npz.write(folder / "site.npz"),
    "octomap": _text("a.bt", test_octomap.file_of(TREE)),
    "octomap with odds": _text("a.ot", test_octomap.file_of(TREE, "ot")),
    "opencv": lambda folder: test_opencv_yaml.store(folder / "calib.yml"),
    "opencv as xml": lambda folder: test_opencv_yaml.store(folder / "calib.xml"),
    "openpose": _openpose,
    "orbslam": lambda folder: test_orbslam.write(folder, test_orbslam.FISHEYE),
    "pcd": lambda folder: test_pcd.write(folder / "a.pcd", "ascii"),
    "pcd, binary": lambda folder: test_pcd.write(folder / "a.pcd", "binary"),
    "pcd, compressed": lambda folder: test_pcd.write(folder / "a.pcd", "binary_compressed"),
    "picture_tags": lambda folder: test_picture_folder.write(folder / "film"),
    "pictures": lambda folder: test_picture_folder.write(folder / "film", xmp=""),
    "ply": lambda folder: test_ply.write(folder / "a.ply", "ascii"),
    "ply, binary": lambda folder: test_ply.write(folder / "a.ply", "binary_little_endian"),
    "ros1": lambda folder: logs.write_ros1(folder / "a.bag", entries(0.2)),
    "ros1, compressed": lambda folder: logs.write_ros1(folder / "a.bag", entries(0.2), compression="lz4"),
    "ros2": lambda folder: logs.write_ros2(folder / "bag", entries(0.2)),
    "ros2 in mcap": lambda folder: logs.write_ros2(folder / "bag", entries(0.2), storage="mcap"),
    "ros2, compressed": lambda folder: logs.write_ros2(folder / "bag", entries(0.2), compression="file"),
    "ros_map": test_ros_map.write,
    "places": _text("a.csv", "time;lat;lon;ele\n" + "".join(f"{k};47.5;8.5{k};4\n" for k in range(1, 9))),
    "sleap": _text("a.csv", test_other_programs.sleap()),
    "tlog": _tlog,
    "trc": _export(trc.EXPORT),
    "trc of others": _text(
        "a.trc", test_trc.HEADER + "\n1\t0.0\t1000\t2000\t3000\t\t\t\n2\t0.0166\t1\t2\t3\t4\t5\t6\n"
    ),
    "tum": lambda folder: trajectory_files.write_tum(folder / "a.tum", flown(12)),
    "ulog": _ulog,
    "ultralytics": _json("results.json", test_other_programs.PICTURES),
    "video": lambda folder: videos.write_video(folder / "a.mp4", videos.even_ticks(15)),
    "video, mkv": lambda folder: videos.write_video(folder / "a.mkv", videos.even_ticks(15)),
}


def sown(folder: Path, names: list[str] | None = None) -> dict[str, Path]:
    """Write the seeds, each into its own folder; return the path to read for each."""
    paths = {}
    for number, name in enumerate(names or SEEDS):
        place = folder / f"{number}"
        place.mkdir(parents=True)
        SEEDS[name](place)
        inside = sorted(place.iterdir())
        # A single file is read as it is; of several, the one that names the others or needs them.
        heads = [entry for entry in inside if entry.name in HEADS]
        paths[name] = heads[0] if heads else inside[0] if len(inside) == 1 else place
    return paths
