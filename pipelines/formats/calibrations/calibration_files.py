"""Calibrations of ROS, OpenCV, ORB-SLAM, camodocal, EasyMocap, Kalibr, and of anipose and its relatives."""

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path

import numpy as np

from pipelines.formats.calibrations.camera_matrices import (
    describe_cameras,
    intrinsics,
    invert_pose,
    unstated_size,
)
from pipelines.formats.common.files import TextFormat, numbers, read_yaml
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import CalibratedCamera
from pipelines.session.storage import AGAIN, bad_value, damaged, empty, read_json, read_text

Cameras = dict[str, CalibratedCamera]

_YAML = (".yaml", ".yml")
_WRITE_AGAIN = "write the calibration again"
# ROS's and OpenCV's names of a fisheye.
_FISHEYE = {"equidistant", "fisheye"}


@dataclass(frozen=True)
class CalibrationFile(TextFormat):
    """Reader of the cameras of a file: `is_known` recognises its beginning, `read` returns them by name."""

    read: Callable[[Path], Cameras]

    def describe(self, path: Path) -> dict[str, object]:
        """Describe every camera."""
        return describe_cameras(self.read(path))

    def read_calibration(self, path: Path) -> Cameras:
        """Read every camera."""
        return self.read(path)


def _has_keys(head: str, keys: Sequence[str]) -> bool:
    return all(re.search(rf"(?m)^\s*(?:{key})\s*[:=]", head) for key in keys)


def _refuse_missing(path: Path, wanted: Sequence[str], there: Mapping[str, object], whose: str = "") -> None:
    if missing := [key for key in wanted if key not in there]:
        raise DataError(path, f"{whose}lacks {', '.join(missing)}", _WRITE_AGAIN, code="missing-column")


def _matrix_of(fx: float, fy: float, cx: float, cy: float) -> Float:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _camera_of(
    path: Path,
    name: str,
    size: Sequence[float],
    matrix: Float,
    distortion: Sequence[float],
    *,
    fisheye: bool = False,
) -> CalibratedCamera:
    """Build a camera; a size of zeros is not stated, and the pictures decide."""
    stated = any(size)
    lens = intrinsics(
        path,
        name,
        size=size if stated else unstated_size(matrix),
        matrix=matrix,
        distortion=distortion,
        fisheye=fisheye,
    )
    return CalibratedCamera(lens, size_stated=stated)


def _placed(
    path: Path, name: str, camera: CalibratedCamera, rotation: Float, translation: Float
) -> CalibratedCamera:
    """Add a pose camera_from_world: a rotation vector, or a matrix, and a translation."""
    rotation = rotation.ravel() if rotation.size == 3 else rotation
    position, quaternion_xyzw = invert_pose(path, name, rotation, translation.ravel())
    return replace(camera, position=position, quaternion_xyzw=quaternion_xyzw)


# --- ROS: camera_info as YAML or INI (camera_calibration_parsers), for the raw picture -----------------

# Drivers write an empty model if they were never calibrated, or if the lens has no distortion.
_RADTAN = {"plumb_bob", "rational_polynomial", "none", ""}
_INI_KEYS = ("width", "height", "camera matrix", "distortion")
_ROS_KEYS = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")


def _is_camera_info(head: str) -> bool:
    if re.search(r"(?m)^\[image\]", head) and re.search(r"(?m)^camera matrix\s*$", head):
        return True
    return "!!opencv-matrix" not in head and _has_keys(head, _ROS_KEYS[:3])


def _read_camera_info(path: Path) -> Cameras:
    """Read the one camera; rectification and projection are ignored."""
    if path.suffix.lower() not in _YAML:
        name, blocks = _read_ini(path)
        tables = {key: _rows(path, key, blocks[key]) for key in _INI_KEYS}
        size = [tables["width"].item(), tables["height"].item()]
        matrix, distortion, model = tables["camera matrix"], tables["distortion"], ""
    else:
        keys = read_yaml(path)
        _refuse_missing(path, _ROS_KEYS, keys)
        size = numbers(
            path, "image_width, image_height", [keys["image_width"], keys["image_height"]]
        ).tolist()
        matrix, distortion = (_ros_matrix(path, key, keys[key]) for key in _ROS_KEYS[2:])
        name, model = str(keys.get("camera_name") or ""), str(keys.get("distortion_model") or "")
    name = name or "camera"
    if model not in _FISHEYE | _RADTAN:
        problem = f"camera {name} has the distortion model {model[:40]!r}"
        raise DataError(path, problem, "calibrate it as plumb_bob, rational_polynomial or equidistant")
    fisheye = model in _FISHEYE
    return {name: _camera_of(path, name, size, matrix, distortion.ravel().tolist(), fisheye=fisheye)}


