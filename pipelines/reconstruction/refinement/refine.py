"""Refinement of a whole flight: build the problem, find the prior, estimate, and check the result."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.noise import (
    ROTATION,
    SHIFT_IN_CAMERA,
    SHIFT_IN_WORLD,
    SURVEYED_M,
    UNKNOWN_SIGMA,
    USUAL_CONSTANT,
    USUAL_COUNT,
    PoseErrors,
    Process,
)
from pipelines.reconstruction.refinement.elimination import (
    Eliminated,
    covariances,
    eliminate,
    shared_covariance,
)
from pipelines.reconstruction.refinement.estimate import BOUND, initial_state, learn, solve
from pipelines.reconstruction.refinement.kernels import State, turned
from pipelines.reconstruction.refinement.system import (
    REMEMBERED,
    Knowledge,
    Pictures,
    Problem,
    Sighting,
    System,
    UsualSize,
    build,
    misfit,
)

# The prior is learned from all of a flight of so many times, and from stretches of a longer one. Flights of
# 6 s show that 180 times are enough.
_WHOLE_TIMES, _WINDOWS, _WINDOW = 200, 3, 60
# Learning ends after this many rounds, converged or not.
_LEARNING_ROUNDS = 8
# Estimates converge in fewer rounds.
_ROUNDS = 12
_ROOT_ACCELERATION, _OWN_ACCELERATION = 3.0, 10.0  # m/s^2, initial values: a walking body, its limbs
# Lengths between keypoints vary by this much before they are learned.
_BONE_SIGMA_M = 0.02
# Fewer times do not determine accelerations.
_FEWEST_TIMES = 20
# White errors of 0.2 m at a person leave 0.03 to 0.06 m of them after the estimate with two cameras.
_WHITE_LEFT = 0.3
# Accelerations learned in uncorrected poses are too small for kicks by this factor.
_FAST_MOTION = 2.0
# A gait repeats, so its accelerations are no white noise. Clocks were 7 ms off without this factor on them.
_LOOSE_MOTION = 3.0
SETTLED_S = 2e-3
"""Offset of a clock that may stay in the pictures' stamps."""
# A prior that leaves more than so many times the image noise between neighbours is wrong.
_UNEXPLAINED = 1.15
# Right flights are not so many standard deviations from their prior.
_SIGMAS = 4.0
# Estimates under other levels converge in so many rounds.
_SETTLING = 4
# Levels of constant errors settle in so many rounds.
_LEVEL_ROUNDS = 3
# Constant errors have this share of the usual level where the pictures let the scene grow.
_HELD = 0.1
# Detectors place joints to 1 % of a person's height (simulation/data/blazepose_errors.csv). What varies of
# that is seen in residuals; the rest lasts, and is half of the variance at least
# (`detector_errors.LASTING_SHARE`).
KEYPOINT_SIGMA_M = 0.02
# A joint that one camera alone shows follows its motion at other times by this (m).
_FOLLOWED_M = 0.3
# A constant error below this share of the usual level is known from the background.
_UNDETERMINED = 0.3
_UNINFORMATIVE_MEMORY = 30.0
"""Memory of image points from which levels of slow pose errors cannot be estimated."""
# A smaller standard deviation of the formation's scale does not matter.
_SMALL_SCALE = 0.01
# Pictures do not determine a scale whose posterior is a larger share of its prior than this.
_UNSEEN_SCALE = 0.85
# Slow errors begin with at least this share of the disagreement of views.
_SLOW_SHARE = 0.2
# The level of attitudes begins with at least this angle (rad).
_LEAST_TURN = 2e-3
# Attitudes make this share of the disagreement of views where positions err, too.
_TURN_SHARE = 0.6
# This is the median of the chi-square distribution with two degrees of freedom.
_MEDIAN_OF_TWO = 2 * np.log(2)
_FARTHEST = 1.8
"""Factor on the move expected from the disagreement of the views; good estimates moved by up to 1.6."""
_FARTHEST_STATED = 3.2
"""The same factor for stated levels, where a constant error is one draw.

sqrt(30.7 / 3): the root of a chi-square variable with three degrees of freedom over three exceeds it once in
a million times.
"""
_DETERMINED_PLACE = 0.7
"""Share of a triangulated point's error by slow pose errors; above it, pictures do not determine a place."""
_UNLIKE_STATED = "refined: the stated pose noise does not explain the pictures; it was estimated instead"
PLACED_AS_LOGGED = (
    "refined: the videos do not determine the person's absolute position; it is taken from the logged poses "
    "(state pose_noise to change this)"
)
UNOBSERVED = (
    "the formation hardly changes, so the videos determine neither its scale nor constant pose errors: state "
    "the pose noise"
)
RESTS_ON_STATED = (
    "refined: the formation hardly changes, so the videos determine neither its scale nor constant pose "
    "errors in the cameras' own frames: both rest on the logged poses and what is known of their noise"
)


