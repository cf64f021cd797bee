"""Score of a scene: how well it fits itself, and how much its people are people.

Lower is better. A score adds three things:

- the distances of rays from the joints that they make, over what keypoints and poses are stated to err by;
- how odd the body, its place and its motion are, each against what is published of people;
- the scatter of two cameras' rays within one picture, after a constant error of each pose was fitted with
  its stated standard deviation as prior. Clocks and wrong conventions leave it, constant errors do not.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.reconstruction.doubts.kernels import distances_of, joints_of
from pipelines.reconstruction.doubts.scene import JOINTS, STEP_NS, Sampled, SceneOfMoments

IMPOSSIBLE = 99.0
"""Score of a scene in which next to nothing is seen by two cameras."""

_INDEX = {name: index for index, name in enumerate(JOINTS)}
# Good keypoints err by this much at least.
_KEYPOINT_PX = 3.0
# Keypoints err by this share of the size of the person in the picture.
_KEYPOINT_SHARE = 0.015
_CHI2_MEDIAN = {1: 0.455, 3: 0.789, 5: 0.870}  # median of chi^2 over its degrees of freedom, by those
# With more degrees of freedom, the median of chi-square over them is about this.
_CHI2_MEDIAN_MORE = 0.9
# A joint that is farther away does not tell how far stated errors move it.
_FARTHEST_M = 30.0
# Joints seen in fewer moments do not tell on which side they are.
_FEWEST_MOMENTS = 20
# With fewer joints that two cameras see in all moments nothing can be said.
_FEWEST = 60

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

# Ankles of somebody who stands are this high above the ground.
_ANKLE_ABOVE_GROUND_M = 0.08
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
# Rays that miss each other by more standard deviations cannot be used.
_UNUSED_SIGMAS = 4.0
# Right flights have less than 0.01 of joints that cannot be used.
_USUALLY_UNUSED = 0.2
# Two parts of a limb at a smaller cosine are clearly bent.
_BENT_COSINE = np.cos(np.radians(30))
# A joint that bends at a smaller cosine against forwards may bend to the side.
_CLEARLY = 0.5
# An upper arm at a smaller cosine against downwards does not hang.
_HANGING = 0.5
# Ground that no map shows is no steeper than this.
_SLOPE = 0.3
# Half of a body is this long: turning it moves its ends by the angle times that.
_HALF_BODY_M = 0.5
# The scatter of rays counts this much beside what is odd about a person.
SCATTER_WEIGHT = 12.0
SCATTER_RANGE = (0.4, 30.0)  # what is less is no better: keypoints scatter by themselves


class Oddity(NamedTuple):
    """Deviation of one thing about the person from what is usual."""

    sigmas: float  # in its own standard deviations
    evidence: Mapping[str, float]  # what was measured


class Score(NamedTuple):
    """The score of a scene, and what it is made of."""

    total: float
    misfit: float  # of rays, standard deviations
    scatter: float  # of rays within pictures, over the pixel noise
    odd: dict[str, Oddity]
    stature_m: float


class Base(NamedTuple):
    """The described scene, against which others are scored."""

    total: float
    scatter: float
    covered: float  # share of joints and moments that two cameras see


class SolvedJoints(NamedTuple):
    """Joints of a scene."""

    joints: Float  # [T, J, 3] m; NaN where fewer than two cameras see one
    chi2: Float  # [T, J]
    views: Int64  # [T, J] how many cameras see it
    in_front: Bool  # [T, J]
    direction: Float  # [C, T, J, 3] unit rays in the world
    seen: Bool  # [C, T, J]
    depth: Float  # [C, T, J] m


def solve(scene: SceneOfMoments) -> SolvedJoints:
    """Triangulate by least squares of distances to rays, weighted by what keypoints and poses err by."""
    angle2 = pixel_variance(scene) / scene.focal_px**2 + scene.sigma[:, 1] ** 2
    arrays = (scene.rays, scene.rotation, scene.position, angle2, scene.sigma[:, 0] ** 2)
    return SolvedJoints(*joints_of(*(np.ascontiguousarray(array, dtype=np.float64) for array in arrays)))


def pixel_variance(scene: SceneOfMoments) -> Float:
    """Return the variance [C] px^2 of keypoints: it grows with the person in the picture."""
    variance: Float = _KEYPOINT_PX**2 + (_KEYPOINT_SHARE * scene.person_px) ** 2
    return variance


@np.errstate(invalid="ignore", divide="ignore")
def score(
    flight: Sampled,
    scene: SceneOfMoments,
    base: Base | None = None,
    *,
    same_scatter: bool = False,
    limit: float = np.inf,
) -> Score:
    """Score a scene.

    Args:
        flight: its flight.
        scene: the scene.
        base: the scene as described; None if it is that.
        same_scatter: True where a hypothesis can only seem to change the scatter, as a unit of lengths does.
        limit: a score above it need not be exact: what takes time is left out once that is certain.
    """
    solved = solve(scene)
    good = solved.views >= 2
    if good.sum() < _FEWEST or (base is not None and good.mean() < 0.4 * base.covered):
        return Score(IMPOSSIBLE, np.inf, np.inf, {}, np.nan)
    misfit = _misfit(solved, good)
    # Two cameras have one draw of constant errors between them: chi^2 of few.
    soft = 2.0 if len(scene.focal_px) == 2 else 1.5
    share_behind = 1 - float(solved.in_front[good].mean())
    behind = Oddity(share_behind / 0.05, {"behind_share": share_behind})
    total = float(2 * np.log1p((misfit / soft) ** 2) + np.log1p(behind.sigmas**2))
    reference = None if base is None or same_scatter else base.scatter
    gain = 0.0 if reference is None else SCATTER_WEIGHT * np.log(reference / SCATTER_RANGE[0])
    if total - gain > limit:
        return Score(total, misfit, np.inf, {"behind": behind}, np.nan)
    scatter = _scatter(scene, solved)
    if reference is not None:
        total += SCATTER_WEIGHT * float(np.log(np.clip(scatter, *SCATTER_RANGE) / reference))
        if total > limit:
            return Score(total, misfit, scatter, {"behind": behind}, np.nan)
    person = _person(flight, scene, solved)
    if person is None:
        return Score(IMPOSSIBLE, misfit, np.inf, {}, np.nan)
    odd = {"parallax": _parallax(solved), "unused": _unused(solved, good, misfit)} | person.odd
    sigmas = [each.sigmas for each in odd.values() if np.isfinite(each.sigmas)]
    total += sum(float(np.log1p(min(value, 50.0) ** 2)) for value in sigmas)
    odd["behind"] = behind
    return Score(total, misfit, scatter, odd, person.stature_m)


def base_of(flight: Sampled, scene: SceneOfMoments) -> tuple[Base, Score]:
    """Score the scene as described; other scenes are scored against it."""
    described = score(flight, scene)
    scatter = float(np.clip(described.scatter, *SCATTER_RANGE))
    covered = float((solve(scene).views >= 2).mean())
    return Base(described.total, scatter, covered), described


def _misfit(solved: SolvedJoints, good: Bool) -> float:
    """Return the root of the median chi^2 over its freedom: 1 where all is as stated."""
    freedom = 2 * solved.views - 3
    total, count = 0.0, 0
    for value in np.unique(freedom[good]):
        among = good & (freedom == value)
        usual = _CHI2_MEDIAN.get(int(value), _CHI2_MEDIAN_MORE)
        total += among.sum() * float(np.median(solved.chi2[among])) / value / usual
        count += int(among.sum())
    return float(np.sqrt(total / count))


def _unused(solved: SolvedJoints, good: Bool, misfit: float) -> Oddity:
    """Measure the share of joints whose rays miss each other by far more than usual: gates reject them."""
    freedom = 2 * solved.views[good] - 3
    gate = (_UNUSED_SIGMAS * max(misfit, 1.0)) ** 2
    share = float((solved.chi2[good] > gate * freedom).mean())
    return Oddity(max(0.0, share - _USUALLY_UNUSED) / 0.05, {"unused_share": share})


def _parallax(solved: SolvedJoints) -> Oddity:
    """Say how far the best pair of cameras is from seeing a person from two sides (0.1 rad)."""
    best = 0.0
    for one, other in combinations(range(len(solved.seen)), 2):
        both = solved.seen[one] & solved.seen[other]
        if both.any():
            cosine = (solved.direction[one][both] * solved.direction[other][both]).sum(axis=-1)
            sine = np.sqrt(np.maximum(0.0, 1.0 - cosine**2))
            best = max(best, _median(sine))
    return Oddity(max(0.0, 0.1 / max(best, 1e-4) - 1), {"parallax_deg": float(np.degrees(np.arcsin(best)))})


def _scatter(scene: SceneOfMoments, solved: SolvedJoints) -> float:
    """Return the scatter of two cameras' rays within pictures over their noise, mean over the pairs."""
    variance = pixel_variance(scene) / scene.focal_px**2
    distance = np.clip(np.abs(solved.depth), 1e-4, 1e5)
    found = [
        _scatter_of_pair(scene, solved, distance, variance, pair)
        for pair in combinations(range(len(scene.focal_px)), 2)
    ]
    known = [value for value in found if value is not None]
    return float(np.mean(known)) if known else 9.0