def _ros_matrix(path: Path, name: str, value: object) -> Float:
    """Read a matrix from its rows, cols and data."""
    block = value if isinstance(value, dict) else {}
    cells = numbers(path, f"{name}.data", block.get("data"))
    rows, columns = block.get("rows"), block.get("cols")
    # isinstance takes `true` for an integer, so compare the type itself.
    if type(rows) is not int or type(columns) is not int or min(rows, columns) < 0:
        raise damaged(path, f"{name} states no rows and cols")
    if rows * columns != len(cells):
        raise damaged(path, f"{name} is {rows} x {columns} but has {len(cells)} numbers")
    return cells.reshape(rows, columns) if len(cells) else cells.reshape(0, 0)


def _read_ini(path: Path) -> tuple[str, dict[str, list[list[str]]]]:
    """Read sections in brackets, a line of words for each key, and lines of numbers below it."""
    blocks: dict[str, list[list[str]]] = {}
    name, key = "", ""
    for line in read_text(path).split("\n"):
        text = line.partition("#")[0].partition(";")[0].strip()
        if section := re.fullmatch(r"\[(.*)\]", text):
            name, key = section[1] if section[1] not in {"image", "externals"} else name, ""
        elif re.match(r"(?!nan|inf)[A-Za-z]", text, re.IGNORECASE):
            key = text
        elif text:
            blocks.setdefault(key, []).append(text.split())
    _refuse_missing(path, _INI_KEYS, blocks)
    return name, blocks


def _rows(path: Path, key: str, rows: list[list[str]]) -> Float:
    try:
        return np.array([[float(cell) for cell in row] for row in rows])
    except ValueError as error:  # a word among the numbers, or rows of unequal length
        raise bad_value(path, f"{key} is no table of numbers") from error


CAMERA_INFO = CalibrationFile(
    "camera_info", "ROS camera calibration", (*_YAML, ".ini", ".txt"), _is_camera_info, _read_camera_info
)


# --- OpenCV's FileStorage ------------------------------------------------------------------------------

# A calibration has far fewer characters, and OpenCV's parser is slow.
_LARGEST = 1 << 20
# OpenCV's parser calls itself for each level, until the process ends.
_DEEPEST = 200
# A larger matrix is a mistake of its size and must never be allocated.
_MOST_CELLS = 64


def _depth(text: str) -> int:
    """Return a bound of the levels to which a file's elements, brackets or indented blocks are nested."""
    tags = re.findall(r"<[^!?][^<>]*", text) if text.lstrip().startswith("<") else []
    steps = [-1 if tag[1] == "/" else 0 if tag.endswith("/") else 1 for tag in tags]
    brackets = [1 if sign in "[{" else -1 for sign in re.findall(r"[][{}]", text)]
    indented = max(map(len, re.findall(r"(?m)^[ \t?:-]+", text)), default=0)
    return max(indented, *accumulate(steps, initial=0), *accumulate(brackets, initial=0))