@dataclass(frozen=True)
class Refined:
    """Result of the refinement, or the reason why there is none."""

    position: Float  # [T, J, 3] m; NaN for joints that were not refined
    covariance: Float  # [T, J, 3, 3] m^2
    corrections: tuple[tuple[Float, Float], ...]  # of each camera: times [F] and the ten numbers [F, 10]
    clock_offset_s: Float  # [C] to add to the pictures' times
    clock_sigma_s: Float  # [C] its posterior standard deviation, 0 for known clocks
    levels: dict[str, float]
    bone_lengths_m: Float  # [B'] of the bones with two refined joints that took part in the last estimate
    learned: bool  # the levels of the pose errors were estimated from the pictures
    warnings: tuple[str, ...]
    fallback: str | None  # reason why the result must not be used


def refine(
    t_s: Float,
    sightings: Sequence[Sighting],
    start: Float,
    bones: Int64,
    prior: Sequence[PoseErrors] | None,
    clock_sigma_s: Float,
    *,
    measured: bool = False,
    size: UsualSize | None = None,
) -> Refined:
    """Estimate a skeleton, its cameras' pose errors and clocks together (maximum a posteriori).

    Times [T] strictly increase; `start` [T, J, 3] m is by a triangulation that trusts the poses, NaN where it
    found nothing; `bones` [B, 2] are pairs of joints with a nearly constant distance, and `size` is that of
    people by them; `clock_sigma_s` [C] is 0 for a known clock. Where a `prior` that was not `measured` does
    not explain the pictures, levels are estimated.
    """
    part = np.sum(~np.isnan(start[..., 0]), axis=0) >= _FEWEST_TIMES
    if part.sum() < 3 or len(t_s) < _FEWEST_TIMES:
        return _none(len(clock_sigma_s), start, "too few joints or times were triangulated")
    views = _RefinementInput(
        t_s,
        tuple(_of_joints(sighting, part) for sighting in sightings),
        _renumbered(bones, part),
        _without_gaps(t_s, start[:, part]),
        None if size is None else size.of_bones(part[bones].all(axis=1)),
    )
    del sightings  # a clock's offset and the choice of joints made copies
    refused = None
    try:
        stretches, filled = views.stretches()
        priors = _priors(stretches, filled, prior, clock_sigma_s, measured=measured)
        for found in priors:
            refined = _refined(views, found, measured=measured)
            refined = replace(
                refined,
                position=_of_all_joints(refined.position, part),
                covariance=_of_all_joints(refined.covariance, part),
            )
            if refined.fallback is None:
                return refined
            refused = refused or refined
    except np.linalg.LinAlgError as error:
        refused = refused or _none(len(clock_sigma_s), start, str(error))
    return refused or _none(len(clock_sigma_s), start, "no prior could be found")


@dataclass(frozen=True)
class _RefinementInput:
    """Constants from which a problem is built."""

    t_s: Float  # [T]
    sightings: tuple[Sighting, ...]
    bones: Int64  # [B, 2]
    start: Float  # [T, J, 3] m, without gaps
    size: UsualSize | None

    def problem(self) -> Problem:
        """Build the problem of the whole flight."""
        return build(self.t_s, self.sightings, self.bones, self.size)

    def stretches(self) -> tuple[Problem, Float]:
        """Build that of the stretches from which the prior is learned, and take their start [T', J, 3]."""
        chosen = _stretches(len(self.t_s))
        problem = build(self.t_s[chosen], self.sightings, self.bones, self.size)
        return problem, self.start[chosen]


@dataclass(frozen=True)
class _Prior:
    """Candidate parameters of the prior."""

    known: Knowledge
    state: State  # of the stretches with them
    learned: bool  # the levels of pose errors were not stated
    warnings: tuple[str, ...]
    expected_m: float  # largest allowed move of the skeleton
    held_m: float = 0.0  # standard deviation per axis by constant errors that are held as logged


