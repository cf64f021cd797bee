"""Reader of Kalibr's camera chains: the intrinsics of cam0, cam1, ..."""

import re
from pathlib import Path

import numpy as np

from pipelines.formats.calibrations.camera_matrices import describe_cameras, intrinsics
from pipelines.formats.common.files import numbers, read_head, read_yaml
from pipelines.geometry.cameras import Intrinsics
from pipelines.session.errors import DataError
from pipelines.session.records import CalibratedCamera

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
        """Describe the cameras."""
        return describe_cameras(self.read_calibration(path))

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


FORMAT = KalibrFormat()