class Storage:
    """Checked access to a FileStorage; names of nodes inside others have a slash."""

    def __init__(self, path: Path) -> None:
        import cv2

        self._path = path
        self._cv2 = cv2
        text = read_text(path)
        if len(text) > _LARGEST or _depth(text) > _DEEPEST:
            raise damaged(path, "is too large or nested too deeply")
        try:
            # From memory: OpenCV's own file access fails on some names, and unpacks archives.
            self._file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            self._root = self._file.root()
            whole = self._root.isMap()
        except (
            cv2.error,
            SystemError,
        ) as error:  # the latter is how the binding reports a failed constructor
            raise damaged(path, "OpenCV cannot parse it") from error
        if not whole:
            raise empty(path, "is empty")

    def text(self, key: str) -> str:
        """Return a string; empty if there is none."""
        node = self._root.getNode(key)
        return str(node.string()) if node.isString() else ""

    def texts(self, key: str) -> list[str]:
        """Return a list of strings; empty if there is none."""
        node = self._root.getNode(key)
        return [str(node.at(k).string()) for k in range(node.size())] if node.isSeq() else []

    def number(self, *keys: str) -> float:
        """Return the number of the first key that has one; 0 if none does."""
        for key in keys:
            group, _, inner = key.rpartition("/")
            node = self._root.getNode(group) if group else self._root
            node = node.getNode(inner) if node.isMap() else node
            if node.isInt() or node.isReal():
                return float(node.real())
        return 0.0

    def vector(self, key: str) -> list[float]:
        """Return a list of numbers; empty if there is none."""
        node = self._root.getNode(key)
        if not node.isSeq() or node.size() > _MOST_CELLS:
            return []
        return [float(node.at(i).real()) for i in range(node.size())]

    def matrix(self, *keys: str) -> Float | None:
        """Return the matrix of the first key that has one; None if none does."""
        key = next((key for key in keys if self._root.getNode(key).isMap()), None)
        if key is None:
            return None
        node = self._root.getNode(key)
        rows, columns = (node.getNode(side).real() for side in ("rows", "cols"))
        cells = node.getNode("data").size()
        if not 0 < cells <= _MOST_CELLS or rows * columns != cells:
            raise damaged(self._path, f"{key} is {rows:g} x {columns:g} but has {cells} numbers")
        try:
            return np.asarray(node.mat(), dtype=np.float64).reshape(int(rows), int(columns))
        except (self._cv2.error, TypeError, ValueError) as error:
            raise damaged(self._path, f"{key} is not a matrix of numbers") from error


def _with_pose(
    path: Path, name: str, storage: Storage, camera: CalibratedCamera, *keys: tuple[str, ...]
) -> CalibratedCamera:
    """Add a pose camera_from_world, of which the keys name rotation and translation, if there is one."""
    rotation, translation = (storage.matrix(*each) for each in keys)
    if rotation is None and translation is None:
        return camera
    if rotation is None or translation is None:
        problem = "has a rotation or a translation, but not both"
        raise DataError(path, problem, "give R and T, or rvec and tvec")
    return _placed(path, name, camera, rotation, translation)


# OpenCV's own samples spell their keys in more than one way.
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D")


def _is_opencv(head: str) -> bool:
    stored = "!!opencv-matrix" in head or "<opencv_storage>" in head
    return stored and re.search(rf"(?m)^\s*<?(?:{'|'.join(_MATRIX)})\b", head) is not None


def _read_opencv(path: Path) -> Cameras:
    """Read the one camera, and its pose from R or rvec with T or tvec, in metres."""
    storage = Storage(path)
    name = storage.text("camera_name") or "camera"
    width = storage.number("image_width", "image_Width", "width")
    size = storage.vector("image_size") or [width, storage.number("image_height", "image_Height", "height")]
    matrix, distortion = storage.matrix(*_MATRIX), storage.matrix(*_DISTORTION)
    if matrix is None or distortion is None:
        raise damaged(path, "has no camera_matrix or no distortion_coefficients")
    fisheye = bool(storage.number("fisheye_model")) or storage.text("distortion_model").lower() in _FISHEYE
    camera = _camera_of(path, name, size, matrix, distortion.ravel().tolist(), fisheye=fisheye)
    return {name: _with_pose(path, name, storage, camera, ("R", "rvec"), ("T", "tvec"))}


OPENCV = CalibrationFile("opencv", "OpenCV calibration", (*_YAML, ".xml"), _is_opencv, _read_opencv)


# --- EasyMocap: intri.yml with the extri.yml beside it: K_, dist_, Rot_ or R_, T_ by camera ------------


def _is_easymocap(head: str) -> bool:
    has_names = re.search(r"(?m)^names:", head) and re.search(r"(?m)^(?:K|R|Rot)_\w+:", head)
    return "!!opencv-matrix" in head and bool(has_names)


