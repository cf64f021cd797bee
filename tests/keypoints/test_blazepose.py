"""Default detector against MediaPipe itself, and its parts against closed forms."""

import hashlib
import io
import json
import shutil
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.geometry.arrays import Float, Picture
from pipelines.keypoints.blazepose import DETECTOR, BlazePose
from pipelines.session.errors import DataError
from pipelines.session.model_files import ModelFile, NpmPackage, PackagedModels, Wheel
from pipelines.session.registries import Person, Region
from tests.real_data import real_data

REFERENCE = Path(__file__).with_name("reference_blazepose.json")
CROP = 256


@pytest.fixture(scope="module")
def networks() -> BlazePose:
    """Load the real networks; skip without the files and without an internet connection."""
    try:
        DETECTOR.fetch()
    except DataError as error:
        pytest.skip(str(error))
    return DETECTOR.load(threads=1)


@dataclass(frozen=True)
class Sample:
    """Real picture with MediaPipe's results, converted to our convention."""

    picture: Picture
    region: Region
    next_region: Region
    score: float
    xy: Float


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    folder = real_data("pose2sim_single/videos")
    return [sample(folder, entry) for entry in json.loads(REFERENCE.read_text())["frames"]]


def sample(folder: Path, entry: dict[str, Any]) -> Sample:
    import cv2

    capture = cv2.VideoCapture(str(folder / entry["video"]))
    for _ in range(entry["frame"] + 1):
        read, picture = capture.read()
        assert read
    # Numbers of other pixels would compare decoders, not detectors.
    assert hashlib.sha256(picture.tobytes()).hexdigest() == entry["sha256"]
    x, y, side, angle = entry["region"]
    # MediaPipe reports u + 1/2 crop pixels for a position u that is counted from pixel centres.
    half = crop_pixel(side, angle) @ (0.5, 0.5)
    next_x, next_y, next_side, next_angle = entry["next_region"]
    return Sample(
        picture,
        Region((x - half[0], y - half[1]), side, angle),
        Region((next_x - half[0], next_y - half[1]), next_side, next_angle),
        entry["score"],
        np.array(entry["landmarks"]) - half,
    )