def _scatter_of_pair(
    scene: SceneOfMoments, solved: SolvedJoints, distance: Float, variance: Float, pair: tuple[int, int]
) -> float | None:
    """Fit constant errors of both poses to the rays' distances, and measure what they leave."""
    both = list(pair)
    used, apart, design = distances_of(
        solved.direction[both],
        solved.seen[both],
        scene.position[both],
        scene.rotation[both],
        distance[both],
        scene.sigma[both, :2],
    )
    if used.sum() < _FEWEST:
        return None
    # What is new in every pose turns the person in the picture, besides moving them.
    white2 = _HALF_BODY_M**2 * scene.sigma[:, 3] ** 2
    noise2 = [
        distance[camera] ** 2 * variance[camera]
        + white2[camera]
        + (_HALF_BODY_M * scene.sigma[camera, 2] / np.maximum(distance[camera], 1.0)) ** 2
        for camera in pair
    ]
    noise = np.sqrt(_median((noise2[0] + noise2[1])[used]))
    design, apart = np.nan_to_num(design[used]), np.nan_to_num(apart[used])
    share = used.shape[0] / len(apart)  # a picture is one observation of a constant error
    weight = np.ones(len(apart))
    for _ in range(3):
        weighted = design * (weight * share / noise**2)[:, None]
        constant = np.linalg.solve(weighted.T @ design + np.eye(design.shape[1]), weighted.T @ apart)
        left = apart - design @ constant
        weight = 1 / np.maximum(np.abs(left) / (1.5 * noise), 1.0)
    residual = np.full(used.shape, np.nan)
    residual[used] = left
    middle = _median_of_rows(residual)
    return float(1.48 * _median(np.abs(residual - middle[:, None])[used]) / noise)