def _read_easymocap(path: Path) -> Cameras:
    """Read every camera; poses are camera_from_world, in metres."""
    ways = [path.with_name(path.name.replace(*pair)) for pair in (("extri", "intri"), ("intri", "extri"))]
    if not ways[0].is_file():
        raise DataError(ways[0], "is not there", "put it beside extri.yml", code="no-such-file")
    lenses = Storage(ways[0])
    places = Storage(ways[1]) if ways[1].is_file() and ways[1] != ways[0] else None
    found = {}
    for name in lenses.texts("names"):
        matrix, distortion = lenses.matrix(f"K_{name}"), lenses.matrix(f"dist_{name}")
        if matrix is None or distortion is None:
            raise damaged(ways[0], f"has no K_{name} or no dist_{name}")
        size = [lenses.number(f"{side}_{name}") for side in "WH"]
        camera = _camera_of(ways[0], name, size, matrix, distortion.ravel().tolist())
        keys = (f"Rot_{name}", f"R_{name}"), (f"T_{name}",)
        found[name] = _with_pose(ways[1], name, places, camera, *keys) if places else camera
    if not found:
        raise empty(path, "names no camera")
    return found


EASYMOCAP = CalibrationFile(
    "easymocap", "EasyMocap calibration", (".yml", ".yaml"), _is_easymocap, _read_easymocap
)


# --- ORB-SLAM 1 to 3: cameras Camera, Camera1 and Camera2, without pose --------------------------------

_PROJECTIONS = {"": False, "pinhole": False, "kannalabrandt8": True}  # True for a fisheye


def _read_orbslam(path: Path) -> Cameras:
    """Read every camera; the size is `Camera.width` and `Camera.height`, else the pictures decide."""
    storage = Storage(path)
    projection = storage.text("Camera.type")
    if projection.lower() not in _PROJECTIONS:
        problem = f"has the projection {projection[:40]!r}"
        raise DataError(path, problem, "calibrate it as PinHole or KannalaBrandt8")
    fisheye = _PROJECTIONS[projection.lower()]
    distortion = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return {
        name: _camera_of(
            path,
            name,
            [storage.number(f"{name}.{side}", f"Camera.{side}") for side in ("width", "height")],
            _matrix_of(*(storage.number(f"{name}.{key}") for key in ("fx", "fy", "cx", "cy"))),
            [storage.number(f"{name}.{key}") for key in distortion],
            fisheye=fisheye,
        )
        for name in ("Camera", "Camera1", "Camera2")
        if storage.number(f"{name}.fx")
    }


ORBSLAM = CalibrationFile(
    "orbslam",
    "ORB-SLAM settings",
    _YAML,
    lambda head: _has_keys(head, [rf"Camera1?\.{key}" for key in ("fx", "fy", "cx", "cy")]),
    _read_orbslam,
)


# --- camodocal, which VINS uses ------------------------------------------------------------------------

# Keypoints scatter by more, so such an approximation bends no limb.
MAX_APPROXIMATION_PX = 2.0
# So many directions about the optical axis show the largest difference.
DIRECTIONS = 41


def _read_camodocal(path: Path) -> Cameras:
    """Read the one camera. MEI (Mei and Rives 2007) is approximated by a fisheye; the difference is noted."""
    storage = Storage(path)
    model, name = storage.text("model_type").upper(), storage.text("camera_name") or "camera"
    size = [storage.number(f"image_{side}") for side in ("width", "height")]
    names = {
        **dict.fromkeys(("PINHOLE", "PINHOLE_FULL"), "fx fy cx cy"),
        "MEI": "gamma1 gamma2 u0 v0",
        "KANNALA_BRANDT": "mu mv u0 v0",
    }
    if model not in names:
        raise DataError(path, f"has the model {model[:40]!r}", f"calibrate it as {', '.join(names)}")
    matrix = _matrix_of(*(storage.number(f"projection_parameters/{key}") for key in names[model].split()))
    if model == "KANNALA_BRANDT":
        coefficients = [storage.number(f"projection_parameters/k{k}") for k in range(2, 6)]
        return {name: _camera_of(path, name, size, matrix, coefficients, fisheye=True)}
    keys = ("k1", "k2", "p1", "p2", *(("k3", "k4", "k5", "k6") if model == "PINHOLE_FULL" else ()))
    radtan = [storage.number(f"distortion_parameters/{key}") for key in keys]
    xi = storage.number("mirror_parameters/xi")
    if model.startswith("PINHOLE") or not xi or not np.diag(matrix).all():
        return {name: _camera_of(path, name, size, matrix, radtan)}
    focal, coefficients, off_px = _fisheye_like(size, matrix, radtan, xi) if xi > 0 else (1.0, [], np.inf)
    if not off_px <= MAX_APPROXIMATION_PX:
        problem = f"is a lens (MEI, xi {xi:g}) that no fisheye of ours fits: it is off by {off_px:.1f} px"
        raise DataError(path, problem, "calibrate it as KANNALA_BRANDT", code="unsupported")
    matrix[:2, :2] *= focal
    camera = _camera_of(path, name, size, matrix, coefficients, fisheye=True)
    note = f"its MEI model is approximated by a fisheye, off by at most {off_px:.2f} px"
    return {name: replace(camera, note=note)}


