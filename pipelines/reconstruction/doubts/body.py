"""Oddity of people: their size, limbs, posture and motion, against published measurements of people."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.reconstruction.doubts.scene import JOINTS, STEP_NS, Sampled, median

_INDEX = {name: index for index, name in enumerate(JOINTS)}
# Joints seen in fewer moments do not tell on which side they are.
_FEWEST_MOMENTS = 20

# Lengths of limbs over stature: Winter, Biomechanics and Motor Control of Human Movement, 4th ed., fig. 4.1,
# after Drillis and Contini 1964; from the middle of the hips to that of the shoulders for the torso.
_LIMBS = (
    ("left_hip", "left_knee", 0.245),
    ("right_hip", "right_knee", 0.245),
    ("left_knee", "left_ankle", 0.246),
    ("right_knee", "right_ankle", 0.246),
    ("left_shoulder", "left_elbow", 0.172),
    ("right_shoulder", "right_elbow", 0.172),
    ("left_elbow", "left_wrist", 0.150),
    ("right_elbow", "right_wrist", 0.150),
)
# The torso is so long as a share of the stature.
_TORSO = 0.295
STATURE_M = 1.73
"""Of a grown-up; 95 % are within 17 % of it (NCD-RisC 2016, men and women together)."""

# Two in three grown-ups have a stature within this logarithm of the usual one, and are not odd.
_USUAL_SIZE = 0.08
# Statures of grown-ups have this standard deviation of their logarithm.
_SIZE_SIGMA = 0.09
# Two moments farther apart than this do not tell the direction in which somebody walks.
_WALK_NS = 1_000_000_000
# Somebody who is slower than this over the flight does not walk.
_LEAST_PACE_MPS = 0.3
# People run no faster than this.
_FASTEST_MPS = 6.0
# Lying, bending down and cartwheels are rare, and count at most so much.
_LYING = 1.2
# A body at a smaller cosine against the vertical is not that of somebody who walks.
_WALKING = 0.7
# Somebody who walks in a smaller share of the moments lies down, or turns cartwheels.
_WALKING_SHARE = 0.8
# A body at a smaller cosine against the vertical is head down.
_HEAD_DOWN = -0.3
# Two parts of a limb at a smaller cosine are clearly bent.
_BENT_COSINE = np.cos(np.radians(30))
# A joint that bends at a smaller cosine against forwards may bend to the side.
_CLEARLY = 0.5
# An upper arm at a smaller cosine against downwards does not hang.
_HANGING = 0.5


class Oddity(NamedTuple):
    """Deviation of one thing about the person from what is usual."""

    sigmas: float  # in its own standard deviations
    evidence: Mapping[str, float]  # what was measured


def stature_m(joints: Float) -> float:
    """Return a person's stature from their joints [T, J, 3]; NaN if too few limbs are seen."""
    return median(Body(joints).statures)


def size_sigmas(joints: Float) -> float:
    """Return how far a person's stature is from a grown-up's, in standard deviations; 0 if unknown."""
    stature = stature_m(joints)
    return float(np.log(stature / STATURE_M)) / _SIZE_SIGMA if np.isfinite(stature) else 0.0


@np.errstate(invalid="ignore", divide="ignore")
def trunk_direction(joints: Float) -> Float:
    """Return the mean [3] of the unit vectors from hips to shoulders; it is shorter if they vary."""
    body = Body(joints)
    trunk = body.shoulders - body.hips
    trunk = trunk / np.linalg.norm(trunk, axis=-1, keepdims=True)
    known = trunk[np.isfinite(trunk).all(axis=-1)]
    mean: Float = known.mean(axis=0) if len(known) > _FEWEST_MOMENTS else np.full(3, np.nan)
    return mean