def _median_of_rows(values: Float) -> Float:
    """Return the median of each row [T], NaN where nothing is finite; nanmedian is slow on small arrays."""
    ordered = np.sort(values, axis=1)  # NaN last
    count = np.isfinite(values).sum(axis=1)
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    row = np.arange(len(values))
    high = np.minimum(high, values.shape[1] - 1)
    middle: Float = np.where(count > 0, (ordered[row, low] + ordered[row, high]) / 2, np.nan)
    return middle


class _ScoredPerson(NamedTuple):
    odd: dict[str, Oddity]
    stature_m: float


def _person(flight: Sampled, scene: SceneOfMoments, solved: SolvedJoints) -> _ScoredPerson | None:
    """Say how odd the person is; None if too few limbs are seen, or most have no length."""
    body = _ScoredBody(solved.joints)
    lengths = body.lengths()
    statures = _statures(lengths)
    if np.isfinite(statures).sum() < 5 or not np.nanmedian(statures) > 0:
        return None
    stature = float(np.nanmedian(statures))
    odd = {
        "size": Oddity(max(0.0, abs(np.log(stature / STATURE_M)) - 0.08) / 0.09, {"stature_m": stature}),
        "shape": _shape(lengths, stature),
        "unposed": _unposed(scene),
    }
    odd |= body.posture()
    far_m = _distances(solved)
    # The cameras that see a joint change, and with them the errors that they have in common.
    limp = float(np.nanmedian([_spread(length) for length, _ in lengths]))
    usual = 0.10 + 0.5 * _moved_by(scene.sigma[:, :2], far_m)
    odd["limp"] = Oddity(limp / usual, {"limb_spread": limp})
    keypoint_m = float(np.sqrt(np.mean(pixel_variance(scene)) * np.mean((far_m / scene.focal_px) ** 2)))
    odd |= body.motion(flight, stature, _moved_by(scene.sigma[:, 2:4], far_m), keypoint_m)
    odd |= _place(flight, scene, body, far_m)
    return _ScoredPerson(odd, stature)


