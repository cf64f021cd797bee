"""Calibrations as TOML: anipose, Pose2Sim and caliscope write the same tables, one for each camera.

`matrix`, `distortions` (OpenCV's order) and `size` (floats in Pose2Sim's files) are the intrinsics.
`rotation` (Rodrigues, or 3 x 3 in today's caliscope) and `translation` map world to camera. Lengths are in
the file's unit: metres for Pose2Sim and caliscope, the unit of the board for anipose.

Reader of Kalibr's camera chains: the intrinsics of cam0, cam1, ...
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np

from pipelines.formats.calibrations.camera_matrices import (
    describe_cameras,
    intrinsics,
    invert_matrix,
    invert_rodrigues,
)
from pipelines.formats.common.files import numbers, read_head, read_text, read_yaml
from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import Intrinsics
from pipelines.session.errors import DataError
from pipelines.session.records import CalibratedCamera

# The parser needs the square of a key's parts; keys of calibrations have two.
_MOST_DOTS = 100


class AniposeToml:
    """Reader of anipose's tables; a camera has the name in `name`, or else the name of its table.

    Tables may lie in `cameras`, as in today's caliscope: `[cameras.0]` is the camera cam_0, as in older ones.

    Tables without a matrix (`[metadata]`, uncalibrated cameras) and those with `ignore = true` are
    left out. A camera without rotation and translation has intrinsics alone.
    """

    name = "anipose"
    title = "anipose, Pose2Sim or caliscope calibration"
    suffixes: tuple[str, ...] = (".toml",)

    def recognises(self, path: Path) -> bool:
        """Return True if a TOML file has the keys `matrix`, and `distortions` or `size`."""
        head = read_head(path, self.suffixes)
        return all(re.search(rf"(?m)^\s*(?:{key})\s*=", head) for key in ("matrix", "distortions|size"))

    def describe(self, path: Path) -> dict[str, object]:
        """Describe every camera, and name the tables that look like cameras but are left out."""
        summary = describe_cameras(self.read_calibration(path))
        left_out = [
            key for key, table in _tables(path).items() if "size" in table and not _is_calibrated(table)
        ]
        return {**summary, "not calibrated": left_out} if left_out else summary

    def read_calibration(self, path: Path) -> dict[str, CalibratedCamera]:
        """Read every calibrated camera."""
        cameras: dict[str, CalibratedCamera] = {}
        for key, table in _tables(path).items():
            if not _is_calibrated(table):
                continue
            name = str(table.get("name", key))
            if name in cameras:
                raise DataError(path, f"two cameras are called {name}", "rename one")
            cameras[name] = _camera(path, name, table)
        if not cameras:
            ignored = sum("matrix" in table for table in _tables(path).values())
            if ignored:
                problem = f"says `ignore = true` of all {ignored} cameras that have a matrix"
                raise DataError(path, problem, "take `ignore` away from those that count")
            raise DataError(path, "holds no table with a matrix", "calibrate first")
        return cameras


def _tables(path: Path) -> dict[str, dict[str, object]]:
    text = read_text(path)
    if any(piece.count(".") > _MOST_DOTS for piece in re.split(r"[=,{\n]", text)):
        # The parser needs the square of a key's parts.
        raise DataError(path, f"has a key of more than {_MOST_DOTS} parts", "write it again")
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"is not TOML ({error})", "it may be truncated; write it again") from error
    tables = {key: value for key, value in content.items() if isinstance(value, dict)}
    nested = tables.get("cameras", {})
    if "matrix" in nested:  # one camera of that name
        return tables
    named = {f"cam_{key}" if key.isdecimal() else key: value for key, value in nested.items()}
    return tables | {key: value for key, value in named.items() if isinstance(value, dict)}


def _is_calibrated(table: dict[str, object]) -> bool:
    return "matrix" in table and not table.get("ignore", False)


def _camera(path: Path, name: str, table: dict[str, object]) -> CalibratedCamera:
    lens = intrinsics(
        path,
        name,
        size=_numbers(path, name, table, "size").ravel().tolist(),
        matrix=_numbers(path, name, table, "matrix"),
        distortion=_numbers(path, name, table, "distortions").ravel().tolist(),
        fisheye=bool(table.get("fisheye", False)),
    )
    given = [key for key in ("rotation", "translation") if key in table]
    if not given:
        return CalibratedCamera(lens)
    rotation, translation = (_numbers(path, name, table, key) for key in ("rotation", "translation"))
    if rotation.shape == (3, 3):
        return CalibratedCamera(lens, *invert_matrix(path, name, rotation, translation.ravel()))
    return CalibratedCamera(lens, *invert_rodrigues(path, name, rotation.ravel(), translation.ravel()))


def _numbers(path: Path, camera: str, table: dict[str, object], key: str) -> Float:
    """Return a value of the table as an array of finite numbers."""
    try:
        values = np.array(table.get(key), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.array(np.nan)
    if not np.isfinite(values).all():
        problem = f"camera {camera}: {key} is missing or not made of numbers"
        raise DataError(path, problem, f"state {key} as a list of numbers")
    return values


ANIPOSE = AniposeToml()


# Kalibr's name of a distortion and its number of coefficients: radtan is k1 k2 p1 p2 as OpenCV orders
# them, equidistant is cv2.fisheye's k1..k4.
_DISTORTIONS = {"radtan": 4, "equidistant": 4, "none": 0}


class KalibrFormat:
    """Reader of camchain.yaml: camera_model, intrinsics, distortion_model and _coeffs, resolution by camera.

    Cameras keep the chain's names (cam0 and so on) and have no pose. T_cam_imu and T_cn_cnm1 relate them to
    the body and to each other, not to the world.
    """

    name = "kalibr"
    title = "Kalibr camera chain"
    suffixes: tuple[str, ...] = (".yaml", ".yml")

    def recognises(self, path: Path) -> bool:
        """Return True if the file has a cam0, cam1, ... at the top and a camera_model."""
        head = read_head(path, self.suffixes)
        return bool(re.search(r"(?m)^cam\d+\s*:", head) and re.search(r"(?m)^\s+camera_model\s*:", head))

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the cameras, and the offsets of their clocks, which belong into flight.yaml."""
        summary = describe_cameras(self.read_calibration(path))
        for name, block in read_yaml(path).items():
            if isinstance(block, dict) and "timeshift_cam_imu" in block:
                summary[f"{name}: timeshift_cam_imu (not applied)"] = block["timeshift_cam_imu"]
        return summary

    def read_calibration(self, path: Path) -> dict[str, CalibratedCamera]:
        """Read every camera of the chain."""
        chain = {name: block for name, block in read_yaml(path).items() if re.fullmatch(r"cam\d+", name)}
        if not chain:
            raise DataError(path, "holds no camera cam0, cam1, ...", "give Kalibr's camchain.yaml")
        return {name: CalibratedCamera(_lens(path, name, block)) for name, block in chain.items()}


