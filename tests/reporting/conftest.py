"""A session in closed form: an actor on a circle, three cameras, known shares of every status."""

from dataclasses import asdict

import numpy as np
import pandas as pd
import pytest

from pipelines.geometry.arrays import Intrinsics
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.content import SessionContent
from pipelines.session.description import Description
from pipelines.session.tables import KEYPOINTS, SKELETON

START_NS = 1_700_000_000_000_000_000
FRAMES = 600
RATE_HZ = 30
CAMERAS = ("drone1", "drone2", "mast")
# Forward, left and up of every joint in metres, a person standing upright at the origin.
_SIDED = {
    "eye": (0.09, 0.03, 1.68),
    "ear": (0.0, 0.07, 1.67),
    "shoulder": (0.0, 0.19, 1.45),
    "elbow": (0.0, 0.23, 1.17),
    "wrist": (0.05, 0.24, 0.92),
    "hip": (0.0, 0.13, 0.93),
    "knee": (0.02, 0.12, 0.50),
    "ankle": (0.0, 0.12, 0.08),
}
STANDING = {"nose": (0.10, 0.0, 1.65)} | {
    f"{side}_{name}": (x, y if side == "left" else -y, z)
    for name, (x, y, z) in _SIDED.items()
    for side in ("left", "right")
}
JOINTS = tuple(STANDING)
INTRINSICS = asdict(Intrinsics(1920, 1080, 1400.0, 1400.0, 959.5, 539.5))
OFFSET_M = np.array([0.02, 0.0, 0.01])
"""Error of the skeleton at every joint and time: sqrt(500) mm = 22.36 mm."""
ASIDE_PX = np.array([3.0, -4.0])
"""Offset of the keypoints from the reprojected skeleton: 5 px."""


def _swing(joint: str, phase: np.ndarray) -> np.ndarray:
    """Return the forward swing in metres: limbs of the two sides in opposite phase, arms against legs."""
    reach = {"elbow": -0.12, "wrist": -0.26, "knee": 0.18, "ankle": 0.33}.get(joint.rpartition("_")[2], 0.0)
    return reach * np.sin(phase + (np.pi if joint.startswith("right") else 0.0))


def true_positions(t_s: np.ndarray) -> np.ndarray:
    """Return the positions [T, J, 3] of a walk at 1.2 m/s on a circle of 6 m around (2, 1)."""
    angle = 1.2 / 6.0 * t_s
    centre = np.stack([2 + 6 * np.cos(angle), 1 + 6 * np.sin(angle)], axis=-1)
    forward = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=-1)
    result = np.empty((len(t_s), len(JOINTS), 3))
    for j, (joint, (ahead, aside, up)) in enumerate(STANDING.items()):
        swing = ahead + _swing(joint, 2 * np.pi * 0.9 * t_s)
        result[:, j, :2] = centre + swing[:, None] * forward + aside * left
        result[:, j, 2] = up
    return result


def _long(t_ns: np.ndarray, position: np.ndarray) -> pd.DataFrame:
    frames, joints, _ = position.shape
    columns = {
        "t_ns": np.repeat(t_ns, joints),
        "person": 0,
        "joint": np.tile(JOINTS, frames),
        **dict(zip("xyz", position.reshape(-1, 3).T, strict=True)),
    }
    return pd.DataFrame(columns)