def _statures(lengths: list[tuple[Float, float]]) -> Float:
    """Return the stature that each limb is usual for."""
    statures: Float = np.array([_median(length) / share for length, share in lengths])
    return statures


def stature_m(joints: Float) -> float:
    """Return a person's stature from their joints [T, J, 3]; NaN if too few limbs are seen."""
    return _median(_statures(_ScoredBody(joints).lengths()))


@np.errstate(invalid="ignore", divide="ignore")
def trunk_direction(joints: Float) -> Float:
    """Return the mean [3] of the unit vectors from hips to shoulders; it is shorter if they vary."""
    body = _ScoredBody(joints)
    trunk = body.shoulders - body.hips
    trunk = trunk / np.linalg.norm(trunk, axis=-1, keepdims=True)
    known = trunk[np.isfinite(trunk).all(axis=-1)]
    mean: Float = known.mean(axis=0) if len(known) > _FEWEST_MOMENTS else np.full(3, np.nan)
    return mean


def _shape(lengths: list[tuple[Float, float]], stature: float) -> Oddity:
    """Measure the limbs' proportions: the lengths of limbs over those that are usual for a stature in m."""
    names = [f"{start}_to_{end}" for start, end, _ in _LIMBS] + ["torso"]
    off = np.abs(np.log(_statures(lengths) / stature))  # infinite for a limb without length
    worst = int(np.nanargmax(off))
    length, share = lengths[worst]
    measured = {f"{names[worst]}_m": _median(length), "usual_m": share * stature}
    return Oddity(min(float(np.nanmedian(off)), 5.0) / 0.10, measured)


def _unposed(scene: SceneOfMoments) -> Oddity:
    """Measure the share of moments with a person in the picture and no pose, of the camera with the most."""
    seen = np.isfinite(scene.rays[..., 0]).any(axis=-1)
    posed = np.isfinite(scene.position).all(axis=-1)
    share = float((seen & ~posed).mean(axis=1).max())
    return Oddity(min(0.2, share) / 0.05, {"unposed_share": share})