def _refined(views: _RefinementInput, prior: _Prior, *, measured: bool) -> Refined:
    """Estimate under a prior, and check the result; `fallback` gives the reason if a check fails."""
    known, problem = prior.known, views.problem()
    # If somebody stands, the state from which levels were learned is far from the minimum.
    state = initial_state(problem, known, views.start)
    whole = len(prior.state.position) == len(problem.t_s)
    clock_s, clock_left_s = _clocks(problem, known, prior.state if whole else state)
    if np.abs(clock_s).max() <= SETTLED_S:
        known = replace(known, clock_sigma_s=clock_left_s)
    system, state, at = solve(problem, known, state, rounds=_ROUNDS)
    covariance = covariances(system, at)
    doubts = _doubts(system, state, at, learned=prior.learned)
    as_stated = not prior.learned and _scale_unseen(system, state, at)
    assumed = any(errors.assumed for errors in known.poses)
    as_logged = prior.learned and not assumed and _position_undetermined(system, state, at, covariance)
    del at  # the next solutions have their own factors
    slow = system, state  # determines the poses
    if known.memory > REMEMBERED:
        _, _, numbers = misfit(system, state)
        pictures = system.problem.pictures
        position, rotation = corrected(pictures.position, pictures.rotation, numbers)
        still = replace(
            system.problem,
            pictures=replace(pictures, position=position, rotation=rotation),
            pose_covariance=_WHITE_LEFT**2 * system.problem.pose_covariance,
        )
        remembering, state, own = _joints_at_full_weight(still, state.position, known, measured=measured)
        covariance = _with_own(covariance, own, remembering, state)
    joints = state.position
    moved_m = float(np.median(np.linalg.norm(joints - views.start, axis=-1)))
    fallback = doubts
    if not doubts and moved_m > prior.expected_m:
        fallback = (
            f"the skeleton would move by {moved_m:.2f} m where the views let expect {prior.expected_m:.2f} m"
        )
    as_logged = as_logged or prior.held_m > 0
    shift = np.median(views.start - joints, axis=(0, 1)) if as_logged else np.zeros(3)
    return Refined(
        position=joints + shift,
        covariance=covariance + prior.held_m**2 * np.eye(3),
        corrections=_corrections(*slow, shift),
        clock_offset_s=clock_s,
        clock_sigma_s=clock_left_s,
        levels=_levels(known),
        bone_lengths_m=state.shared[len(state.shared) - len(known.bone_sigma_m) :],
        learned=prior.learned,
        warnings=(
            *prior.warnings,
            *([RESTS_ON_STATED] if as_stated else []),
            *([PLACED_AS_LOGGED] if as_logged else []),
        ),
        fallback=fallback,
    )


def _clocks(problem: Problem, known: Knowledge, state: State) -> tuple[Float, Float]:
    """Estimate each clock's offset and its standard deviation [C] s, 0 for known clocks."""
    if not (known.clock_sigma_s > 0).any():
        return np.zeros(len(known.poses)), np.zeros(len(known.poses))
    loose = replace(known, acceleration=_LOOSE_MOTION**2 * known.acceleration)
    system, state, at = solve(problem, loose, state, rounds=_ROUNDS)
    left = np.sqrt(np.diagonal(shared_covariance(system, at)))
    return _of_clocks(system, state.shared), _of_clocks(system, left)


def _spread_of(cameras: int) -> float:
    """Compute the error of a point whose rays, from all directions, each miss it by 1 on two axes."""
    return float(np.sqrt(4.5 / cameras))


def _joints_at_full_weight(
    problem: Problem, start: Float, known: Knowledge, *, measured: bool
) -> tuple[System, State, Float]:
    """Estimate the joints after the removal of pose errors, with the full weight of keypoints.

    Pose errors were estimated with correlated keypoints weighted less. That is right for them and wrong for
    limbs: their motion would be smoothed away. Of white errors a share is left, or the keypoints of a person
    could jump with each picture; all of them would follow the lasting errors of keypoints. Clocks and the
    motion that depends on them stay unknowns.

    Returns a system of the same poses in which correlated keypoints count less again, the estimate, and the
    covariances [T, J, 3, 3] by keypoints: of the part that varies, which motion averages, and of the lasting
    part, which residuals do not show and nothing averages.
    """
    knot_s = float(problem.knot_t_s[1] - problem.knot_t_s[0])
    levels = [(*_WHITE_LEFT * errors.white_with_stray(knot_s), errors.logged) for errors in known.poses]
    poses = tuple(PoseErrors((float(m), float(rad)), (), logged) for m, rad, logged in levels)
    known = replace(known, poses=poses)
    faster = 1.0 if measured else _FAST_MOTION**2  # kicks would be smoothed
    weighted = replace(known, memory=1.0, acceleration=faster * known.acceleration)
    initial = initial_state(problem, weighted, start)
    solved, found, at = solve(problem, weighted, initial, rounds=4, bounds=(BOUND,))
    own = covariances(solved, at) + _of_lasting_errors(solved, found.position)
    return System(problem, known, solved.layout, BOUND**2), found, own