def statuses(frames: int) -> np.ndarray:
    """Return the statuses [T, J]: ok, but for losses that can be counted on paper."""
    status = np.full((frames, len(JOINTS)), "ok", dtype=object)
    status[: frames // 2, JOINTS.index("left_wrist")] = "rejected"
    status[frames // 10 * 3 : frames // 10 * 4, :] = "few_views"
    status[::5, JOINTS.index("right_ear")] = "not_detected"
    status[frames // 10 * 6 : frames // 10 * 7, JOINTS.index("right_ankle")] = "low_parallax"
    status[-frames // 20 :, :] = "no_pose"
    return status


def make_skeleton(frames: int = FRAMES, rate_hz: float = RATE_HZ) -> pd.DataFrame:
    t_s = np.arange(frames) / rate_hz
    table = _long(START_NS + np.round(t_s * 1e9).astype(np.int64), true_positions(t_s) + OFFSET_M)
    status = statuses(frames).reshape(-1)
    ok = status == "ok"
    # The stated covariance: 15 mm per axis, so that an error of 22.36 mm lies inside 95 %.
    for column in ("cxx", "cyy", "czz"):
        table[column] = 0.015**2
    for column in ("cxy", "cxz", "cyz"):
        table[column] = 0.0
    table["views"] = 3
    table["reprojection_px"] = 3 + 2 * np.abs(np.sin(np.arange(len(table)) * 0.7))
    table["status"] = status
    table.loc[~ok, ["x", "y", "z", "cxx", "cxy", "cxz", "cyy", "cyz", "czz", "reprojection_px"]] = np.nan
    table.loc[~ok, "views"] = 0
    result: pd.DataFrame = table[SKELETON.names]
    return result


def make_truth(frames: int = FRAMES, rate_hz: float = RATE_HZ) -> pd.DataFrame:
    t_s = np.arange(frames) / rate_hz
    return _long(START_NS + np.round(t_s * 1e9).astype(np.int64), true_positions(t_s))


def _looking_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    z = target - position
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    quaternion: np.ndarray = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=-1)).as_quat()
    return quaternion


def _camera_at(k: int, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position [T, 3] and quaternion [T, 4]: the drones look at the actor, the mast stands still."""
    hip = np.column_stack([2 + 6 * np.cos(0.2 * t_s), 1 + 6 * np.sin(0.2 * t_s), np.ones_like(t_s)])
    if CAMERAS[k] == "mast":
        position = np.tile([11.0, -7.0, 3.0], (len(t_s), 1))
        return position, _looking_at(position, np.tile([2.0, 1.0, 1.0], (len(t_s), 1)))
    bearing = 0.2 * t_s + 2.1 * k + 0.4 * np.sin(0.3 * t_s + k)
    position = hip + np.column_stack([9 * np.cos(bearing), 9 * np.sin(bearing), np.full_like(t_s, 4.0 + k)])
    return position, _looking_at(position, hip)


def make_poses(frames: int = FRAMES, rate_hz: float = RATE_HZ) -> dict[str, pd.DataFrame]:
    t_s = np.arange(0, frames / rate_hz, 0.02)
    poses = {}
    for k, name in enumerate(CAMERAS):
        position, quaternion = _camera_at(k, t_s)
        table = pd.DataFrame({"t_ns": START_NS + np.round(t_s * 1e9).astype(np.int64)})
        table[["x", "y", "z"]] = position
        table[["qx", "qy", "qz", "qw"]] = quaternion
        hole = (t_s > t_s[-1] * 0.6) & (t_s < t_s[-1] * 0.66) & (name == "drone2")
        poses[name] = table[:1] if name == "mast" else table[~hole].reset_index(drop=True)
    return poses


def make_frames(frames: int = FRAMES, rate_hz: float = RATE_HZ) -> dict[str, pd.DataFrame]:
    pts_ns = np.round(np.arange(frames) / rate_hz * 1e9).astype(np.int64)
    table = pd.DataFrame({"frame": np.arange(frames), "t_ns": START_NS + pts_ns, "pts_ns": pts_ns})
    return dict.fromkeys(CAMERAS, table)


def true_pixels(k: int, t_s: np.ndarray) -> np.ndarray:
    """Project the skeleton of `make_skeleton` to camera k, [T, J, 2] px: a pinhole without distortion."""
    from scipy.spatial.transform import Rotation

    position, quaternion = _camera_at(k, t_s)
    camera_from_world = Rotation.from_quat(quaternion).inv().as_matrix()
    offset = true_positions(t_s) + OFFSET_M - position[:, None]
    x, y, z = np.moveaxis(np.einsum("tij,tkj->tki", camera_from_world, offset), -1, 0)
    return np.stack([1400 * x / z + 959.5, 1400 * y / z + 539.5], axis=-1)


def make_keypoints(frames: int = FRAMES, rate_hz: float = RATE_HZ) -> dict[str, pd.DataFrame]:
    """Make every camera's keypoints: each joint `ASIDE_PX` beside the skeleton.

    drone2 sees a bystander as well.
    """
    t_s = np.arange(frames) / rate_hz
    tables = {}
    for k, name in enumerate(CAMERAS):
        table = _long(START_NS + np.round(t_s * 1e9).astype(np.int64), np.zeros((frames, len(JOINTS), 3)))
        table["frame"] = np.repeat(np.arange(frames), len(JOINTS))
        table[["x", "y"]] = (true_pixels(k, t_s) + ASIDE_PX).reshape(-1, 2)
        table["confidence"] = 0.9
        if name == "drone2":
            # The detector's own numbers, not the skeleton's: the bystander comes first.
            table = pd.concat([table.assign(person=0, x=table["x"] - 500), table.assign(person=1)])
        tables[name] = table[KEYPOINTS.names]
    return tables


def make_session(frames: int = FRAMES, rate_hz: float = RATE_HZ) -> dict[str, object]:
    last = START_NS + round((frames - 1) / rate_hz * 1e9)
    gap = [START_NS + round(frames / rate_hz * k * 1e9) for k in (0.6, 0.66)]
    cameras: dict[str, object] = {
        name: {
            "intrinsics": INTRINSICS,
            "frames": {"count": frames, "first_t_ns": START_NS, "last_t_ns": last, "rate_hz": float(rate_hz)},
            "poses": {
                "source": f"{name}.tum",
                "static": name == "mast",
                "count": 1 if name == "mast" else 1000,
                "rate_hz": None if name == "mast" else 50.0,
                "gaps_ns": [gap] if name == "drone2" else [],
                "frames_without_pose": 36 if name == "drone2" else 0,
                "dropped": {},
            },
            "keypoints": {
                "source": f"{name}.json",
                "format": "alphapose",
                "joints": list(JOINTS),
                "detections": frames,
                "people_at_once": 1,
                "frames_without_person": 30 if name == "mast" else 0,
                "dropped": {},
            },
            "clock": {"offset_s": 0.12 if name == "drone2" else 0.0, "sigma_s": 0.2},
            "pose_noise": None,
            "media": None,
        }
        for name in CAMERAS
    }
    return {
        "schema": 1,
        "flight": "Walk on a circle",
        "clock_reference": "drone1",
        "pose_interpolation": {"max_gap_s": 0.5, "max_extrapolation_s": 0.1},
        "cameras": cameras,
        "truth": None,
        "sources": {f"{name}.json": f"{k}" * 64 for k, name in enumerate(CAMERAS)},
        "warnings": ["drone2: calibrated for 3840 x 2160, rescaled to 1920 x 1080"],
    }


def make_metrics() -> dict[str, object]:
    mpjpe = float(np.linalg.norm(OFFSET_M) * 1000)
    return {
        "method": "robust",
        "mpjpe_mm": mpjpe,
        "root_mpjpe_mm": 0.0,
        "pa_mpjpe_mm": 0.0,
        "e_recon_m2": 4.321,
        "pck150": 0.84,
        "reprojection_px": {"median": 4.41, "mean": 4.27},
        "reconstructed_share": float(np.mean(statuses(FRAMES) == "ok")),
    }


def make_joint_errors() -> pd.DataFrame:
    mpjpe = float(np.linalg.norm(OFFSET_M) * 1000)
    rows = [(joint, *of) for joint in JOINTS for of in (("mpjpe_mm", mpjpe), ("root_mpjpe_mm", 0.0))]
    return pd.DataFrame(rows, columns=["joint", "figure", "value"]).assign(low=np.nan, high=np.nan)


STAGES: dict[str, dict[str, object]] = {
    "ingest": {"schema": 1, "key": "a1" * 32, "settings": {"pose_tolerance_s": 0.1}, "warnings": []},
    "reconstruct": {
        "schema": 1,
        "key": "b2" * 32,
        "settings": {"method": "robust", "gates": {"pixel_sigma_px": 3.0, "chi2": 9.21}},
        "counts": {"joint_frames": FRAMES * len(JOINTS)},
        "warnings": ["no pose noise is stated: the pixel noise alone weighs the views"],
    },
}


def described(session: dict[str, object]) -> Description:
    return Description.model_validate(session)


@pytest.fixture(scope="session")
def content() -> SessionContent:
    return SessionContent(
        name="Walk on a circle",
        session=described(make_session()),
        skeleton=make_skeleton(),
        metrics=make_metrics(),
        truth=make_truth(),
        poses=make_poses(),
        frames=make_frames(),
        keypoints=make_keypoints(),
        stages=STAGES,
        joint_errors=make_joint_errors(),
    )


assert set(statuses(FRAMES).reshape(-1)) <= set(STATUS)
