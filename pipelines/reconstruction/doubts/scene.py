"""A flight sampled at a few moments: whom each camera saw, from where, and how surely.

Every alternative to the flight's description is another scene of the same moments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.cameras import undistort
from pipelines.geometry.noise import WHITE_SHARE, Drift, GaussMarkov, NoiseModel, White
from pipelines.geometry.poses import interpolate_points
from pipelines.geometry.rig import unit
from pipelines.reconstruction.observations import UNSTATED, Camera, Filmed, PoseSigma
from pipelines.session.camera_poses import stated_models
from pipelines.session.description import CameraEntry, Description, Interpolation
from pipelines.session.people import LoggedActor
from pipelines.session.records import Occupancy

JOINTS = (
    *("nose", "left_ear", "right_ear"),
    *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
    *("left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle"),
)
"""The joints that are looked at; every skeleton of people has most of them."""

HIPS = [JOINTS.index("left_hip"), JOINTS.index("right_hip")]
"""The indices of the hips among them."""

MOMENTS = 60
"""Moments of the flight that are looked at, in pairs 0.1 s apart."""

# Between the two moments of a pair, for speeds.
_STEP_NS = 100_000_000
# The logged hips of an actor err by this much.
PLACED_M = 0.3
# Errors of a logged actor wander, and count as so many independent ones.
FEW = 3
_CALIBRATED = (0.003, 0.001, 0.0, 0.0, 0.0, 0.0)  # of a still camera
# A keypoint is interpolated over at most this time between two pictures.
_LONGEST_GAP_NS = 250_000_000
# A person chosen in a smaller share of the pictures with people is not the one to judge by.
_CHOSEN_SHARE = 0.5


@dataclass(frozen=True)
class SceneOfMoments:
    """View of C cameras at T moments, and what else is logged of these."""

    t_ns: Int64  # [T] moments; those of a pair follow each other in `first` and `second`
    first: Int64  # [T / 2] index of the first moment of each pair
    second: Int64  # [T / 2]
    hips: Float | None  # [T, 3] m, logged; None without a logged actor
    ground: GroundOfMap | None
    rays: Float  # [C, T, J, 2] normalised image coordinates; NaN where nothing was seen
    position: Float  # [C, T, 3] m
    rotation: Float  # [C, T, 3, 3] world_from_camera
    focal_px: Float  # [C]
    sigma: Float  # [C, 6] as `PoseSigma`
    person_px: Float  # [C] height of the person in the pictures, median
    unposed: Float  # [C] share of a camera's pictures before or after its log; NaN of one that stands still
    stated_ns: Float  # [C, T] when the pictures that the moments show were taken, as described


class Sampled(NamedTuple):
    """A flight as a diagnosis takes it."""

    cameras: tuple[Filmed, ...]
    between: Interpolation
    t_ns: Int64  # as of a scene, and what follows
    first: Int64
    second: Int64
    hips: Float | None
    ground: GroundOfMap | None
    actor: LoggedActor | None = None
    truth_m: float | None = None  # stature of the true joints, if there are any

    def at_other_times(self, late_s: float, slower: float) -> Sampled:
        """Move the moments to where the first camera shows the same pictures, if all times are so wrong."""
        first_ns = self.cameras[0].entry.frames.first_t_ns
        t_ns = first_ns + np.rint((self.t_ns - first_ns) * slower + late_s * 1e9).astype(np.int64)
        return self._replace(t_ns=t_ns, hips=None if self.actor is None else self.actor.hips_at(t_ns))


class GroundOfMap(NamedTuple):
    """Height of the ground, the top of the lowest occupied run of every column of a map."""

    corner: Float  # [2] m
    side_m: float
    height: Float  # [X, Y] m; NaN where nothing is occupied

    @classmethod
    def of(cls, occupancy: Occupancy) -> GroundOfMap:
        """Find the ground of a map."""
        occupied = occupancy.probability > 0.5
        above = np.logical_or.accumulate(occupied, axis=2)
        free_above = np.pad(~occupied & above, ((0, 0), (0, 0), (0, 1)), constant_values=True)
        height = occupancy.origin[2] + np.argmax(free_above, axis=2) * occupancy.resolution_m
        known = np.where(occupied.any(axis=2), height, np.nan)
        return cls(np.asarray(occupancy.origin[:2], dtype=np.float64), occupancy.resolution_m, known)

    def under(self, points: Float) -> Float:
        """Return the ground's height [N] under points [N, 3]; NaN beside the map."""
        with np.errstate(invalid="ignore"):
            cell = np.floor((points[:, :2] - self.corner) / self.side_m)
            inside = np.all((cell >= 0) & (cell < self.height.shape), axis=1)
        index = np.where(inside[:, None], cell, 0).astype(np.intp)
        return np.where(inside, self.height[index[:, 0], index[:, 1]], np.nan)

    def scaled(self, factor: float) -> GroundOfMap:
        """Scale the map."""
        return GroundOfMap(factor * self.corner, factor * self.side_m, factor * self.height)

    def about(self, points: Float) -> tuple[Float, Float]:
        """Return the ground's height [N] under points [N, 3], NaN beside the map, and its error [N]."""
        return self.under(points), np.full(len(points), self.side_m)