def _with_own(covariance: Float, own: Float, remembering: System, state: State) -> Float:
    """Compute covariances [T, J, 3, 3] of joints: each has its `own` error, and one by slow pose errors.

    The system is without slow pose errors; correlated keypoints count less in it, as in the estimate of
    joints and cameras together.
    """
    by_poses = covariance - covariances(remembering, eliminate(remembering, state))
    variance, axes = np.linalg.eigh(0.5 * (by_poses + by_poses.swapaxes(-1, -2)))
    by_poses = np.einsum("tjik,tjk,tjlk->tjil", axes, np.maximum(variance, 0.0), axes)
    return np.asarray(own + by_poses)


def _of_lasting_errors(system: System, position: Float) -> Float:
    """Compute covariances [T, J, 3, 3] by lasting keypoint errors in the nearest picture of each camera."""
    problem, pictures = system.problem, system.pictures
    information = np.tile(np.eye(3) / _FOLLOWED_M**2, (*position.shape[:2], 1, 1))
    for c in np.unique(pictures.camera):
        (mine,) = np.nonzero(pictures.camera == c)
        order = mine[np.argsort(pictures.when_s[mine], kind="stable")]
        middle = (pictures.when_s[order][1:] + pictures.when_s[order][:-1]) / 2
        own = order[np.searchsorted(middle, problem.t_s)]
        rotation = pictures.rotation[own]
        seen = np.einsum("tki,tjk->tji", rotation, position - pictures.position[own, None])
        slant = np.stack(
            [
                rotation[:, None, :, a] - seen[..., a : a + 1] / seen[..., 2:] * rotation[:, None, :, 2]
                for a in (0, 1)
            ],
            axis=2,
        )
        usable = np.isfinite(pictures.rays[own][..., 0]) & (seen[..., 2] > 0.1)
        with np.errstate(divide="ignore"):
            varying2 = (seen[..., 2] / pictures.sharpness[own]) ** 2
        lasting2 = np.maximum(KEYPOINT_SIGMA_M**2 - varying2, varying2)
        weight = np.where(usable, 1 / lasting2, 0.0)
        information += weight[..., None, None] * np.einsum("tjai,tjak->tjik", slant, slant)
    return np.asarray(np.linalg.inv(information))


def corrected(position: Float, rotation: Float, numbers: Float) -> tuple[Float, Float]:
    """Remove the corrections `numbers` [N, 10] from positions [N, 3] m and world_from_camera [N, 3, 3]."""
    turns = np.ascontiguousarray(numbers[:, ROTATION : ROTATION + 3])
    true_rotation = np.einsum("nij,nkj->nik", rotation, turned(turns))
    shift = numbers[:, :3] + np.einsum("nij,nj->ni", true_rotation, numbers[:, 6:9])
    return position - shift, true_rotation


# --- joints and bones ----------------------------------------------------------------------------------


def _of_joints(sighting: Sighting, part: Bool) -> Sighting:
    if part.all():
        return sighting
    return replace(sighting, rays=sighting.rays[:, part], confidence=sighting.confidence[:, part])


def _of_all_joints(values: Float, part: Bool) -> Float:
    """Return values [T, P, ...] of the refined joints for all joints [T, J, ...], NaN for the others."""
    if part.all():
        return values
    whole = np.full((len(values), len(part), *values.shape[2:]), np.nan)
    whole[:, part] = values
    return whole


def _renumbered(bones: Int64, part: Bool) -> Int64:
    number = np.cumsum(part) - 1
    there = part[bones].all(axis=1)
    renumbered: Int64 = number[bones[there]].astype(np.int64).reshape(-1, 2)
    if not len(renumbered):
        # The size of the body needs a measure: any two joints will do.
        renumbered = np.array([[0, 1]], dtype=np.int64)
    return renumbered


def _without_gaps(t_s: Float, start: Float) -> Float:
    """Fill the start: as triangulated, linear in between."""
    filled = start.copy()
    for joint in range(start.shape[1]):
        there = ~np.isnan(start[:, joint, 0])
        for axis in range(3):
            filled[~there, joint, axis] = np.interp(t_s[~there], t_s[there], start[there, joint, axis])
    return filled


# --- the prior -----------------------------------------------------------------------------------------