def _fisheye_like(
    size: Sequence[float], matrix: Float, radtan: Sequence[float], xi: float
) -> tuple[float, list[float], float]:
    """Fit a fisheye to a unified projection; return a factor of focal lengths, k1 to k4, the error in px."""
    k1, k2, p1, p2 = radtan
    corners = np.array([[-0.5, -0.5], [size[0] - 0.5, size[1] - 0.5]])
    reach = float(np.hypot(*np.abs((corners - matrix[:2, 2]) / np.diag(matrix)[:2]).max(axis=0)))
    angle = np.linspace(0, np.pi * 0.95, 2000)  # of rays to the optical axis, far beyond any picture
    radius = np.sin(angle) / (np.cos(angle) + xi)
    bent = radius * (1 + k1 * radius**2 + k2 * radius**4)
    rising = np.flatnonzero((np.diff(bent, prepend=-1) <= 0) | (bent > reach) | (radius < 0))
    seen = slice(1, int(rising[0]) if len(rising) else None)
    angle, radius, bent = angle[seen], radius[seen], bent[seen]
    focal = 1 / (1 + xi)
    powers = angle[:, None] ** [3, 5, 7, 9]
    found, *_ = np.linalg.lstsq(powers, bent / focal - angle, rcond=None)
    off = np.abs(focal * (angle + powers @ found) - bent)
    turned = np.linspace(0, 2 * np.pi, DIRECTIONS)[:, None]
    x, y = radius * np.cos(turned), radius * np.sin(turned)
    tangential = np.hypot(
        2 * p1 * x * y + p2 * (radius**2 + 2 * x**2), p1 * (radius**2 + 2 * y**2) + 2 * p2 * x * y
    )
    off_px = float((off + tangential.max(axis=0)).max() * np.diag(matrix)[:2].max()) if len(angle) else np.inf
    return focal, found.tolist(), off_px


CAMODOCAL = CalibrationFile(
    "camodocal",
    "camodocal calibration (VINS)",
    _YAML,
    lambda head: _has_keys(head, ("model_type", "(?:projection|poly)_parameters")),
    _read_camodocal,
)


# --- anipose, Pose2Sim and caliscope: TOML, a table for each camera ------------------------------------
# `matrix`, `distortions` (OpenCV's order) and `size` (floats in Pose2Sim's files) are the intrinsics.
# `rotation` (Rodrigues, or 3 x 3 in today's caliscope) and `translation` map world to camera. Lengths are in
# the file's unit: metres for Pose2Sim and caliscope, the unit of the board for anipose.

# The parser needs the square of a key's parts; keys of calibrations have two.
_MOST_DOTS = 100


def _read_anipose(path: Path) -> Cameras:
    """Read every camera, by the name in `name` or else of its table; those to be ignored are left out."""
    cameras: Cameras = {}
    tables = _tables(path)
    for key, table in tables.items():
        if "matrix" in table and not table.get("ignore", False):
            name = str(table.get("name", key))
            if name in cameras:
                raise DataError(path, f"two cameras are called {name}", "rename one", code="stated-twice")
            cameras[name] = _camera_of_table(path, name, table)
    if not cameras:
        ignored = sum("matrix" in table for table in tables.values())
        problem = f"says `ignore = true` of all {ignored} cameras that have a matrix"
        raise DataError(path, problem if ignored else "holds no table with a matrix", "calibrate first")
    return cameras


