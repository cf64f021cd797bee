"""Hints for the detector from the actor's log, and changes that make the stage run again."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

from pipelines.detect import detect
from pipelines.ingest import ingest
from pipelines.keypoints.search import Hint, actor_hints, hint_sigma
from pipelines.session.description import read_description
from pipelines.session.people import logged_actor
from pipelines.session.records import Trajectory
from pipelines.session.stages import StageRecord, locked
from pipelines.session.tables import trajectory_from
from tests.keypoints.spotted_flights import CAMERAS, FPS, LENS, START_S, spot_detector, write_spotted_flight
from tests.synthetic.logged_flights import pose_entry
from tests.synthetic.logs import write_log

FRAMES = 3
NOISE = {"white": {"position_m": 0.4, "rotation_deg": 2.0}, "bias": {"position_m": 0.3}}
DISTANCE_M = math.dist(CAMERAS["left"], (0.0, 0.0, 1.0))


class Flight:
    """A spotted flight whose settings can be changed, and its session."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.manifest = write_spotted_flight(folder, FRAMES)
        self.session = folder / "flight.session"
        self.settings: dict[str, Any] = YAML(typ="safe").load(self.manifest)

    def log_actor(self, point: str, height_m: float) -> None:
        """Log an actor who stands in the origin, where both cameras look at 1 m height."""
        stamps = [START_S * 10**9 + round(k * 1e9 / FPS) for k in range(FRAMES)]
        entries = [pose_entry("/actor", t, (0.0, 0.0, height_m)) for t in stamps]
        write_log(self.folder, "actor", "mcap-cdr", entries)
        self.settings["actor"] = {"file": "actor.mcap", "topic": "/actor", "point": point}

    def ingest(self) -> None:
        YAML(typ="safe").dump(self.settings, self.manifest)
        ingest(self.manifest, self.session)

    def hints(self) -> list[Hint | None]:
        self.ingest()
        stamps = START_S * 10**9 + np.round(np.arange(FRAMES) * 1e9 / FPS).astype(np.int64)
        description = read_description(self.session)
        actor = logged_actor(self.session, description)
        assert actor is not None
        track = trajectory_from(pd.read_parquet(self.session / "cameras" / "left" / "poses.parquet"))
        entry, between = description.cameras["left"], description.pose_interpolation
        return actor_hints(actor, "left", entry, track, between, stamps)

    def detected(self, detector: str) -> StageRecord:
        """The record of the stage, which is run where it has to be."""
        self.ingest()
        with locked(self.session) as writable:
            record = detect(writable, detector=detector)
        assert record is not None
        return record


@pytest.mark.parametrize(("point", "height_m"), [("hip", 1.0), ("feet", 0.05), ("head", 1.7)])
def test_the_hint_is_at_the_hips_whatever_point_was_logged(
    tmp_path: Path, point: str, height_m: float
) -> None:
    flight = Flight(tmp_path)
    flight.log_actor(point, height_m)

    hints = flight.hints()

    # The cameras look at the hips, 0.95 m above the feet and 0.7 m below the head.
    assert len(hints) == FRAMES
    for hint in hints:
        assert hint is not None
        assert hint.centre == pytest.approx((LENS.cx, LENS.cy), abs=1e-3)
        assert hint.height_px == pytest.approx(LENS.fx * 1.75 / DISTANCE_M, rel=1e-3)
    actor = logged_actor(flight.session, read_description(flight.session))
    assert actor is not None
    assert actor.hips_at(np.array([START_S * 10**9])) == pytest.approx(np.array([[0.0, 0.0, 1.0]]))


def test_logged_covariances_count_where_nothing_is_stated(tmp_path: Path) -> None:
    flight = Flight(tmp_path)
    flight.log_actor("hip", 1.0)
    flight.ingest()
    entry = read_description(flight.session).cameras["left"]
    sigmas = np.array([[0.2, 0.03], [0.5, 0.01]])
    covariance = np.stack([np.diag(np.repeat(sigma**2, 3)) for sigma in sigmas])
    trajectory = Trajectory(
        np.array([0, 1000]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)), covariance
    )

    found = hint_sigma("left", entry, trajectory, np.array([-5, 0, 999, 1000, 2000]))

    # Of the pose before each picture, the first where there is none.
    at_pictures = sigmas[[0, 0, 0, 1, 1]]
    assert found[:, 0] == pytest.approx(np.hypot(1.0, at_pictures[:, 0]))
    assert found[:, 1] == pytest.approx(at_pictures[:, 1])
    stated = entry.model_copy(update={"pose_noise": NOISE})
    assert hint_sigma("left", stated, trajectory, np.array([0]))[0] == pytest.approx(
        [math.sqrt(1 + 0.4**2 + 0.3**2), math.radians(2)]
    )


def test_only_another_log_of_the_actor_has_the_keypoints_detected_anew(tmp_path: Path) -> None:
    flight, detector = Flight(tmp_path), spot_detector(tmp_path)
    camera = flight.settings["cameras"]["left"]
    first = flight.detected(detector)
    assert "hints_from" not in first.inputs, "nobody was logged"
    camera["pose_noise"] = NOISE
    assert flight.detected(detector) == first
    flight.log_actor("hip", 1.0)
    hinted = flight.detected(detector)
    assert hinted.inputs["log of the actor"] not in first.inputs.values()
    # Poses, calibrations and clocks move the hints; the keypoints stay those that were found with the first.
    camera["pose_noise"] = {"white": {"position_m": 0.4}}
    assert flight.detected(detector) == hinted
    camera["intrinsics"]["fx"] = 290.0
    assert flight.detected(detector) == hinted
    camera["clock"]["offset_s"] = 0.01
    later = flight.detected(detector)
    assert later.key != hinted.key
    assert later.inputs["hints_from"] == hinted.inputs["hints_from"]
    # Another log, or another point of the body that it follows, is another actor.
    flight.log_actor("hip", 1.2)
    higher = flight.detected(detector)
    flight.settings["actor"]["point"] = "feet"
    feet = flight.detected(detector)
    found_with = [record.inputs["hints_from"] for record in (hinted, higher, feet)]
    assert len(set(found_with)) == 3