def _priors(
    problem: Problem,
    start: Float,
    prior: Sequence[PoseErrors] | None,
    clock_sigma_s: Float,
    *,
    measured: bool,
) -> Iterator[_Prior]:
    """Yield parameters of the prior from stretches of the flight, then alternatives if a check refuses."""
    cameras = len(clock_sigma_s)
    guess, image, disagreement_m, _ = _first_guess(problem, start)
    if prior is not None:
        for known in _known_prior(problem, start, prior, clock_sigma_s):
            if measured or known.known.memory > REMEMBERED or known.known.pixel_scale < _UNEXPLAINED * image:
                yield known
        if measured:
            return
    unlearned = _unlearned(problem, start, (guess,) * cameras, clock_sigma_s)
    state = initial_state(problem, unlearned, start)
    free, state = learn(problem, unlearned, state, poses=True, memory=True, rounds=_LEARNING_ROUNDS)
    if free.memory >= _UNINFORMATIVE_MEMORY:
        # Keypoints determine no levels of lasting errors, which are possible all the same.
        position, rotation = UNKNOWN_SIGMA
        lasting = (Process(SHIFT_IN_WORLD, position), Process(ROTATION, rotation))
        usual = PoseErrors(guess.white, lasting, assumed=True)
        for possible in _known_prior(problem, start, [usual] * cameras, clock_sigma_s):
            # Two views disagree across one line only, which says too little without a background.
            yield replace(possible, learned=possible.learned or cameras == 2)
        return
    if free.memory < REMEMBERED and free.pixel_scale > _UNEXPLAINED * image:
        raise np.linalg.LinAlgError("no level of pose noise explains the pictures")
    warnings = () if prior is None else (_UNLIKE_STATED,)
    yield _Prior(free, state, True, warnings, _spread_of(cameras) * _FARTHEST * disagreement_m)


def _known_prior(
    problem: Problem, start: Float, prior: Sequence[PoseErrors], clock_sigma_s: Float
) -> Iterator[_Prior]:
    """Yield priors with known pose errors: assumed constants of estimated or usual levels, or as logged."""
    guess, _, disagreement_m, range_m = _first_guess(problem, start)
    unlearned = _unlearned(problem, start, tuple(prior), clock_sigma_s)
    state = initial_state(problem, unlearned, start)
    known, state = learn(problem, unlearned, state, poses=False, memory=True, rounds=_LEARNING_ROUNDS)
    guessed = {kind: process.sigma0 for kind, process in enumerate(guess.processes[:2])}
    shifts = [each for errors in prior for each in errors.processes if each.number != ROTATION]
    surveyed = [each.constant and each.sigma0 < 2 * SURVEYED_M for each in shifts]
    if surveyed and all(surveyed) and guessed[1] > _LEAST_TURN:
        guessed[1] /= _TURN_SHARE  # all of the disagreement is by attitudes
    measured_m = float(np.mean([_ray_sigma_m(errors, range_m) for errors in prior]))
    expected_m = _spread_of(len(prior)) * max(_FARTHEST * disagreement_m, _FARTHEST_STATED * measured_m)
    if not any(errors.assumed for errors in prior):
        yield _Prior(known, state, False, (), expected_m)
        return
    usual, usual_m = _usual_levels(guessed), _ray_sigma_m(PoseErrors(USUAL_CONSTANT, ()), range_m)
    found = _with_constant_levels(problem, known, state, guessed)
    if found is not None:
        yield _Prior(found, state, True, (), expected_m)
    if disagreement_m < _SIGMAS * usual_m:
        yield _Prior(_of_levels(known, usual), state, False, (), expected_m)
    held = _of_levels(known, {kind: _HELD * sigma for kind, sigma in usual.items()})
    # Errors are as large as usual, or as the views disagree if that is more.
    held_m = _spread_of(len(prior)) * max(usual_m, disagreement_m) / np.sqrt(3)
    yield _Prior(held, state, False, (), expected_m, held_m)


def _usual_levels(guessed: Mapping[int, float]) -> dict[int, float]:
    """Return usual levels of constant errors by kind, or those guessed from the views if they are smaller."""
    return {kind: min(USUAL_CONSTANT[kind], sigma) for kind, sigma in guessed.items()}


def _with_constant_levels(
    problem: Problem, known: Knowledge, state: State, guessed: Mapping[int, float]
) -> Knowledge | None:
    """Estimate the level of assumed constant errors by MacKay's rule, pooled over the cameras.

    A few numbers say little of a level: a usual level counts as `USUAL_COUNT` more. None exceeds the one that
    the views' disagreement gives. None is returned where the scene would grow to fit the detector's errors.
    """
    for _ in range(_LEVEL_ROUNDS):
        system, state, at = solve(problem, known, state, rounds=_SETTLING, bounds=(BOUND,))
        variance = np.diagonal(shared_covariance(system, at))
        del at  # factors of two estimates would be in memory together
        found: dict[int, list[tuple[float, float]]] = {}
        for (camera, process), (at_knots, column) in zip(
            system.layout.processes, system.layout.place, strict=True
        ):
            if _is_assumed(known.poses[camera], process) and not at_knots:
                kind = 1 if process.number == ROTATION else 0
                own = slice(column, column + 3)
                determined = float(np.sum(1 - variance[own] / process.sigma0**2))
                found.setdefault(kind, []).append((float(np.sum(state.shared[own] ** 2)), determined))
        level, usual = {}, _usual_levels(guessed)
        for kind, parts in found.items():
            squares, determined = np.sum(parts, axis=0)
            usual2 = usual[kind] ** 2
            level[kind] = np.sqrt((squares + USUAL_COUNT * usual2) / (max(determined, 0.0) + USUAL_COUNT))
        if any(sigma > UNKNOWN_SIGMA[kind] for kind, sigma in level.items()):
            return None
        known = _of_levels(known, {kind: min(sigma, guessed[kind]) for kind, sigma in level.items()})
    system, state, at = solve(problem, known, state, rounds=_SETTLING, bounds=(BOUND,))
    return None if _scale_unseen(system, state, at) else known