def _lens(path: Path, name: str, block: object) -> Intrinsics:
    keys = block if isinstance(block, dict) else {}
    missing = [
        key for key in ("camera_model", "distortion_model", "intrinsics", "resolution") if key not in keys
    ]
    if missing:
        raise DataError(
            path,
            f"camera {name} lacks {', '.join(missing)}",
            "write the calibration again",
            code="missing-column",
        )
    projection, distortion = (str(keys[key])[:40] for key in ("camera_model", "distortion_model"))
    if projection != "pinhole":
        raise DataError(
            path, f"camera {name} has the projection {projection!r}", "calibrate it with Kalibr as pinhole"
        )
    if distortion not in _DISTORTIONS:
        raise DataError(
            path, f"camera {name} has the distortion {distortion!r}", "calibrate it as radtan or equidistant"
        )
    focal = numbers(path, f"{name}.intrinsics", keys["intrinsics"])
    coefficients = numbers(path, f"{name}.distortion_coeffs", keys.get("distortion_coeffs") or [])
    counts = (len(focal), len(coefficients))
    if counts != (4, _DISTORTIONS[distortion]):
        raise DataError(
            path,
            f"camera {name} has {counts[0]} intrinsics and {counts[1]} distortion coefficients"
            f" instead of 4 and {_DISTORTIONS[distortion]} (pinhole, {distortion})",
            "write the calibration again",
            code="damaged",
        )
    fu, fv, pu, pv = focal
    return intrinsics(
        path,
        name,
        size=numbers(path, f"{name}.resolution", keys["resolution"]).tolist(),
        matrix=np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]]),
        distortion=coefficients.tolist(),
        fisheye=distortion == "equidistant",
    )


KALIBR = KalibrFormat()