class Body:
    """The joints of a person [T, J, 3] by name."""

    def __init__(self, joints: Float) -> None:
        self.joints = joints
        self.hips = (self["left_hip"] + self["right_hip"]) / 2
        self.shoulders = (self["left_shoulder"] + self["right_shoulder"]) / 2
        self.ankles = (self["left_ankle"] + self["right_ankle"]) / 2
        upwards = self.shoulders - self.ankles
        # Of the body, against the vertical.
        self.cosine: Float = upwards[:, 2] / np.linalg.norm(upwards, axis=-1)

    def __getitem__(self, name: str) -> Float:
        joint: Float = self.joints[:, _INDEX[name]]
        return joint

    @cached_property
    def lengths(self) -> list[tuple[Float, float]]:
        """List the lengths [T] m of limbs and torso, and their usual shares of the stature."""
        limbs = [(np.linalg.norm(self[start] - self[end], axis=-1), share) for start, end, share in _LIMBS]
        return [*limbs, (np.linalg.norm(self.hips - self.shoulders, axis=-1), _TORSO)]

    @cached_property
    def statures(self) -> Float:
        """Return the stature that each limb is usual for."""
        statures: Float = np.array([median(length) / share for length, share in self.lengths])
        return statures

    def proportions(self, stature: float) -> dict[str, Oddity]:
        """Measure the size, and the limbs' lengths over those that are usual for a stature in m."""
        names = [f"{start}_to_{end}" for start, end, _ in _LIMBS] + ["torso"]
        off = np.abs(np.log(self.statures / stature))  # infinite for a limb without length
        worst = int(np.nanargmax(off))
        length, share = self.lengths[worst]
        measured = {f"{names[worst]}_m": median(length), "usual_m": share * stature}
        beyond = max(0.0, abs(np.log(stature / STATURE_M)) - _USUAL_SIZE)
        return {
            "size": Oddity(beyond / _SIZE_SIGMA, {"stature_m": stature}),
            "shape": Oddity(min(float(np.nanmedian(off)), 5.0) / 0.10, measured),
        }

    def posture(self) -> dict[str, Oddity]:
        """Measure how upright the person is, where the face is, and on which sides and how the limbs are."""
        cosine = self.cosine
        middle = median(cosine)
        lean = {"lean_deg": float(np.degrees(np.arccos(middle)))}
        leaning, head_down = min((1 - middle) / 0.15, _LYING), max(0.0, _HEAD_DOWN - middle) / 0.05
        same_sides, bent = self._same_sides(), self._bent_as_people()
        odd = {
            "upright": Oddity(leaning + head_down, lean),
            "wander": Oddity(min(median(np.abs(cosine - middle)) / 0.1, _LYING), lean),
            "crossed": Oddity(max(0.0, 0.5 - same_sides) / 0.03, {"uncrossed_share": same_sides}),
            "bend": Oddity(max(0.0, 0.4 - bent) / 0.06, {"bent_forwards_share": bent}),
        }
        forwards = self._forwards
        nose = ((self["nose"] - (self["left_ear"] + self["right_ear"]) / 2) * forwards).sum(axis=-1)
        nose = nose[np.isfinite(nose)]
        if len(nose) > _FEWEST_MOMENTS:
            ahead = float((nose > 0).mean())
            odd["face"] = Oddity(max(0.0, 0.6 - ahead) / 0.06, {"nose_in_front_share": ahead})
        return odd

    def _bent_as_people(self) -> float:
        """Return the least share of bent knees, or of bent elbows of hanging arms, that bend as people's do.

        A knee is ahead of the line from hip to ankle, an elbow behind that from shoulder to wrist. What is
        hardly bent, or bent sideways, does not count; 1 where few are bent.
        """
        upwards, forwards = (
            each / np.linalg.norm(each, axis=-1, keepdims=True)
            for each in (self.shoulders - self.hips, self._forwards)
        )
        shares = []
        for root, middle, tip, sign in (("hip", "knee", "ankle", 1), ("shoulder", "elbow", "wrist", -1)):
            right: list[Bool] = []
            for side in ("left", "right"):
                upper = self[f"{side}_{middle}"] - self[f"{side}_{root}"]
                lower = self[f"{side}_{tip}"] - self[f"{side}_{middle}"]
                upper_m, lower_m = np.linalg.norm(upper, axis=-1), np.linalg.norm(lower, axis=-1)
                line = (upper + lower) / np.linalg.norm(upper + lower, axis=-1, keepdims=True)
                apex = upper - (upper * line).sum(axis=-1, keepdims=True) * line
                ahead = sign * (apex * forwards).sum(axis=-1) / np.linalg.norm(apex, axis=-1)
                counts = (upper * lower).sum(axis=-1) / (upper_m * lower_m) < _BENT_COSINE
                counts &= np.abs(ahead) > _CLEARLY
                if middle == "elbow":
                    counts &= -(upper * upwards).sum(axis=-1) / upper_m > _HANGING
                right.append(ahead[counts] > 0)
            if sum(map(len, right)) > _FEWEST_MOMENTS:
                shares.append(float(np.concatenate(right).mean()))
        return min(shares, default=1.0)

    def _same_sides(self) -> float:
        """Return the least share of moments in which two pairs of joints have left and right on one side."""
        across = {
            joint: self[f"right_{joint}"] - self[f"left_{joint}"]
            for joint in ("shoulder", "elbow", "hip", "knee")
        }
        along = [
            finite((across[one] * across[other]).sum(axis=-1))
            for one, other in (("shoulder", "elbow"), ("hip", "knee"), ("shoulder", "hip"))
        ]
        return min((float((each > 0).mean()) for each in along if each.size > _FEWEST_MOMENTS), default=1.0)

    @cached_property
    def _forwards(self) -> Float:
        """Return a vector [T, 3] to where the hips face, also of somebody who lies or is on their head."""
        upwards = self.shoulders - self.hips
        upwards /= np.linalg.norm(upwards, axis=-1, keepdims=True)
        forwards: Float = np.cross(upwards, self["right_hip"] - self["left_hip"])
        return forwards

    def motion(self, flight: Sampled, stature: float, white_m: float, keypoint_m: float) -> dict[str, Oddity]:
        """Say how oddly the person moves: not forwards, faster than people, or with a foot that slides.

        Args:
            flight: the flight.
            stature: m.
            white_m: by how much pose errors that are new in every pose move the person.
            keypoint_m: by how much keypoints' errors move a joint.
        """
        step_s = STEP_NS / 1e9
        noise = np.sqrt(2) * white_m / step_s  # m/s
        moved = (self.hips[flight.second] - self.hips[flight.first]) / step_s
        pace = np.linalg.norm(moved[:, :2], axis=-1)
        feet = [
            np.linalg.norm(self[name][flight.second] - self[name][flight.first], axis=-1) / step_s
            for name in ("left_ankle", "right_ankle")
        ]
        of_foot = float(np.hypot(noise, np.sqrt(2) * keypoint_m / step_s))
        climbed, slid = median(np.abs(moved[:, 2])), median(np.minimum(*feet))
        fast, ahead = quantile(pace, 0.75), self._ahead(flight, white_m)
        slides = max(0.0, slid - 0.4 * stature / 1.7 - of_foot) / (0.5 + of_foot / 2)
        return {
            "course": Oddity(max(0.0, 0.5 - ahead) / 0.15, {"course_cosine": ahead}),
            "speed": Oddity(max(0.0, fast - 4.0 - 1.5 * noise) / (2 + noise), {"pace_mps": fast}),
            "climb": Oddity(max(0.0, climbed - 0.5 - noise) / (0.5 + noise / 2), {"climb_mps": climbed}),
            "slide": Oddity(slides, {"foot_mps": slid}),
        }

    def _ahead(self, flight: Sampled, white_m: float) -> float:
        """Return the cosine of where the person walks, over the flight, against where they face.

        It is 1 of somebody who hardly walks, or is not upright most of the time.
        """
        first = np.arange(len(flight.t_ns))
        second = np.searchsorted(flight.t_ns, flight.t_ns + _WALK_NS, side="right") - 1
        step_s = (flight.t_ns[second] - flight.t_ns[first]) / 1e9
        forwards = (self._forwards[first] + self._forwards[second])[:, :2]
        forwards /= np.linalg.norm(forwards, axis=1, keepdims=True)
        moved = (self.hips[second] - self.hips[first])[:, :2]
        along = (moved * forwards).sum(axis=1)
        across = forwards[:, 0] * moved[:, 1] - forwards[:, 1] * moved[:, 0]
        # Steps weigh by their squared length in time, as those of equal noise do; none faster than people.
        known = np.isfinite(along) & (np.hypot(along, across) < _FASTEST_MPS * step_s + 3 * white_m)
        # Only somebody who is upright walks: a cartwheel leads sideways, and lying down often backwards.
        walks = self.cosine * np.sign(median(self.cosine)) > _WALKING
        if walks.sum() < _WALKING_SHARE * np.isfinite(self.cosine).sum():
            return 1.0
        known &= walks[first] & walks[second]
        weight = float((step_s[known] ** 2).sum())
        if not weight:
            return 1.0
        ahead, aside = (float((part * step_s)[known].sum()) / weight for part in (along, across))
        pace = float(np.hypot(ahead, aside))
        return ahead / pace if pace > _LEAST_PACE_MPS + 3 * white_m * np.sqrt(2 / weight) else 1.0


def finite(values: Float) -> Float:
    """Return the finite values."""
    known: Float = values[np.isfinite(values)]
    return known


def quantile(values: Float, share: float) -> float:
    """Return a quantile of what is finite."""
    ordered = np.sort(finite(values))
    return float(ordered[int(share * (ordered.size - 1))]) if ordered.size else float("nan")