def _is_assumed(errors: PoseErrors, process: Process) -> bool:
    """Test if the level of a constant error is unknown; a smaller one was determined by the background."""
    usual = USUAL_CONSTANT[1 if process.number == ROTATION else 0]
    return errors.assumed and process.constant and process.sigma0 > _UNDETERMINED * usual


def _of_levels(known: Knowledge, level: Mapping[int, float]) -> Knowledge:
    """Give assumed constant errors of all cameras these levels, see `_of_level`."""
    return replace(known, poses=tuple(_of_level(errors, level) for errors in known.poses))


def _of_level(errors: PoseErrors, level: Mapping[int, float]) -> PoseErrors:
    """Give assumed constant errors the levels found, by kind: 0 for positions (m), 1 for rotations (rad)."""
    processes = (
        replace(process, sigma0=float(level[1 if process.number == ROTATION else 0]))
        if _is_assumed(errors, process)
        else process
        for process in errors.processes
    )
    return replace(errors, processes=tuple(processes))


def _stretches(times: int) -> Int64:
    """Choose the times from which the prior is learned: all of a short flight, else stretches over it."""
    if times <= _WHOLE_TIMES:
        return np.arange(times)
    begins = np.linspace(0, times - _WINDOW, _WINDOWS).astype(np.int64)
    return (begins[:, None] + np.arange(_WINDOW)).ravel()


def _unlearned(
    problem: Problem, start: Float, errors: tuple[PoseErrors, ...], clock_sigma_s: Float
) -> Knowledge:
    joints, bones = problem.joints, len(problem.bones)
    acceleration = np.full((joints, joints), _ROOT_ACCELERATION**2)
    acceleration[np.diag_indices(joints)] += _OWN_ACCELERATION**2
    known = Knowledge(errors, clock_sigma_s, acceleration, np.full(bones, _BONE_SIGMA_M), 1.0, 1.0)
    state = initial_state(problem, known, start)
    return replace(known, size_m=float(state.shared[-bones:].mean()))


def _first_guess(problem: Problem, start: Float) -> tuple[PoseErrors, float, float, float]:
    """Guess initial levels of pose errors, image noise between neighbours, disagreement (m) and range (m).

    The median residual of a picture's joints is attributed to the camera. Its change from one picture to the
    next is white, the rest is slow. The joints' residuals relative to it are the detector's errors.
    """
    pictures = problem.pictures
    residual, distance = _residuals(problem, start)
    cameras = int(pictures.camera.max()) + 1
    common = np.nanmedian(residual, axis=1)
    own = (residual - common[:, None]) * pictures.sharpness[..., None]
    white, total, image = [], [], []
    for c in range(cameras):
        mine = pictures.camera == c
        if mine.sum() < 3:
            continue
        white.append(_spread(np.diff(common[mine], axis=0)) / np.sqrt(2))
        total.append(float(np.sqrt(np.nanmedian(np.sum(common[mine] ** 2, axis=1)) / _MEDIAN_OF_TWO)))
        image.append(_spread(np.diff(own[mine], axis=0)) / np.sqrt(2))
    # A joint's position absorbs three of its 2 n residuals: of their sum, not equally in each camera.
    lost = np.sqrt(2 * cameras / (2 * cameras - 3))
    fast, all_of_it = lost * float(np.median(white)), lost * float(np.median(total))
    slow = 1.5 * float(np.sqrt(max(all_of_it**2 - fast**2, (_SLOW_SHARE * all_of_it) ** 2)))
    fast *= 1.2
    range_m = float(np.nanmedian(distance))
    guess = PoseErrors(
        (max(0.8 * fast * range_m, 0.01), max(0.6 * fast, 1e-3)),
        (
            Process(SHIFT_IN_WORLD, max(0.8 * slow * range_m, 0.02), 0.03),
            Process(ROTATION, max(_TURN_SHARE * slow, _LEAST_TURN), 2e-3),
            Process(SHIFT_IN_CAMERA, max(0.4 * slow * range_m, 0.02)),
        ),
    )
    noise = lost * float(np.sqrt(np.mean(np.square(image))))
    if cameras == 2:
        # Two views disagree across one line only, so their residuals show less than the stated image noise.
        noise = max(noise, 1.0)
    blur = noise / float(np.median(pictures.sharpness[pictures.sharpness > 0]))
    disagreement = float(np.hypot(lost * float(np.median(total)), blur))
    return guess, noise, disagreement * range_m, range_m