def sample(
    cameras: Sequence[Camera],
    description: Description,
    *,
    actor: LoggedActor | None,
    last_map: Occupancy | None,
    chosen: Sequence[Int64] | None = None,
    pose_noise: str | None = None,
) -> Sampled | None:
    """Choose the moments and the person; None where the cameras share no time.

    Args:
        cameras: with their detections.
        description: session.json.
        actor: where the actor was logged.
        last_map: the map at the flight's end.
        chosen: which detection [F] of each camera's pictures the person is, -1 for none; by default the
            person whom a camera shows in most pictures.
        pose_noise: the value of `--pose-noise`, if any.
    """
    filmed = []
    for index, camera in enumerate(cameras):
        pixels = _pixels(camera, _most_seen(camera) if chosen is None else _chosen(camera, chosen[index]))
        entry, t_ns = description.cameras[camera.name], camera.frame_t_ns
        sigma = _sigma(camera, entry, pose_noise)
        filmed.append(Filmed(camera.name, camera.intrinsics, t_ns, pixels, camera, entry, sigma))
    start = max(int(camera.t_ns[0]) for camera in filmed)
    end = min(int(camera.t_ns[-1]) for camera in filmed)
    if end - start <= _STEP_NS:
        return None
    before = np.linspace(start, end - 1.1 * _STEP_NS, MOMENTS // 2).astype(np.int64)
    t_ns = np.sort(np.concatenate([before, before + _STEP_NS]))
    return Sampled(
        tuple(filmed),
        description.pose_interpolation,
        t_ns,
        np.searchsorted(t_ns, before),
        np.searchsorted(t_ns, before + _STEP_NS),
        None if actor is None else actor.hips_at(t_ns),
        None if last_map is None else GroundOfMap.of(last_map),
        actor,
    )


def _most_seen(camera: Camera) -> Int64:
    """Return the detections of the person whom the camera shows most; in their absence of the next one."""
    found = camera.detections
    number, count = np.unique(found.person, return_counts=True)
    rank = np.empty(len(number), dtype=np.intp)
    rank[np.argsort(-count, kind="stable")] = np.arange(len(number))
    order = np.lexsort((rank[np.searchsorted(number, found.person)], found.frame))
    return order[np.unique(found.frame[order], return_index=True)[1]]


def _chosen(camera: Camera, of_frame: Int64) -> Int64:
    """Return the detections that were chosen, by their rank [F]; of whom it shows most if these are few."""
    frame = np.flatnonzero(of_frame >= 0)
    if len(frame) < _CHOSEN_SHARE * len(np.unique(camera.detections.frame)):
        return _most_seen(camera)
    return np.searchsorted(camera.detections.frame, frame) + of_frame[frame]


def _pixels(camera: Camera, detection: Int64) -> Float:
    """Return the pixels [F, J, 2] of given detections, at most one of a picture."""
    found = camera.detections
    pixels = np.full((len(camera.frame_t_ns), len(JOINTS), 2), np.nan)
    for joint, name in enumerate(JOINTS):
        if name in found.joints:
            pixels[found.frame[detection], joint] = found.xy[detection, found.joints.index(name)]
    return pixels


def _sigma(camera: Camera, entry: CameraEntry, pose_noise: str | None) -> PoseSigma:
    models = stated_models(camera.name, entry, pose_noise, camera.stepped_m)
    if models is not None:
        length_s = float(np.ptp(camera.frame_t_ns)) / 1e9
        parts = sum((_variances(model, length_s) for model in models), np.zeros(6))
        return PoseSigma(*np.sqrt(parts).tolist())
    if camera.sigma is not None:
        position, rotation = np.median(camera.sigma, axis=0).tolist()
        new = float(np.sqrt(WHITE_SHARE)) * position, float(np.sqrt(WHITE_SHARE)) * rotation
        return PoseSigma(position, rotation, *new, *new)
    return PoseSigma(*(_CALIBRATED if camera.static else UNSTATED))


def _variances(model: NoiseModel, length_s: float) -> Float:
    """Return the variances [6] of a noise model in a flight, as in `PoseSigma`."""
    start_and_end, still = np.array([0.0, length_s]), np.zeros(2)
    squares = np.mean(model.marginal_sigma(start_and_end, still, still) ** 2, axis=0)
    white, varying = 0.0, 0.0
    if isinstance(model, White):
        white, varying = 1.0, 1.0
    elif isinstance(model, GaussMarkov):
        # Of the mean over a stretch: the integral of the autocorrelation.
        steps = max(length_s / model.correlation_s, 1e-6)
        varying = 1 - 2 / steps * (1 + float(np.expm1(-steps)) / steps)
    elif isinstance(model, Drift):
        varying = 1 / 3  # of the variance of a random walk, about its own mean
    return np.concatenate([squares, white * squares, varying * squares])


# --- the scene as described, and with other pixels and times -------------------------------------------


def scene_of(
    flight: Sampled,
    posed: SceneOfMoments | None = None,
    *,
    times: Mapping[int, tuple[float, float]] | None = None,
    order: tuple[int, ...] | None = None,
    pixels: list[Float] | None = None,
) -> SceneOfMoments:
    """Look at the flight's moments.

    Args:
        flight: the flight.
        posed: the scene as described, of which everything else is taken.
        times: of cameras by index, seconds added to the times of pictures, and a factor between these.
        order: whose pictures each camera has; its own by default.
        pixels: other pixels [F, J, 2] of each camera's pictures.
    """
    cameras = flight.cameras
    rays, person_px, unposed = np.empty((len(cameras), len(flight.t_ns), len(JOINTS), 2)), [], []
    moments = (flight.t_ns - flight.t_ns[0]).astype(np.float64)
    stated_ns = np.tile(moments, (len(cameras), 1))
    for index, camera in enumerate(cameras):
        source = cameras[index if order is None else order[index]]
        seen = source.pixels if pixels is None else pixels[index]
        late, factor = (times or {}).get(index, (0.0, 1.0))
        if posed is not None and seen is camera.pixels and (late, factor) == (0.0, 1.0):
            rays[index] = posed.rays[index]
            person_px.append(posed.person_px[index])
            unposed.append(posed.unposed[index])
            continue
        since = (source.t_ns - flight.t_ns[0]).astype(np.float64)
        first = float(source.entry.frames.first_t_ns - flight.t_ns[0])  # few may have been looked at
        since = first + (since - first) * factor + late * 1e9
        logged = camera.camera.trajectory.t_ns - flight.t_ns[0]
        beyond = np.maximum(logged[0] - since, since - logged[-1]) > flight.between.max_extrapolation_ns
        unposed.append(float("nan") if camera.static else float(beyond.mean()))
        stated_ns[index] = first + (moments - late * 1e9 - first) / factor
        longest_ns = max(_LONGEST_GAP_NS, 1.5 * float(np.median(np.diff(since)))) if len(since) > 1 else 0
        since_ns, at_ns = np.rint(since).astype(np.int64), flight.t_ns - flight.t_ns[0]
        at = interpolate_points(since_ns, seen, at_ns, max_gap_ns=int(longest_ns))
        rays[index] = undistort(at, camera.intrinsics)
        row = at[..., 1]
        person_px.append(median(np.fmax.reduce(row, axis=1) - np.fmin.reduce(row, axis=1)))
    poses = [] if posed else [camera.camera.poses_at(flight.t_ns, flight.between) for camera in cameras]
    position, rotation = (
        (posed.position, posed.rotation) if posed else map(np.array, zip(*poses, strict=True))
    )
    focal_px = np.array([(camera.intrinsics.fx + camera.intrinsics.fy) / 2 for camera in cameras])
    sigma, height_px = np.array([camera.sigma for camera in cameras]), np.nan_to_num(np.array(person_px))
    known = (flight.t_ns, flight.first, flight.second, flight.hips, flight.ground)
    of_cameras = (focal_px, sigma, height_px, np.array(unposed), stated_ns)
    return SceneOfMoments(*known, rays, position, rotation, *of_cameras)


def median(values: Float) -> float:
    """Return the median of what is finite; `np.median` is slow on small arrays."""
    ordered = np.sort(values[np.isfinite(values)])
    if not ordered.size:
        return float("nan")
    return float(ordered[(ordered.size - 1) // 2] + ordered[ordered.size // 2]) / 2


# --- the person ------

_INDEX = {name: index for index, name in enumerate(JOINTS)}
# Joints seen in fewer moments do not tell on which side they are.
_FEWEST_MOMENTS = 20

# Lengths of limbs over stature: Winter, Biomechanics and Motor Control of Human Movement, 4th ed., fig. 4.1,
# after Drillis and Contini 1964; from the middle of the hips to that of the shoulders for the torso.
_LIMBS = tuple(
    (f"{side}_{start}", f"{side}_{end}", share)
    for start, end, share in (
        ("hip", "knee", 0.245),
        ("knee", "ankle", 0.246),
        ("shoulder", "elbow", 0.172),
        ("elbow", "wrist", 0.150),
    )
    for side in ("left", "right")
)
# The torso is so long as a share of the stature.
_TORSO = 0.295
STATURE_M = 1.73
"""Of a grown-up; 95 % are within 17 % of it (NCD-RisC 2016, men and women together)."""

SIZE_SIGMA = 0.09
"""Standard deviation of the logarithm of grown-ups' statures."""

# Two in three grown-ups have a stature within this logarithm of the usual one, and are not odd.
_USUAL_SIZE = 0.08
# Children are small; nobody is so tall. Keypoints make people 10 % shorter to 5 % taller than they are.
_TALL_SIGMA = 0.05
# Two moments farther apart than this do not tell the direction in which somebody walks.
_WALK_NS = 1_000_000_000
# Somebody who is slower than this over the flight does not walk.
_LEAST_PACE_MPS = 0.3
# The way somebody walks is told by where they are so long before and after.
_TREAD_NS = 500_000_000
# In fewer moments, or of somebody slower, the standing foot tells nothing.
_FEWEST_TREADS, _LEAST_TREAD_MPS = 8, 0.6
# Ankles that stand roll forwards: legs go at this share of the pace.
_USUAL_TREAD = 0.92
# Runners fly between their steps, and then no foot is left behind.
_USUAL_TREAD_OF_RUNNERS = 0.72
# People run from this squared pace over stature, m/s^2: a Froude number of 0.5 (Alexander 1989).
_RUN = 2.6
# Who rides or slides is rare, and counts at most so much.
_MOST_TREAD = 3.0
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
# A nose that is nearer to the ears than this share of their distance is neither ahead nor behind.
_AHEAD_OF_EARS = 0.25
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
    return float(np.log(stature / STATURE_M)) / SIZE_SIGMA if np.isfinite(stature) else 0.0


@np.errstate(invalid="ignore", divide="ignore")
def trunk_direction(joints: Float) -> Float:
    """Return the mean [3] of the unit vectors from hips to shoulders; it is shorter if they vary."""
    trunk = Body(joints).upwards
    known = trunk[np.isfinite(trunk).all(axis=-1)]
    return known.mean(axis=0) if len(known) > _FEWEST_MOMENTS else np.full(3, np.nan)


def _dot(one: Float, other: Float) -> Float:
    return np.asarray((one * other).sum(axis=-1))


class Body:
    """The joints of a person [T, J, 3] by name."""

    def __init__(self, joints: Float) -> None:
        self.joints = joints
        self.hips = (self["left_hip"] + self["right_hip"]) / 2
        self.shoulders = (self["left_shoulder"] + self["right_shoulder"]) / 2

    def __getitem__(self, name: str) -> Float:
        return self.joints[:, _INDEX[name]]

    @cached_property
    def upwards(self) -> Float:
        """Return the unit vectors [T, 3] from the hips to the shoulders."""
        return unit(self.shoulders - self.hips)

    @cached_property
    def forwards(self) -> Float:
        """Return a vector [T, 3] to where the hips face, also of somebody who lies or is on their head."""
        return np.cross(self.upwards, self["right_hip"] - self["left_hip"])

    @cached_property
    def cosine(self) -> Float:
        """Return the cosine [T] of the body against the vertical."""
        return unit(self.shoulders - (self["left_ankle"] + self["right_ankle"]) / 2)[:, 2]

    @cached_property
    def lengths(self) -> list[tuple[Float, float]]:
        """List the lengths [T] m of limbs and torso, and their usual shares of the stature."""
        limbs = [(np.linalg.norm(self[start] - self[end], axis=-1), share) for start, end, share in _LIMBS]
        return [*limbs, (np.linalg.norm(self.hips - self.shoulders, axis=-1), _TORSO)]

    @cached_property
    def statures(self) -> Float:
        """Return the stature that each limb is usual for."""
        return np.array([median(length) / share for length, share in self.lengths])

    def proportions(self, stature: float, loose: float) -> dict[str, Oddity]:
        """Measure the size, and the limbs' lengths over those that are usual for a stature in m.

        Errors of poses change all lengths by a share `loose`.
        """
        names = [f"{start}_to_{end}" for start, end, _ in _LIMBS] + ["torso"]
        off = np.abs(np.log(self.statures / stature))  # infinite for a limb without length
        worst = int(np.nanargmax(off))
        length, share = self.lengths[worst]
        measured = {f"{names[worst]}_m": median(length), "usual_m": share * stature}
        beyond = max(0.0, abs(np.log(stature / STATURE_M)) - _USUAL_SIZE)
        sigma = _TALL_SIGMA if stature > STATURE_M else SIZE_SIGMA
        return {
            "size": Oddity(beyond / float(np.hypot(sigma, loose)), {"stature_m": stature}),
            "shape": Oddity(min(float(np.nanmedian(off)), 5.0) / 0.10, measured),
        }

    def posture(self) -> dict[str, Oddity]:
        """Measure how upright the person is, where the face is, and on which sides and how the limbs are."""
        middle = median(self.cosine)
        lean = {"lean_deg": float(np.degrees(np.arccos(middle)))}
        leaning, head_down = min((1 - middle) / 0.15, _LYING), max(0.0, _HEAD_DOWN - middle) / 0.05
        same_sides, bent = self._same_sides(), self._bent_as_people()
        odd = {
            "upright": Oddity(leaning + head_down, lean),
            "crossed": Oddity(max(0.0, 0.5 - same_sides) / 0.03, {"uncrossed_share": same_sides}),
            "bend": Oddity(max(0.0, 0.4 - bent) / 0.06, {"bent_forwards_share": bent}),
        }
        nose = _dot(self["nose"] - (self["left_ear"] + self["right_ear"]) / 2, unit(self.forwards))
        wide = np.linalg.norm(self["left_ear"] - self["right_ear"], axis=-1)
        nose = nose[np.abs(nose) > _AHEAD_OF_EARS * wide]
        if len(nose) > _FEWEST_MOMENTS:
            ahead = float((nose > 0).mean())
            odd["face"] = Oddity(max(0.0, 0.6 - ahead) / 0.06, {"nose_in_front_share": ahead})
        return odd

    def _bent_as_people(self) -> float:
        """Return the least share of bent knees, or of bent elbows of hanging arms, that bend as people's do.

        A knee is ahead of the line from hip to ankle, an elbow behind that from shoulder to wrist. What is
        hardly bent, or bent sideways, does not count; 1 where few are bent.
        """
        forwards, shares = unit(self.forwards), []
        for root, middle, tip, sign in (("hip", "knee", "ankle", 1), ("shoulder", "elbow", "wrist", -1)):
            right: list[Bool] = []
            for side in ("left", "right"):
                upper = self[f"{side}_{middle}"] - self[f"{side}_{root}"]
                lower = self[f"{side}_{tip}"] - self[f"{side}_{middle}"]
                line = unit(upper + lower)
                ahead = sign * _dot(unit(upper - _dot(upper, line)[:, None] * line), forwards)
                counts = (_dot(unit(upper), unit(lower)) < _BENT_COSINE) & (np.abs(ahead) > _CLEARLY)
                if middle == "elbow":
                    counts &= -_dot(unit(upper), self.upwards) > _HANGING
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
        pairs = (("shoulder", "elbow"), ("hip", "knee"), ("shoulder", "hip"))
        along = [_dot(across[one], across[other]) for one, other in pairs]
        known = [each[np.isfinite(each)] for each in along]
        return min((float((each > 0).mean()) for each in known if each.size > _FEWEST_MOMENTS), default=1.0)

    def motion(
        self, scene: SceneOfMoments, stature: float, white_m: float, keypoint_m: float
    ) -> dict[str, Oddity]:
        """Measure how oddly the person moves: not forwards, faster than people, or on feet that slide.

        Args:
            scene: the scene of the moments.
            stature: m.
            white_m: by how much pose errors that are new in every pose move the person.
            keypoint_m: by how much keypoints' errors move a joint.
        """
        step_s = _STEP_NS / 1e9
        noise = np.sqrt(2) * white_m / step_s  # m/s
        moved = (self.hips[scene.second] - self.hips[scene.first])[:, :2]
        pace = np.linalg.norm(moved, axis=-1) / step_s
        of_foot = float(np.hypot(noise, np.sqrt(2) * keypoint_m / step_s))
        feet = [self[name][scene.second] - self[name][scene.first] for name in ("left_ankle", "right_ankle")]
        slid = median(np.minimum(*(np.linalg.norm(foot, axis=-1) / step_s for foot in feet)))
        slides = max(0.0, slid - 0.4 * stature / 1.7 - of_foot) / (0.5 + of_foot / 2)
        fast, ahead = quantile(pace, 0.75), self._ahead(scene, white_m)
        return {
            "course": Oddity(max(0.0, 0.5 - ahead) / 0.15, {"course_cosine": ahead}),
            "speed": Oddity(max(0.0, fast - 4.0 - 1.5 * noise) / (2 + noise), {"pace_mps": fast}),
            "slide": Oddity(slides, {"foot_mps": slid}),
            "tread": self._tread(scene, stature, of_foot, feet),
        }

    def _tread(self, scene: SceneOfMoments, stature: float, noise_mps: float, feet: list[Float]) -> Oddity:
        """Compare how fast the standing foot is left behind with how fast the person walks.

        The steps of `feet` [T, 3] m are those of a pair of moments. A foot stands still, so both are alike in
        a world of any scale, but not with a wrong focal length, or at a wrong rate of pictures. Where moments
        are too far apart to tell the way, nothing is odd.
        """
        t_ns, first, second = scene.t_ns, scene.first, scene.second
        before = np.searchsorted(t_ns, t_ns[first] - _TREAD_NS)
        after = np.searchsorted(t_ns, t_ns[second] + _TREAD_NS, side="right") - 1
        way = (self.hips[after] - self.hips[before])[:, :2]
        way_m, way_s = np.linalg.norm(way, axis=1), (t_ns[after] - t_ns[before]) / 1e9
        left_m = np.minimum(*(_dot(foot[:, :2], way) / way_m for foot in feet))
        pace, legs = way_m / way_s, way_m / way_s - left_m / (_STEP_NS / 1e9)
        known = np.isfinite(legs) & (pace > _LEAST_TREAD_MPS) & (way_s > 3 * _STEP_NS / 1e9)
        if known.sum() < _FEWEST_TREADS:
            return Oddity(0.0, {})
        walked = float(pace[known].mean())
        share = float(legs[known].mean()) / walked
        sigma = np.hypot(0.15, noise_mps / walked / np.sqrt(known.sum()))
        usual = _USUAL_TREAD_OF_RUNNERS if walked**2 > _RUN * stature else _USUAL_TREAD
        off = abs(np.log(max(share, 0.01) / usual))
        return Oddity(min(max(0.0, off - 0.15) / sigma, _MOST_TREAD), {"legs_over_pace": share})

    def _ahead(self, scene: SceneOfMoments, white_m: float) -> float:
        """Return the cosine of where the person walks against where they face; 1 if they hardly walk."""
        first = np.arange(len(scene.t_ns))
        second = np.searchsorted(scene.t_ns, scene.t_ns + _WALK_NS, side="right") - 1
        step_s = (scene.t_ns[second] - scene.t_ns[first]) / 1e9
        forwards = unit((self.forwards[first] + self.forwards[second])[:, :2])
        moved = (self.hips[second] - self.hips[first])[:, :2]
        along = _dot(moved, forwards)
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


def quantile(values: Float, share: float) -> float:
    """Return a quantile of what is finite."""
    ordered = np.sort(values[np.isfinite(values)])
    return float(ordered[int(share * (ordered.size - 1))]) if ordered.size else float("nan")