def _tables(path: Path) -> dict[str, dict[str, object]]:
    """Return all tables; those in `cameras`, as in today's caliscope, as older ones name them: cam_0."""
    text = read_text(path)
    if any(piece.count(".") > _MOST_DOTS for piece in re.split(r"[=,{\n]", text)):
        raise damaged(path, f"has a key of more than {_MOST_DOTS} parts")
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise damaged(path, f"is not TOML ({error})") from error
    tables = {key: value for key, value in content.items() if isinstance(value, dict)}
    nested = tables.get("cameras", {})
    if "matrix" in nested:  # one camera of that name
        return tables
    named = {f"cam_{key}" if key.isdecimal() else key: value for key, value in nested.items()}
    return tables | {key: value for key, value in named.items() if isinstance(value, dict)}


def _camera_of_table(path: Path, name: str, table: dict[str, object]) -> CalibratedCamera:
    size, matrix, distortion = (_finite(path, name, table, key) for key in ("size", "matrix", "distortions"))
    numbers_of = size.ravel().tolist(), matrix, distortion.ravel().tolist()
    camera = _camera_of(path, name, *numbers_of, fisheye=bool(table.get("fisheye", False)))
    if not {"rotation", "translation"} & table.keys():
        return camera
    return _placed(
        path, name, camera, *(_finite(path, name, table, key) for key in ("rotation", "translation"))
    )


