"""Recorded motion on our bones: known motions under foreign names, scales and rest poses come back."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.geometry.poses import conjugate, multiply, rotate
from pipelines.geometry.rig import BONE, BONES, PARENT, SIDES, joint_centres
from pipelines.session.records import SkeletalMotion
from pipelines.simulation.retarget import retarget
from tests.simulation.motion.performing import RIG, clearance_m, flat, mound, performed

OURS = ("pelvis", "spine", "back", "chest", "neck", "head")
SIDED = ("clavicle", "upper_arm", "forearm", "hand", "thigh", "shank", "foot", "toes")
NAMES = tomllib.loads(Path(__file__).with_name("bones.toml").read_text(encoding="utf-8"))
PREFIX = {"mixamo": "mixamorig:", "biped": "Bip01_"}


def named(style: str) -> tuple[str, ...]:
    trunk, sided, sides = NAMES[style].values()
    names = dict(zip(OURS, trunk, strict=True))
    for side, letter in zip(SIDES, sides, strict=True):
        names |= {
            f"{side}_{ours}": theirs.replace("*", letter) for ours, theirs in zip(SIDED, sided, strict=True)
        }
    return tuple(PREFIX.get(style, "") + names[bone] for bone in BONES)


def recorded(style: str = "mixamo", scale: float = 1.0, arms_up_deg: float = 90.0) -> SkeletalMotion:
    """Return our own walk as a recording whose rest pose spreads the arms."""
    motion = performed({"walk": {"distance_m": 5}}, {"turn": {"deg": 60}}, seconds=9.0, step_s=0.02)
    rest = np.zeros((len(BONES), 4))
    rest[:, 3] = 1.0
    for sign, side in ((1.0, "left"), (-1.0, "right")):
        half = np.radians(sign * arms_up_deg) / 2
        for bone in ("upper_arm", "forearm", "hand"):
            rest[BONE[f"{side}_{bone}"]] = [np.sin(half), 0.0, 0.0, np.cos(half)]
    parent = tuple(-1 if above is None else BONE[above] for above in PARENT.values())
    offset = np.array(
        [
            RIG.offset[bone] if above < 0 else rotate(rest[above], RIG.offset[bone])
            for bone, above in enumerate(parent)
        ]
    )
    world = multiply(motion.rotation, conjugate(rest))
    own = [
        world[:, b] if p < 0 else multiply(conjugate(world[:, p]), world[:, b]) for b, p in enumerate(parent)
    ]
    return SkeletalMotion(
        motion.t_s, named(style), parent, scale * offset, {}, scale * motion.root, np.stack(own, axis=1)
    )


@pytest.mark.parametrize(("scale", "arms_up"), [(1.0, 90.0), (0.056, 90.0), (1.3, 0.0), (1.0, 45.0)])
def test_a_motion_comes_back_from_another_rest_pose_and_scale(scale: float, arms_up: float) -> None:
    source = recorded(scale=scale, arms_up_deg=arms_up)
    truth = performed({"walk": {"distance_m": 5}}, {"turn": {"deg": 60}}, seconds=9.0, step_s=0.02)
    motion = retarget(
        source, RIG, source.t_s, ground=flat, start=truth.root[0, :2], heading_deg=0.0, repeat=False
    )
    # The floor is found to 1.5 mm: so high the lowest point of a standing foot may be. A knee that is all but
    # straight goes ahead by up to sqrt(0.86 m x 1.5 mm / 2) = 25 mm if its foot is lifted by that.
    off = np.abs(joint_centres(RIG, motion) - joint_centres(RIG, truth)).max(axis=(0, 2))
    knees = [BONE["left_shank"], BONE["right_shank"]]
    assert off[knees].max() < 0.026
    assert np.delete(off, knees).max() < 0.004


def test_start_and_heading_are_those_asked_for() -> None:
    source = recorded()
    motion = retarget(
        source, RIG, source.t_s, ground=mound, start=np.array([3.0, 1.0]), heading_deg=90.0, repeat=False
    )
    assert motion.root[0, :2] == pytest.approx([3.0, 1.0], abs=1e-9)
    assert motion.root[-1, 0] == pytest.approx(3.0, abs=0.05)
    assert motion.root[-1, 1] == pytest.approx(6.0, abs=0.05)
    assert clearance_m(motion, mound).min() > -0.005


def test_after_its_end_the_last_pose_is_held_or_it_begins_again() -> None:
    source = recorded()
    t_s = np.arange(0.0, 24.0, 0.02)
    held, again = (
        retarget(source, RIG, t_s, ground=flat, start=np.zeros(2), heading_deg=0.0, repeat=repeat)
        for repeat in (False, True)
    )
    assert np.ptp(held.root[t_s > 9.0], axis=0) == pytest.approx(0.0, abs=1e-9)
    # Each round goes 5 m and turns by 60 deg: after two it is 5 m x (1 + exp(i 60 deg)) away.
    end = again.root[np.searchsorted(t_s, 2 * source.t_s[-1]), :2]
    assert end == pytest.approx([7.5, 5 * np.sin(np.pi / 3)], abs=0.1)
    step = np.sqrt(np.sum(np.diff(joint_centres(RIG, again), axis=0) ** 2, axis=2))
    assert step.max() < 0.02 * 8.0  # nothing of a walker is faster than 8 m/s, seams included


def test_a_first_frame_that_does_not_belong_is_left_out() -> None:
    source = recorded()
    rotation = source.rotation.copy()
    rotation[0] = [0.0, 0.0, 0.0, 1.0]
    root = source.root.copy()
    root[0] += [3.0, 0.0, 0.5]
    spoilt = replace(source, rotation=rotation, root=root)
    motion = retarget(spoilt, RIG, source.t_s, ground=flat, start=np.zeros(2), heading_deg=0.0, repeat=False)
    assert motion.root[:, 0].min() > -0.05
