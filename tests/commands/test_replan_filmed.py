"""`mocap replan-compare --render`: a short flight filmed again, in small pictures, by the real detector."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.film import FilmSettings, film, film_settings
from pipelines.formats.videos.video import FORMAT
from pipelines.geometry.arrays import Float
from pipelines.ingest import ingest
from pipelines.reconstruct import reconstruct
from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.storage import read_json
from pipelines.session.tables import TRUTH, read_motion
from pipelines.simulation.detector_errors import see
from pipelines.simulation.renderer import Renderer
from tests.commands.test_replan import compare, refused, session_of
from tests.keypoints.spotted_flights import spot_detector
from tests.synthetic.flights import write_flight

SHORT = """
schema: 1
name: Short
duration_s: 2
actor: {motion: [walk: {distance_m: 5}], estimate_sigma_m: 0.02}
world: {ground: {size_m: 40}, map: {resolution_m: 0.5, height_m: 4}}
drones:
  count: 2
  camera: {rate_hz: 5, width: 640, height: 360}
"""
SMALL = ("--arms", "fixed", "--trials", "1", "--render", "4,end=1")
FIRST_MM = 150.0
"""People of 67 px: keypoints of BlazePose are off by some 3 px of 26 mm, points of two views by more."""


@pytest.mark.long
def test_arms_are_filmed_and_a_detector_looks_at_them(tmp_path: Path) -> None:
    session = session_of(tmp_path, SHORT)
    done = compare(session, *SMALL, "--json")
    assert done.exit_code == 0, done.stderr
    filmed = json.loads(done.stdout)["filmed"]["arms"]["fixed"]
    assert filmed["pictures"] == 8  # at 0, 0.25, 0.5 and 0.75 s, by two cameras
    assert filmed["in_view_share"] == filmed["detected_share"] == 1.0
    assert filmed["tilt_deg"]["mean"] == pytest.approx(15, abs=1)
    assert filmed["keypoint_pck"] > 0.9
    assert max(filmed["mpjpe_mm"], filmed["reconstruction_error"]["mpjpe_mm"]["mean"]) < FIRST_MM
    assert filmed["fallback"] is not None, "auto needs more than four moments"
    folder = session / "film" / "fixed"
    assert len(FORMAT.index(folder / "drone1.mp4").pts_ns) == 4

    replanned = read_json(session / "replan" / "stage.json")
    again = compare(session, *SMALL)
    assert again.exit_code == 0, again.stderr
    assert " 4 Hz" in again.stdout
    assert "unchanged: " in again.stdout
    assert read_json(session / "replan" / "stage.json") == replanned
    assert film(session, FilmSettings(rate_hz=4.0, end_s=1.0)).skipped

    other = tmp_path / "other.yaml"
    other.write_text(SHORT.replace("distance_m: 5", "distance_m: 5, turn_deg: 90"), encoding="utf-8")
    assert re.search(
        r"\bother.yaml: .*\d\.\d\d m\b.*scenario=",
        refused(session, *SMALL, "--render", f"4,end=1,scenario={other}"),
    )
    assert re.search(r"session: 1 pictures\b", refused(session, *SMALL, "--render", "4,start=0.9,end=1"))


@pytest.mark.parametrize("stated", ["", "0", "31", "5,end", "5,stop=3", "5,start=nan"])
def test_a_film_that_cannot_be_meant_is_refused(stated: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        film_settings(stated)
    detector, scenario = "onnx:model.onnx,provider=cuda", Path("my,scenario.yaml")
    expected = FilmSettings(5.0, 1.0, None, detector), scenario
    assert film_settings(f"5,start=1,detector={detector},scenario={scenario}") == expected


def test_only_simulated_flights_are_filmed_again(tmp_path: Path) -> None:
    flight = write_flight(tmp_path / "flown", seconds=1.5, clean=True)
    session = tmp_path / "flown.session"
    ingest(flight.manifest, session=session)
    with pytest.raises(DataError, match="replan-compare`"):
        film(session)
    reconstruct(session)
    assert compare(session, "--arms", "fixed", "--trials", "1").exit_code == 0
    with pytest.raises(DataError, match="simulated"):
        film(session)


def film_without_renderer(
    session: Path, monkeypatch: pytest.MonkeyPatch, show: Callable[[Float, int], Float], end_s: float
) -> tuple[Float, Float, dict[str, Any]]:
    """Film arm `fixed` with detections [K, J, 2] by `show`; return joints, those found, and the figures."""
    assert compare(session, "--arms", "fixed", "--trials", "1").exit_code == 0
    motion, shown = read_motion(session / "truth.parquet", TRUTH), list[Float]()
    truth = motion.position[::2]
    lens = read_description(session).cameras["drone1"].intrinsics

    def picture(_: object, position: Float, turn: Float, bodies: Any, frame: int) -> object:
        for body, joints in zip(bodies, truth[frame], strict=True):  # the middles of both differ
            np.testing.assert_allclose(body.vertices.mean(axis=0), joints.mean(axis=0), atol=0.3)
        true = np.array([see(person, position, turn, lens) for person in truth[frame]])
        shown.append(show(true, len(shown)))
        return np.zeros((360, 640, 3), np.uint8)

    def step(*_: object, **__: object) -> tuple[Float, Float]:
        return shown[-1], np.ones(shown[-1].shape[:-1])

    monkeypatch.setattr(Renderer, "picture", picture)
    monkeypatch.setattr("pipelines.film.FollowedPeople.step", step)
    done = film(session, FilmSettings(5.0, None, end_s, spot_detector(session.parent)))
    found = read_motion(session / "film/fixed/skeleton.parquet", TRUTH, motion.joints)
    return truth, found.position, done.metrics["arms"]["fixed"]


def test_everybody_of_the_scenario_is_filmed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both people are in the pictures where the truth has them, and both are measured."""
    people = (
        "actors: {anna: {motion: [stand: {seconds: 1}], estimate_sigma_m: 0.02},"
        " ben: {motion: [stand: {seconds: 1}], start: [1, 3]}}"
    )
    text = SHORT.replace("actor: {motion: [walk: {distance_m: 5}], estimate_sigma_m: 0.02}", people)
    session = session_of(tmp_path, text)
    truth, found, figures = film_without_renderer(
        session, monkeypatch, lambda true, _: np.array([*true[::-1], true[0] + 80.0]), 0.5
    )
    anna, ben = figures["by_person"].values()
    assert list(figures["by_person"]) == ["anna", "ben"]
    assert anna["detected_share"] == ben["detected_share"] == 1.0
    assert max(anna["keypoint_median_px"], ben["keypoint_median_px"]) < 0.1
    assert max(anna["mpjpe_mm"], ben["mpjpe_mm"]) < 1.0  # exact poses and keypoints
    assert figures["mpjpe_mm"] == pytest.approx((anna["mpjpe_mm"] + ben["mpjpe_mm"]) / 2)
    np.testing.assert_allclose(found, truth[:3], atol=0.01)
    with np.load(session / "film" / "fixed" / "errors.npz") as errors:
        np.testing.assert_allclose(errors["by_keypoints"], errors["filmed"], atol=1e-4)


def test_somebody_else_in_one_camera_is_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From its sixth picture on, the first camera shows a body 150 px aside: nothing is measured then."""
    session = session_of(tmp_path, SHORT)
    truth, found, _ = film_without_renderer(
        session, monkeypatch, lambda true, k: np.asarray(true + np.array([150.0 * (5 <= k < 9), 0.0])), 2.0
    )
    np.testing.assert_allclose(found, truth[:5], atol=0.02)