class _ScoredBody:
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

    def lengths(self) -> list[tuple[Float, float]]:
        """List the lengths [T] m of limbs and torso, and their usual shares of the stature."""
        limbs = [(np.linalg.norm(self[start] - self[end], axis=-1), share) for start, end, share in _LIMBS]
        return [*limbs, (np.linalg.norm(self.hips - self.shoulders, axis=-1), _TORSO)]

    def posture(self) -> dict[str, Oddity]:
        """Measure how upright the person is, where the face is, and on which sides and how the limbs are."""
        cosine = self.cosine
        middle = _median(cosine)
        lean = {"lean_deg": float(np.degrees(np.arccos(middle)))}
        leaning, head_down = min((1 - middle) / 0.15, _LYING), max(0.0, _HEAD_DOWN - middle) / 0.05
        same_sides, bent = self._same_sides(), self._bent_as_people()
        odd = {
            "upright": Oddity(leaning + head_down, lean),
            "wander": Oddity(min(_median(np.abs(cosine - middle)) / 0.1, _LYING), lean),
            "crossed": Oddity(max(0.0, 0.5 - same_sides) / 0.03, {"uncrossed_share": same_sides}),
            "bend": Oddity(max(0.0, 0.4 - bent) / 0.06, {"bent_forwards_share": bent}),
        }
        forwards = self._forwards()
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
            for each in (self.shoulders - self.hips, self._forwards())
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
            _finite((across[one] * across[other]).sum(axis=-1))
            for one, other in (("shoulder", "elbow"), ("hip", "knee"), ("shoulder", "hip"))
        ]
        return min((float((each > 0).mean()) for each in along if each.size > _FEWEST_MOMENTS), default=1.0)

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
        climbed, slid = _median(np.abs(moved[:, 2])), _median(np.minimum(*feet))
        fast, ahead = _quantile(pace, 0.75), self._ahead(flight, white_m)
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
        forwards = (self._forwards()[first] + self._forwards()[second])[:, :2]
        forwards /= np.linalg.norm(forwards, axis=1, keepdims=True)
        moved = (self.hips[second] - self.hips[first])[:, :2]
        along = (moved * forwards).sum(axis=1)
        across = forwards[:, 0] * moved[:, 1] - forwards[:, 1] * moved[:, 0]
        # Steps weigh by their squared length in time, as those of equal noise do; none faster than people.
        known = np.isfinite(along) & (np.hypot(along, across) < _FASTEST_MPS * step_s + 3 * white_m)
        # Only somebody who is upright walks: a cartwheel leads sideways, and lying down often backwards.
        walks = self.cosine * np.sign(_median(self.cosine)) > _WALKING
        if walks.sum() < _WALKING_SHARE * np.isfinite(self.cosine).sum():
            return 1.0
        known &= walks[first] & walks[second]
        weight = float((step_s[known] ** 2).sum())
        if not weight:
            return 1.0
        ahead, aside = (float((part * step_s)[known].sum()) / weight for part in (along, across))
        pace = float(np.hypot(ahead, aside))
        return ahead / pace if pace > _LEAST_PACE_MPS + 3 * white_m * np.sqrt(2 / weight) else 1.0


def _distances(solved: SolvedJoints) -> Float:
    """Return the median distance [C] m of the joints from each camera."""
    far = [_median(np.abs(depth[seen])) for depth, seen in zip(solved.depth, solved.seen, strict=True)]
    near_enough: Float = np.minimum(np.nan_to_num(np.array(far), nan=10.0), _FARTHEST_M)
    return near_enough


def _moved_by(sigma: Float, far_m: Float) -> float:
    """Return by how much errors of poses, position m and rotation rad [C, 2], move a person at a distance."""
    return float(np.sqrt(np.mean(sigma[:, 0] ** 2 + (far_m * sigma[:, 1]) ** 2)))


