"""COLMAP models: a folder with cameras and images as .txt or .bin, read by pycolmap.

pycolmap reads on behind the end of a damaged file, for ever or into wrong numbers. So it runs in a process of
its own with limits of time and memory, and writes the model again: what was read whole has the same size.
COLMAP puts (0, 0) at the corner of the top left pixel: cx and cy lose half a pixel.
"""

import json
import math
import subprocess
import sys
import tempfile
from collections import Counter
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from pipelines.formats.calibrations.camera_matrices import build_intrinsics, describe_cameras, invert_pose
from pipelines.geometry.arrays import DistortionModel, Intrinsics
from pipelines.session.errors import DataError
from pipelines.session.records import CalibratedCamera
from pipelines.session.storage import damaged

# A small model takes a second of processor time, nearly all of it to import pycolmap.
READING_CPU_S = 3
# A busy machine gives a process a quarter of its processor.
READING_TIMEOUT_S = 20.0
# Slow disks and machines read that much; a larger file gets the time on top.
_SLOWEST_READING_BYTES_PER_S = 2e6
# Images need up to ten times their size in the file; damaged counts ask for terabytes.
_MEMORY_BYTES, _MEMORY_PER_BYTE = 1 << 29, 20
_FILES = ("cameras", "images")


# Of each model: focal lengths, before cx, cy and coefficients; our model, and how many of those it has.
_MODELS: dict[str, tuple[int, DistortionModel, int]] = {
    "SIMPLE_PINHOLE": (1, "none", 0),
    "PINHOLE": (2, "none", 0),
    "SIMPLE_RADIAL": (1, "radtan", 4),
    "RADIAL": (1, "radtan", 4),
    "OPENCV": (2, "radtan", 4),
    "FULL_OPENCV": (2, "radtan", 8),
    "OPENCV_FISHEYE": (2, "fisheye", 4),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye", 4),
    "RADIAL_FISHEYE": (1, "fisheye", 4),
}


class ColmapModel:
    """Reader of COLMAP models: one camera for each image, named after it without folder and suffix.

    Images that would get one name (cam1/000.jpg, cam2/000.jpg) keep their folder: "cam1/000", "cam2/000".
    """

    name = "colmap"
    title = "COLMAP model"
    suffixes: tuple[str, ...] = ("",)

    def recognises(self, path: Path) -> bool:
        """Return True if a folder holds cameras and images, both as text or both binary."""
        return any(_stored(path, suffix) for suffix in (".bin", ".txt"))

    def describe(self, path: Path) -> dict[str, object]:
        """Describe every image's camera."""
        return describe_cameras(self.read_calibration(path))

    def read_calibration(self, path: Path) -> dict[str, CalibratedCamera]:
        """Read the camera and pose of every image; binary files before text, as COLMAP does."""
        if not self.recognises(path):
            problem = f"lacks one of {', '.join(_FILES)}, all as .bin or all as .txt"
            raise DataError(path, problem, "name the folder with the whole COLMAP model")
        cameras, images = _read(path)
        if not images:
            raise DataError(path, "holds no image with a pose", "COLMAP registered none; map again")
        lenses = {number: _intrinsics(path, number, *camera) for number, camera in cameras.items()}
        found = {}
        for name, (camera, quaternion, translation) in sorted(_named(path, images).items()):
            pose = invert_pose(path, name, np.array(quaternion), np.array(translation))
            found[name] = CalibratedCamera(lenses[str(camera)], *pose)
        return found


def _stored(path: Path, suffix: str) -> bool:
    return all((path / f"{name}{suffix}").is_file() for name in _FILES)


def _named(path: Path, images: dict[str, Any]) -> dict[str, Any]:
    """Name each image after its file, with the folder where several files share a name."""
    whole = {
        each: PurePosixPath(each.replace("\\", "/")).with_suffix("") for each in images if each.strip("/")
    }
    shared = Counter(place.name for place in whole.values())
    named = {
        place.name if shared[place.name] == 1 else str(place): images[each] for each, place in whole.items()
    }
    if len(named) < len(images):
        raise DataError(path, "holds images without a name, or two of one name", "rename them")
    return named