def _ray_sigma_m(errors: PoseErrors, range_m: float) -> float:
    """Compute the miss (m per axis) of a viewing ray at the actor by the stated errors."""
    shift, turn = errors.white[0] ** 2, errors.white[1] ** 2
    for process in errors.processes:
        if process.number == ROTATION:
            turn += process.sigma0**2
        else:
            shift += process.sigma0**2
    return float(np.sqrt(shift + range_m**2 * turn))


def _spread(values: Float) -> float:
    """Compute a robust standard deviation from the median."""
    return float(1.4826 * np.nanmedian(np.abs(values)))


def _residuals(problem: Problem, position: Float) -> tuple[Float, Float]:
    """Compute normalised residuals [G, J, 2] with the logged poses, and the depths of joints [G, J] (m)."""
    pictures = problem.pictures
    away = position[_nearest(problem)] - pictures.position[:, None]
    seen = np.einsum("gji,gkj->gki", pictures.rotation, away)
    depth = np.where(seen[..., 2] > 0.1, seen[..., 2], np.nan)
    return seen[..., :2] / depth[..., None] - pictures.rays, depth


def _nearest(problem: Problem) -> Int64:
    """Find the time of the skeleton that is nearest to each picture: its number [G]."""
    first, when = problem.pictures.first, problem.pictures.when_s
    apart = np.abs(problem.t_s[first[:, None] + np.arange(3)] - when[:, None])
    return np.asarray(first + np.argmin(apart, axis=1), dtype=np.int64)


# --- checks and results --------------------------------------------------------------------------------


def _doubts(system: System, state: State, at: Eliminated, *, learned: bool) -> str | None:
    """Check the estimate; return the reason to refuse it, None if it passes."""
    if not np.isfinite(state.position).all():
        return "the estimate did not converge"
    pictures = system.problem.pictures
    _, _, numbers = misfit(system, state)
    # The scale of the formation: pictures alone do not determine it.
    moved, _ = corrected(pictures.position, pictures.rotation, numbers)
    apart, apart_after = _apart(pictures, pictures.position), _apart(pictures, moved)
    grown = float(np.sum(apart * apart_after) / np.sum(apart**2)) - 1
    sigma = _scale_sigma(system)
    if abs(grown) > max(_SIGMAS * sigma, 0.05 if learned else 0.02):
        side = "wider" if grown > 0 else "closer"
        return f"the cameras would stand {100 * abs(grown):.0f} % {side} than logged"
    if learned and _scale_unseen(system, state, at):
        return UNOBSERVED
    for (camera, process), (at_knots, column) in zip(
        system.layout.processes, system.layout.place, strict=True
    ):
        value = state.knots[0] if at_knots else state.shared
        surprise = float(np.sqrt(np.sum(value[column : column + 3] ** 2) / 3)) / process.sigma0
        if surprise > _SIGMAS and not at_knots:
            return f"camera {camera + 1} would be {surprise:.0f} standard deviations from its logged poses"
    return None


def _position_undetermined(system: System, state: State, at: Eliminated, covariance: Float) -> bool:
    """Test if the person's absolute position is not determined by the pictures.

    Constant errors are only a few numbers, and their estimated levels are uncertain. If the posterior of the
    position is almost as wide as these levels allow, or the scale is not determined, the estimated position
    is a random draw from the levels, and no nearer to the truth than the logged one.
    """
    _, distance = _residuals(system.problem, state.position)
    range_m = float(np.nanmedian(distance))
    poses = system.knowledge.poses
    slow_m = float(np.mean([_ray_sigma_m(replace(errors, white=(0.0, 0.0)), range_m) for errors in poses]))
    white_m = float(np.mean([_ray_sigma_m(replace(errors, processes=()), range_m) for errors in poses]))
    if slow_m <= white_m:
        return False
    left_m = float(np.sqrt(np.trace(covariance, axis1=-2, axis2=-1).mean()))
    unseen = _scale_left(system, state, at) > _UNSEEN_SCALE
    return unseen or left_m > _DETERMINED_PLACE * slow_m * _spread_of(len(poses))