def _finite(path: Path, camera: str, table: dict[str, object], key: str) -> Float:
    try:
        values = np.array(table.get(key), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.array(np.nan)
    if not np.isfinite(values).all():
        problem = f"camera {camera}: {key} is missing or not made of numbers"
        raise DataError(path, problem, f"state {key} as a list of numbers")
    return values


ANIPOSE = CalibrationFile(
    "anipose",
    "anipose, Pose2Sim or caliscope calibration",
    (".toml",),
    lambda head: _has_keys(head, ("matrix", "distortions|size")),
    _read_anipose,
)


# --- Kalibr's camchain.yaml: cam0, cam1, ... -----------------------------------------------------------
# Cameras have no pose: T_cam_imu and T_cn_cnm1 relate them to the body and to each other.

# Kalibr's name of a distortion and its number of coefficients: radtan is k1 k2 p1 p2 as OpenCV orders
# them, equidistant is cv2.fisheye's k1..k4.
_DISTORTIONS = {"radtan": 4, "equidistant": 4, "none": 0}
_KALIBR_KEYS = ("camera_model", "distortion_model", "intrinsics", "resolution")


def _read_kalibr(path: Path) -> Cameras:
    """Read every camera of the chain; the offset of its clock (t_imu = t_cam + shift) is noted."""
    chain = {name: block for name, block in read_yaml(path).items() if re.fullmatch(r"cam\d+", name)}
    if not chain:
        raise DataError(path, "holds no camera cam0, cam1, ...", "give Kalibr's camchain.yaml")
    return {name: _kalibr_camera(path, name, block) for name, block in chain.items()}


def _kalibr_camera(path: Path, name: str, block: object) -> CalibratedCamera:
    keys = block if isinstance(block, dict) else {}
    _refuse_missing(path, _KALIBR_KEYS, keys, f"camera {name} ")
    projection, distortion = (str(keys[key])[:40] for key in ("camera_model", "distortion_model"))
    if projection != "pinhole" or distortion not in _DISTORTIONS:
        problem = f"camera {name} has the projection {projection!r} and the distortion {distortion!r}"
        raise DataError(path, problem, "calibrate it with Kalibr as pinhole-radtan or pinhole-equi")
    focal = numbers(path, f"{name}.intrinsics", keys["intrinsics"])
    coefficients = numbers(path, f"{name}.distortion_coeffs", keys.get("distortion_coeffs") or [])
    counts = (len(focal), len(coefficients))
    if counts != (4, _DISTORTIONS[distortion]):
        problem = (
            f"camera {name} has {counts[0]} intrinsics and {counts[1]} distortion coefficients"
            f" instead of 4 and {_DISTORTIONS[distortion]} (pinhole, {distortion})"
        )
        raise damaged(path, problem)
    size = numbers(path, f"{name}.resolution", keys["resolution"]).tolist()
    fisheye = distortion == "equidistant"
    camera = _camera_of(path, name, size, _matrix_of(*focal), coefficients.tolist(), fisheye=fisheye)
    if "timeshift_cam_imu" not in keys:
        return camera
    (shift_s,) = numbers(path, f"{name}.timeshift_cam_imu", [keys["timeshift_cam_imu"]])
    note = f"timeshift_cam_imu of {shift_s:g} s is not used; of poses by that IMU, set `clock.offset_s` to it"
    return replace(camera, note=note)


KALIBR = CalibrationFile(
    "kalibr",
    "Kalibr camera chain",
    _YAML,
    lambda head: _has_keys(head, (r"cam\d+", "camera_model")),
    _read_kalibr,
)


# --- AirSim's settings.json: cameras by field of view -------------------------------------------------------

# No lens of a drone has a smaller field of view.
_LEAST_FOV_DEG = 0.1
# Sensors have fewer columns.
_MOST_COLUMNS = 100_000
# Settings hold one of these at least.
_AIRSIM_KEYS = ("SimMode", "CameraDefaults", "Vehicles")
# What the simulator takes where nothing is stated (its documentation of settings).
_AIRSIM_PICTURE = {"Width": 256, "Height": 144, "FOV_Degrees": 90}


def _is_airsim(head: str) -> bool:
    return '"SettingsVersion"' in head and any(f'"{key}"' in head for key in _AIRSIM_KEYS)


def _read_airsim(path: Path) -> Cameras:
    """Read `CameraDefaults`, and the cameras of vehicles as "vehicle/camera", with the mount as a note."""
    settings = read_json(path, AGAIN, takes_nan=True)  # in its documentation, too
    blocks = {"CameraDefaults": settings.get("CameraDefaults", {})}
    for vehicle, stated in _mapping(path, settings.get("Vehicles", {})).items():
        for camera, block in _mapping(path, _mapping(path, stated).get("Cameras", {})).items():
            blocks[f"{vehicle}/{camera}"] = block
    defaults = _scene_of_airsim(path, blocks["CameraDefaults"])
    return {
        name: _airsim_camera(path, name, _mapping(path, block), defaults) for name, block in blocks.items()
    }


def _mapping(path: Path, value: object) -> dict[str, object]:
    if not isinstance(value, dict):
        raise bad_value(path, "holds a value in place of names and values")
    return value


def _scene_of_airsim(path: Path, block: object) -> dict[str, object]:
    """Return the settings of pictures as the eye sees them, which are of type 0."""
    every = _mapping(path, block).get("CaptureSettings", [])
    captured = [_mapping(path, each) for each in (every if isinstance(every, list) else [])]
    return next((each for each in captured if each.get("ImageType", 0) == 0), {})


def _airsim_camera(
    path: Path, name: str, block: Mapping[str, object], defaults: Mapping[str, object]
) -> CalibratedCamera:
    stated = {**_AIRSIM_PICTURE, **defaults, **_scene_of_airsim(path, block)}
    width, height, fov_deg = numbers(path, name, [stated[key] for key in _AIRSIM_PICTURE])
    if not (_LEAST_FOV_DEG <= fov_deg < 180 and 0 < width <= _MOST_COLUMNS):
        problem = f"camera {name} has a field of view of {fov_deg:g} deg over {width:g} px"
        raise bad_value(path, problem)
    focal_px = width / 2 / np.tan(np.radians(fov_deg) / 2)
    matrix = _matrix_of(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    camera = _camera_of(path, name, [width, height], matrix, [])
    keys = ("X", "Y", "Z", "Pitch", "Roll", "Yaw")
    placed = [0.0 if block.get(key) is None else block[key] for key in keys]
    x, y, z, pitch, roll, yaw = numbers(path, name, placed).tolist()
    note = ""
    if any(block.get(key) is not None for key in keys):
        arm = f"[{x:g}, {0 - y:g}, {0 - z:g}]"
        note = (
            f"sits on its vehicle as mount: {{looks: forward, down_deg: {0 - pitch:g}, translation: {arm}}}"
        )
        note += f", turned by yaw {yaw:g} and roll {roll:g} deg" if yaw or roll else ""
    return replace(camera, note=note)


AIRSIM = CalibrationFile("airsim_settings", "AirSim settings", (".json",), _is_airsim, _read_airsim)