def crop_pixel(side: float, angle: float) -> Float:
    """Return as columns one crop pixel to the right and one down, turned clockwise, in picture pixels."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn * side / CROP


def distance(person: Person, sample: Sample) -> Float:
    away: Float = np.linalg.norm(person.xy - sample.xy, axis=1)
    return away


def assert_same_region(found: Region, expected: Region, px: float) -> None:
    assert found.centre == pytest.approx(expected.centre, abs=px)
    assert found.side == pytest.approx(expected.side, abs=2 * px)
    assert found.angle_rad == pytest.approx(expected.angle_rad, abs=2 * px / expected.side)


# The goal is 0.1 px (median). The locked OpenCV gives 0.005 px from the same region and 0.006 px from the
# picture (95 %: 0.02, largest: 0.09). Warping without rounding positions to 1/32 px gives 0.09 and 0.61 px:
# the limits are tighter to detect this.
MEDIAN_PX = 0.02
LARGEST_PX = 0.5


def test_landmarks_are_those_of_mediapipe(networks: BlazePose, samples: list[Sample]) -> None:
    away = np.array([distance(networks.locate(s.picture, [s.region])[0], s) for s in samples])
    assert np.median(away) < MEDIAN_PX
    assert away.max() < LARGEST_PX


def test_people_are_found_where_mediapipe_finds_them(networks: BlazePose, samples: list[Sample]) -> None:
    for s in samples:
        region, score = networks.find_people(s.picture)[0]
        assert_same_region(region, s.region, px=0.05)
        assert score == pytest.approx(s.score, abs=0.001)


def test_from_picture_to_landmarks_as_mediapipe(networks: BlazePose, samples: list[Sample]) -> None:
    away = []
    for s in samples:
        people = networks.locate(s.picture, [networks.find_people(s.picture)[0][0]])
        assert people[0].presence > 0.9
        away.append(distance(people[0], s))
    assert np.median(away) < MEDIAN_PX
    assert np.max(away) < LARGEST_PX


def test_a_mirrored_person_has_mirrored_joints(networks: BlazePose, samples: list[Sample]) -> None:
    """Check the half-pixel convention: over many joints the network is symmetric in left and right.

    With edges taken for centres of pixels, the mirrored joints would be one crop pixel off. Measured are
    0.1 to 0.2 (the mirror is not exact, and the heatmap's window is cut to cells).
    """
    joints = networks.joints
    swapped = [
        joints.index(joint.replace("left_", "#").replace("right_", "left_").replace("#", "right_"))
        for joint in joints
    ]
    off = []
    for s in samples:
        width = s.picture.shape[1]
        mirror = Region(
            (width - 1 - s.region.centre[0], s.region.centre[1]), s.region.side, -s.region.angle_rad
        )
        person = networks.locate(s.picture, [s.region])[0]
        mirrored = networks.locate(np.ascontiguousarray(s.picture[:, ::-1]), [mirror])[0]
        sure = (person.confidence > 0.7) & (mirrored.confidence[swapped] > 0.7)
        back = np.column_stack([width - 1 - mirrored.xy[swapped, 0], mirrored.xy[swapped, 1]])
        # Along the crop's own x, the mirrored direction.
        right = crop_pixel(s.region.side, s.region.angle_rad)[:, 0] * CROP / s.region.side
        off.append(((person.xy - back)[sure] @ right) * CROP / s.region.side)
    assert abs(np.median(np.concatenate(off))) < 0.4


def test_a_turned_picture_has_turned_joints(networks: BlazePose) -> None:
    """Cut the same crop from a picture turned by 90 deg: only the last bits of the positions differ."""
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 255, (30, 40, 3)).astype(np.uint8)
    picture = np.repeat(np.repeat(coarse, 16, axis=0), 16, axis=1)
    height = picture.shape[0]
    region = Region((300.25, 200.5), 256.0, 0.0)
    # np.rot90(-1) turns clockwise: (x, y) goes to (height - 1 - y, x), and up goes to the right.
    turned = Region((height - 1 - 200.5, 300.25), 256.0, np.pi / 2)
    straight = networks.locate(picture, [region])[0]
    other = networks.locate(np.ascontiguousarray(np.rot90(picture, -1)), [turned])[0]
    expected = np.column_stack([height - 1 - straight.xy[:, 1], straight.xy[:, 0]])
    np.testing.assert_allclose(other.xy, expected, atol=1e-3)
    np.testing.assert_allclose(other.confidence, straight.confidence, atol=1e-6)


def test_nobody_is_found_in_an_empty_picture(networks: BlazePose) -> None:
    empty = np.full((480, 640, 3), 90, np.uint8)
    assert networks.find_people(empty) == []
    [person] = networks.locate(empty, [Region((320, 240), 300)])
    assert person.presence < 0.5
    assert np.isfinite(person.xy).all()
    assert person.confidence.max() < 0.5


def test_joints_outside_of_the_crop_have_no_confidence(networks: BlazePose, samples: list[Sample]) -> None:
    """Use a region around the head of half the right width: joints outside of it get confidence 0."""
    outside = 0
    for s in samples:
        region = Region((float(s.xy[0, 0]), float(s.xy[0, 1])), s.region.side / 2, s.region.angle_rad)
        [person] = networks.locate(s.picture, [region])
        assert np.isfinite(person.xy).all()
        in_crop = (person.xy - region.centre) @ np.linalg.inv(crop_pixel(region.side, region.angle_rad)).T
        beyond = (np.abs(in_crop) > CROP / 2 + 4).any(axis=1)  # a cell of the heatmap is 4 px
        outside += int(beyond.sum())
        assert not person.confidence[beyond].any()
    assert outside  # else nothing was tested


TAGS = ("3.11", "cp311", "manylinux_2_28_x86_64")  # as pinned: not what this machine needs to be
WHEEL = "mocap_test_models-1.2-cp311-cp311-manylinux_2_28_x86_64.whl"
CONTENT = {"pose/first.tflite": b"first network" * 100, "pose/second.tflite": b"second network" * 200}


def models(**changed: bytes) -> PackagedModels:
    """Describe the models of the test's own wheel; `changed` expects other content than it has."""
    files = [
        ModelFile(member, len(content), hashlib.sha256(changed.get(member[5:-7], content)).hexdigest())
        for member, content in CONTENT.items()
    ]
    return PackagedModels("testpose", Wheel("mocap_test_models", "1.2", TAGS), tuple(files))


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create a folder that pip uses instead of the network; the cache is temporary as well."""
    folder = tmp_path / "shelf"
    folder.mkdir()
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    monkeypatch.setenv("MOCAP_MODELS", str(tmp_path / "cache"))
    return folder


def write_wheel(folder: Path, content: dict[str, bytes] = CONTENT) -> Path:
    path = folder / WHEEL
    info = "mocap_test_models-1.2.dist-info"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as wheel:
        for member, data in content.items():
            wheel.writestr(member, data)
        wheel.writestr(
            f"{info}/METADATA",
            # pip must not require this Python, and must not follow dependencies.
            "Metadata-Version: 2.1\nName: mocap-test-models\nVersion: 1.2\n"
            "Requires-Python: ==3.11.*\nRequires-Dist: there-is-no-such-package\n",
        )
        wheel.writestr(f"{info}/WHEEL", f"Wheel-Version: 1.0\nRoot-Is-Purelib: false\nTag: {WHEEL[24:-4]}\n")
        wheel.writestr(f"{info}/RECORD", "")
    return path


def test_files_come_out_of_the_wheel_that_pip_downloads(shelf: Path, tmp_path: Path) -> None:
    write_wheel(shelf)
    wanted = models()
    assert wanted.present() == {"first.tflite": None, "second.tflite": None}
    wanted.fetch()
    folder = tmp_path / "cache" / "testpose"
    assert wanted.verified() == {name: folder / name for name in ("first.tflite", "second.tflite")}
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
        member[5:]: content for member, content in CONTENT.items()
    }


def test_what_is_there_is_not_fetched_again_and_what_is_damaged_is(shelf: Path) -> None:
    wheel = write_wheel(shelf)
    wanted = models()
    wanted.fetch()
    wheel.unlink()
    wanted.fetch()  # nothing to do, so that no network is needed
    first = wanted.folder / "first.tflite"
    first.write_bytes(b"cut")
    with pytest.raises(DataError, match=r"first\.tflite: is not the file that was expected.*fetch testpose"):
        wanted.verified()
    write_wheel(shelf)
    wanted.fetch()
    assert wanted.verified()["first.tflite"] == first


def test_damaged_and_wrong_sources_are_named(shelf: Path, tmp_path: Path) -> None:
    whole = write_wheel(tmp_path).read_bytes()
    for name, content in {"text.whl": b"no wheel", "cut.whl": whole[: len(whole) // 2]}.items():
        source = tmp_path / name
        source.write_bytes(content)
        with pytest.raises(DataError, match=rf"{name}: is no readable wheel"):
            models().fetch(source)
    other = write_wheel(tmp_path, {"pose/first.tflite": CONTENT["pose/first.tflite"]})
    with pytest.raises(DataError, match=r"holds no pose/second\.tflite"):
        models().fetch(other)
    with pytest.raises(DataError, match=r"holds no first\.tflite"):
        models().fetch(shelf)


# --- out of a tarball, by npm --------------------------------------------------------------------------
TARBALL = "mocap-test-models-1.2.0.tgz"
NETWORK = {"package/third.tflite": b"third network" * 300}


def npm_models(content: dict[str, bytes] = NETWORK) -> PackagedModels:
    """Describe the models of the test's own package, with the expected content."""
    files = [ModelFile(name, len(data), hashlib.sha256(data).hexdigest()) for name, data in content.items()]
    return PackagedModels("testpose", NpmPackage("mocap-test-models", "1.2.0"), tuple(files))


def write_tarball(folder: Path, content: dict[str, bytes] = NETWORK) -> Path:
    path = folder / TARBALL
    described = {"package/package.json": b'{"name": "mocap-test-models", "version": "1.2.0"}'}
    with tarfile.open(path, "w:gz") as tarball:
        for member, data in {**described, **content}.items():
            entry = tarfile.TarInfo(member)
            entry.size = len(data)
            tarball.addfile(entry, io.BytesIO(data))
    return path


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve the folder's files as npm's registry for a while; yield the address."""
    handler = partial(QuietHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


class QuietHandler(SimpleHTTPRequestHandler):
    """Server without log output."""

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # the library's name
        """Print nothing."""


def test_files_come_out_of_the_tarball_that_npm_downloads(
    shelf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if shutil.which("npm") is None:
        pytest.skip("npm is not installed here")
    monkeypatch.setenv("npm_config_cache", str(tmp_path / "npm"))
    digest = hashlib.sha1(write_tarball(shelf).read_bytes(), usedforsecurity=False).hexdigest()
    with served(shelf) as address:
        monkeypatch.setenv("npm_config_registry", address)
        release = {
            "name": "mocap-test-models",
            "version": "1.2.0",
            "dist": {"tarball": f"{address}/{TARBALL}", "shasum": digest},
        }
        told = {"name": "mocap-test-models", "dist-tags": {}, "versions": {"1.2.0": release}}
        (shelf / "mocap-test-models").write_text(json.dumps(told))
        npm_models().fetch()
    (found,) = npm_models().verified().values()
    assert found.read_bytes() == NETWORK["package/third.tflite"]
    assert [path.name for path in found.parent.iterdir()] == ["third.tflite"]
    found.unlink()
    # The server is gone: npm says that nobody answers, and the cache stays empty.
    monkeypatch.setenv("npm_config_cache", str(tmp_path / "other"))
    with pytest.raises(DataError, match=r"could not be downloaded \(.*ECONNREFUSED.*--from PATH"):
        npm_models().fetch()
    assert list(found.parent.iterdir()) == []


def test_wrong_and_damaged_tarballs_are_refused_and_not_kept(shelf: Path, tmp_path: Path) -> None:
    whole = write_tarball(tmp_path).read_bytes()
    expected = len(NETWORK["package/third.tflite"])
    refusals = {
        "text.tgz": (b"no tarball", "is no readable tarball"),
        "cut.tgz": (whole[: len(whole) // 2], "is no readable tarball"),
        "long.tgz": (bytes(5_000_000), f"SHA-256 .* of {expected} bytes"),
        "other.tgz": (bytes(expected), f"SHA-256 .* of {expected} bytes"),
    }
    for name, (content, reason) in refusals.items():
        source = tmp_path / name
        if "readable" in reason:
            source.write_bytes(content)
        else:
            write_tarball(tmp_path, {"package/third.tflite": content}).rename(source)
        with pytest.raises(DataError, match=rf"{name}: .*{reason}"):
            npm_models().fetch(source)
    empty = write_tarball(tmp_path, {"package/fourth.tflite": b"another"})
    with pytest.raises(
        DataError, match=r"holds no package/third\.tflite; give the tarball or the folder that does"
    ):
        npm_models().fetch(empty)
    assert not npm_models().folder.exists()