def _scale_unseen(system: System, state: State, at: Eliminated) -> bool:
    """Test if the scale of the formation matters and its posterior is almost as wide as its prior."""
    return _scale_sigma(system) > _SMALL_SCALE and _scale_left(system, state, at) > _UNSEEN_SCALE


def _scale_left(system: System, state: State, at: Eliminated) -> float:
    """Compute the ratio of posterior to prior standard deviation of the formation's scale."""
    lengths = state.shared[system.layout.bone_column :]
    posterior = shared_covariance(system, at)[system.layout.bone_column :, system.layout.bone_column :]
    return float(np.sqrt(posterior.sum())) / float(lengths.sum()) / _scale_sigma(system)


def _scale_sigma(system: System) -> float:
    """Compute the prior standard deviation of the formation's scale."""
    pictures = system.problem.pictures
    return _slow_sigma(system) / float(np.sqrt(np.sum(_apart(pictures, pictures.position) ** 2)))


def _apart(pictures: Pictures, position: Float) -> Float:
    """Compute the cameras' mean positions [C, 3] relative to their centre, from positions [G, 3]."""
    centre = np.stack([position[pictures.camera == c].mean(axis=0) for c in np.unique(pictures.camera)])
    away: Float = centre - centre.mean(axis=0)
    return away


def _slow_sigma(system: System) -> float:
    """Compute the standard deviation (m) of the mean shift of a camera."""
    elapsed_s = float(system.problem.t_s[-1] - system.problem.t_s[0])
    variance = 1e-6
    for errors in system.knowledge.poses:
        variance += errors.white[0] ** 2 / max(len(system.problem.t_s), 1)
        for process in errors.processes:
            if process.number in (SHIFT_IN_WORLD, SHIFT_IN_CAMERA):
                variance += process.sigma0**2 + process.rate**2 * elapsed_s
    return float(np.sqrt(variance / len(system.knowledge.poses)))


def _corrections(system: System, state: State, shift: Float) -> tuple[tuple[Float, Float], ...]:
    """Collect each camera's times [F] and corrections [F, 10], with everything moved by `shift` [3] m."""
    pictures = system.problem.pictures
    _, _, numbers = misfit(system, state)
    numbers[:, SHIFT_IN_WORLD : SHIFT_IN_WORLD + 3] -= shift
    found = []
    for c in range(len(system.knowledge.poses)):
        (mine,) = np.nonzero(pictures.camera == c)
        order = mine[np.argsort(pictures.when_s[mine], kind="stable")]
        found.append((pictures.when_s[order], numbers[order]))
    return tuple(found)


def _of_clocks(system: System, shared: Float) -> Float:
    column = system.layout.entries.clock_column
    return np.where(column >= 0, shared[np.maximum(column, 0)], 0.0)


def _levels(known: Knowledge) -> dict[str, float]:
    """Summarise every level by its median over the cameras, in the units of the noise models."""
    names = {SHIFT_IN_WORLD: "position_world", SHIFT_IN_CAMERA: "position_body", ROTATION: "rotation"}
    found: dict[str, list[float]] = {}
    for errors in known.poses:
        if errors.white[0] > 0:
            found.setdefault("white_position_m", []).append(errors.white[0])
            found.setdefault("white_rotation_deg", []).append(float(np.degrees(errors.white[1])))
        for process in errors.processes:
            turn = process.number == ROTATION
            unit, factor = ("deg", float(np.degrees(1.0))) if turn else ("m", 1.0)
            kind = "gauss_markov" if np.isfinite(process.correlation_s) else "bias"
            found.setdefault(f"{kind}_{names[process.number]}_{unit}", []).append(factor * process.sigma0)
            if process.rate > 0:
                name = f"drift_{names[process.number]}_{unit}_per_sqrt_s"
                found.setdefault(name, []).append(factor * process.rate)
    return {name: float(np.median(values)) for name, values in found.items()} | {
        "pixel_scale": known.pixel_scale,
        "acceleration_m_s2": float(np.sqrt(np.median(np.diagonal(known.acceleration)))),
        "bone_sigma_mm": 1e3 * float(np.median(known.bone_sigma_m)) if len(known.bone_sigma_m) else 0.0,
    }


def _none(cameras: int, start: Float, reason: str) -> Refined:
    return Refined(
        position=np.full_like(start, np.nan),
        covariance=np.full((*start.shape, 3), np.nan),
        corrections=tuple((np.empty(0), np.empty((0, 10))) for _ in range(cameras)),
        clock_offset_s=np.zeros(cameras),
        clock_sigma_s=np.zeros(cameras),
        levels={},
        bone_lengths_m=np.empty(0),
        learned=False,
        warnings=(),
        fallback=reason,
    )