def _place(flight: Sampled, scene: SceneOfMoments, body: _ScoredBody, far_m: Float) -> dict[str, Oddity]:
    """Measure how far the person is from where people are: under drones, on the ground, at the actor."""
    odd: dict[str, Oddity] = {}
    stated_m, white_m = _moved_by(scene.sigma[:, :2], far_m), _moved_by(scene.sigma[:, 2:4], far_m)
    if not all(camera.static for camera in flight.cameras):
        above_m = _median(body.hips[:, 2]) - _median(scene.position[..., 2])
        odd["above"] = Oddity(max(0.0, above_m) / 2.0, {"above_m": above_m})
    if flight.ground is not None:
        foot = np.fmin(body["left_ankle"][:, 2], body["right_ankle"][:, 2])
        under = flight.ground.under(body.hips)
        on_map = np.isfinite(under)
        known = np.isfinite(body.hips[:, 0]).sum()
        if on_map.sum() < 0.5 * known:
            odd["beside"] = Oddity(6.0, {"on_map_share": float(on_map.sum() / max(known, 1))})
        else:
            height_m = _median((foot - under)[on_map]) - _ANKLE_ABOVE_GROUND_M
            above = max(0.0, abs(height_m) - 0.25 - 2 * stated_m) / 0.25
            odd["ground"] = Oddity(above, {"feet_above_ground_m": height_m})
    else:
        odd["level"] = _level(body, white_m)
    if flight.hips is not None and np.isfinite(flight.hips[:, 0]).any():
        apart = body.hips - flight.hips
        constant = np.array([_median(apart[:, axis]) for axis in range(3)])
        apart_m = float(np.linalg.norm(constant))
        path_m = _median(np.linalg.norm(apart - constant, axis=-1))
        odd["actor"] = Oddity(max(0.0, apart_m - 0.25 - 2 * stated_m) / 0.4, {"from_actor_m": apart_m})
        odd["actor_path"] = Oddity(max(0.0, path_m - 0.45 - 2 * white_m) / 0.3, {"path_apart_m": path_m})
    return {name: each for name, each in odd.items() if np.isfinite(each.sigmas)}


def _level(body: _ScoredBody, white_m: float) -> Oddity:
    """Measure by how much the lowest joint rises above its lowest level, more than slopes excuse."""
    lowest = np.fmin.reduce(body.joints[..., 2], axis=1)
    rise_m = _quantile(lowest, 0.9) - _quantile(lowest, 0.1)
    walked_m = float(np.linalg.norm([_quantile(xy, 0.95) - _quantile(xy, 0.05) for xy in body.hips[:, :2].T]))
    excused_m = 0.5 + _SLOPE * walked_m + 3 * white_m
    return Oddity(max(0.0, rise_m - excused_m) / 0.3, {"rise_m": rise_m, "walked_m": walked_m})


def _finite(values: Float) -> Float:
    finite: Float = values[np.isfinite(values)]
    return finite


def _median(values: Float) -> float:
    """Return the median of what is finite; `np.median` is slow on small arrays."""
    ordered = np.sort(_finite(values))
    if not ordered.size:
        return float("nan")
    return float(ordered[(ordered.size - 1) // 2] + ordered[ordered.size // 2]) / 2


def _quantile(values: Float, share: float) -> float:
    finite = np.sort(_finite(values))
    return float(finite[int(share * (finite.size - 1))]) if finite.size else float("nan")


def _spread(values: Float) -> float:
    """Return the standard deviation of a length over its median, from its quartiles."""
    return 0.74 * (_quantile(values, 0.75) - _quantile(values, 0.25)) / max(_median(values), 1e-9)


def residual_px(scene: SceneOfMoments, solved: SolvedJoints) -> float:
    """Return the median distance (px) of keypoints from the joints that were triangulated from them."""
    return round(_median(_residuals_px(scene, solved)), 2)


def residuals_px(scene: SceneOfMoments, solved: SolvedJoints) -> list[float]:
    """Return the same of each camera."""
    return [round(_median(each), 2) for each in _residuals_px(scene, solved)]


def _residuals_px(scene: SceneOfMoments, solved: SolvedJoints) -> Float:
    toward = solved.joints[None] - np.nan_to_num(scene.position)[:, :, None, :]
    with np.errstate(invalid="ignore", divide="ignore"):
        across = np.linalg.norm(np.cross(solved.direction, toward), axis=-1) / np.abs(solved.depth)
    return np.where(solved.seen, across * scene.focal_px[:, None, None], np.nan)