def _intrinsics(path: Path, camera: str, model: str, size: list[int], parameters: list[float]) -> Intrinsics:
    if model not in _MODELS:
        problem = f"camera {camera} has the model {model}, which is not supported"
        raise DataError(path, problem, f"use one of {', '.join(_MODELS)}")
    focals, distortion, count = _MODELS[model]
    cx, cy, *coefficients = parameters[focals:]
    matrix = np.array([[parameters[0], 0, cx - 0.5], [0, parameters[focals - 1], cy - 0.5], [0, 0, 1]])
    padded = (*coefficients, *[0.0] * (count - len(coefficients)))
    return build_intrinsics(path, camera, size, matrix, distortion, padded)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read cameras and images in a process of its own, whose messages stay away from the terminal."""
    size = sum(file.stat().st_size for file in path.iterdir() if file.is_file())
    memory = _MEMORY_BYTES + _MEMORY_PER_BYTE * size
    more_s = math.ceil(size / _SLOWEST_READING_BYTES_PER_S)
    limit_s, cpu_s = READING_TIMEOUT_S + more_s, READING_CPU_S + more_s
    problem = "is no COLMAP model that can be read"
    try:
        done = subprocess.run(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-m", __name__, path.absolute(), str(memory), str(cpu_s)],
            capture_output=True, timeout=limit_s, check=True, text=True,
        )  # fmt: skip
        answer = json.loads(done.stdout.splitlines()[-1])
        if "error" not in answer:
            return answer["cameras"], answer["images"]
        problem += f" ({answer['error']})"
    except (subprocess.SubprocessError, ValueError, LookupError):
        pass
    raise damaged(path, problem)


def _read_here(path: Path, memory: int, cpu_s: int) -> dict[str, Any]:
    """Read a model by pycolmap; return cameras and images for JSON, or the error."""
    import resource

    import pycolmap

    for limit, most in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, cpu_s)):
        with suppress(ValueError):  # of systems without such a limit, and where less is allowed
            resource.setrlimit(limit, (most, resource.getrlimit(limit)[1]))
    suffix = next(each for each in (".bin", ".txt") if _stored(path, each))
    with tempfile.TemporaryDirectory() as folder:
        copy, again = Path(folder) / "copy", Path(folder) / "again"
        copy.mkdir()
        again.mkdir()
        for name in (*_FILES, "rigs", "frames"):
            if (path / f"{name}{suffix}").is_file():
                (copy / f"{name}{suffix}").symlink_to((path / f"{name}{suffix}").resolve())
        # Points are not used, and a damaged count of them asks for terabytes.
        (copy / f"points3D{suffix}").write_bytes(bytes(8) if suffix == ".bin" else b"")
        model = pycolmap.Reconstruction(str(copy))
        (model.write_binary if suffix == ".bin" else model.write_text)(again)
        for name in _FILES:
            stored, written = (_content(each / f"{name}{suffix}") for each in (path, again))
            if stored != written:
                return {"error": f"{name}{suffix} is cut off or damaged: {stored} in place of {written}"}
    cameras = {
        number: (camera.model.name, (camera.width, camera.height), camera.params.tolist())
        for number, camera in model.cameras.items()
    }
    images = {}
    for image in model.images.values():
        pose = image.cam_from_world()
        images[image.name] = (image.camera_id, pose.rotation.quat.tolist(), pose.translation.tolist())
    if len(images) < len(model.images):
        return {"error": "two images have one name"}
    return {"cameras": cameras, "images": images}


def _content(path: Path) -> int:
    """Count the bytes of a binary file, the words of a text without its comments."""
    if path.suffix == ".bin":
        return path.stat().st_size
    with path.open(encoding="utf-8", errors="replace") as lines:
        return sum(len(line.split()) for line in lines if not line.lstrip().startswith("#"))


FORMAT = ColmapModel()

if __name__ == "__main__":
    try:
        found = _read_here(Path(sys.argv[1]), *map(int, sys.argv[2:]))
    except Exception as error:
        found = {"error": str(error).split("Check failed: ")[-1][:100]}
    print(json.dumps(found))  # noqa: T201 - the answer to the process that asked
