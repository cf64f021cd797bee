"""Doubts about a flight: what is odd about it, and the mistake in its description that explains that.

A flight whose score is small is believed, unless a clock or a frame rate explains markedly more. Else every
mistake that `hypotheses` knows is tried, and the best is named if it explains markedly more than the
description does. If none does, the doubt is stated without a cause.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Int64
from pipelines.reconstruction.background_tracks import Followed
from pipelines.reconstruction.doubts import remedies
from pipelines.reconstruction.doubts.faults import (
    FREE,
    Fault,
    fit,
    origins,
    picture_variance,
    tilt_sigma_deg,
    undone,
    zoom,
)
from pipelines.reconstruction.doubts.hypotheses import (
    LEAST_GAIN_OF_TIMES,
    RATES,
    TIMES,
    Hypothesis,
    Trial,
    higher_or_lower,
    of_descriptions,
    of_level,
    of_scale,
    of_times,
    pair_of,
    relative_to,
    turn_about,
)
from pipelines.reconstruction.doubts.logs import doubts_of_logs
from pipelines.reconstruction.doubts.scene import CameraLike, Sampled, SceneOfMoments, sample, scene_of
from pipelines.reconstruction.doubts.score import (
    STATURE_M,
    Score,
    base_of,
    residual_px,
    residuals_px,
    score,
    solve,
)
from pipelines.reconstruction.doubts.turning import (
    LEAST_GAIN,
    Lateness,
    is_sure_clock,
    lateness,
    turns_of,
)
from pipelines.session.description import Description, Doubt
from pipelines.session.maps import each_map
from pipelines.session.people import logged_actor

MARGIN = 3.0
"""By how much a mistake must score better than the description to be named."""

MARGIN_OF_TIMES = 2.0
"""The same for clocks and frame rates, which only the scatter of rays can tell."""

ODD = 3.0
"""Score of a description from which more than times is tried."""

SCATTERED = 0.65
"""Scatter of rays from which more than times is tried, whatever the score; 0.35 to 0.7 on right flights."""

MISSED = 1.8
"""Misfit of rays from which more than times is tried, whatever the score; 0.4 to 1.6 on right flights."""

STRAINED = 10.0
"""Chi^2 of constant errors of poses from which faults of one camera's poses are tried."""

GAIN = 14.0
"""By how much a fault must lower the chi^2 of the rays, to be named."""

STRANGE = 5.0
"""Standard deviations from which one oddity is said, whatever the score."""

STRANGE_SIZE = 2.5
"""The same of the stature: mistakes of scale are less rare than people below 1.27 m or above 2.35 m."""

DOUBTFUL = 6.0
"""Score of a description above which it is doubted although no mistake explains it."""

# Logs nearer to each other than this do not tell own origins from positions in a smaller unit.
_HOVERING_M = 0.5
# Drones that all fly lower than this below zero count heights downwards.
_BELOW_M = 1.0
# Hypotheses whose scores are this close are stated together.
_ALIKE = 1.0
# Each free number costs this much chi^2, as in Akaike's criterion.
_COST_OF_NUMBER = 2.0
# Faults whose chi^2 are this close are stated together.
_ALIKE_COST = 4.0
# A right hypothesis raises the residual of the rays by less than this factor.
_SAME_RESIDUAL = 1.1
# Leaving a camera out explains much by chance, and must gain this much more.
_PENALTY_OF_CAMERA = 2.5
# Hypotheses without a free number have at most this penalty.
_DISCRETE = 0.8


@dataclass(frozen=True)
class Diagnosis:
    """The doubts of a flight, those first that explain the most."""

    doubts: list[Doubt]
    score: float  # of the description; NaN where the cameras share no time
    tried: int  # hypotheses


def doubts_of(
    folder: Path,
    description: Description,
    cameras: Sequence[CameraLike],
    *,
    chosen: Sequence[Int64],
    followed: Mapping[str, object],
    pose_noise: str | None = None,
) -> list[Doubt]:
    """Diagnose a session.

    The person is the one who was chosen where several are seen; where a wrong description spoils that
    choice, the one whom each camera shows in most pictures. The flight is doubted by the less odd of both.

    Args:
        folder: the session.
        description: its session.json.
        cameras: with their detections.
        chosen: which detection [F] of each camera's pictures the actor is, -1 for none.
        followed: backgrounds of cameras by name; what is none is ignored.
        pose_noise: the value of `--pose-noise`, if any.

    Raises:
        DataError: a table or map of the session is damaged.
    """
    last = deque(each_map(folder) if description.map is not None else (), maxlen=1)
    known = partial(
        sample,
        cameras,
        description,
        actor=logged_actor(folder, description),
        last_map=last[0] if last else None,
        pose_noise=pose_noise,
    )
    between = description.pose_interpolation
    turns = {
        index: turns_of(camera, tracks)
        for index, camera in enumerate(cameras)
        if isinstance(tracks := followed.get(camera.name), Followed)
    }
    first_ns = [description.cameras[camera.name].frames.first_t_ns for camera in cameras]
    late = lateness(cameras, turns, between, RATES, first_ns)
    return diagnose(_less_odd(known(chosen=chosen), known()), late).doubts


def doubts_of_clocks(description: Description, moved: Mapping[str, Mapping[str, float | str]]) -> list[Doubt]:
    """State which clocks were moved against what is stated of them, and by what evidence."""
    said = {"background": "the turning of their background shows", "keypoints": "the people in them show"}
    doubts = []
    for name, found in moved.items():
        late_s, sigma_s = float(found["offset_s"]), float(found["sigma_s"])
        doubts.append(
            Doubt(
                code="clock",
                cameras=[name],
                what=f"the pictures of {name} were taken {remedies.earlier_or_later(late_s)}, as"
                f" {said[str(found['by'])]} (sigma {sigma_s:.3f} s); the estimate uses that",
                evidence={"clock_s": _rounded(late_s), "clock_sigma_s": _rounded(sigma_s)},
                remedy=f"cameras.{name}.{remedies.offset_of(description.cameras[name], late_s)}",
            )
        )
    return doubts


def _less_odd(chosen: Sampled | None, prominent: Sampled | None) -> Sampled | None:
    """Return the flight with the less odd person; the first if they are alike."""
    if chosen is None or prominent is None:
        return None
    same = all(
        np.array_equal(one.pixels, other.pixels, equal_nan=True)
        for one, other in zip(chosen.cameras, prominent.cameras, strict=True)
    )
    if same:
        return chosen
    return min(chosen, prominent, key=lambda flight: score(flight, scene_of(flight)).total)


def diagnose(flight: Sampled | None, late: Sequence[Lateness] = ()) -> Diagnosis:
    """Find what is odd about a flight, and why; a flight whose cameras share no time is not doubted here.

    Args:
        flight: the flight.
        late: what the backgrounds tell of the cameras' times.
    """
    if flight is None:
        return Diagnosis([], float("nan"), 0)
    described = scene_of(flight)
    base, found = base_of(flight, described)
    trial = Trial(flight, described, base)
    # A turned world leaves rays and bodies as they are; rolled cameras mirror the body.
    mirrored = any(found.odd[name].sigmas >= STRANGE for name in ("face", "bend") if name in found.odd)
    fits = found.misfit < MISSED and found.scatter < SCATTERED and not mirrored
    level = of_level(trial) if fits else ()
    hypotheses = [*level, *_of_logs(trial), *_of_turns(trial, late), *of_times(trial)]
    stated = fit(flight, described, "none", 0)
    explained = min((each.total for each in hypotheses), default=np.inf)
    strange = _is_strange(found)
    odd = strange or base.total >= ODD or found.scatter >= SCATTERED or found.misfit >= MISSED
    if odd or explained <= base.total - MARGIN_OF_TIMES:
        hypotheses += list(of_descriptions(trial))
    if strange and np.isfinite(found.stature_m):
        hypotheses.append(trial.scored(of_scale(trial, found.stature_m)))
    if odd or stated.strain >= STRAINED:
        hypotheses += list(_of_faults(trial))
        hypotheses += [trial.scored(noisy) for noisy in _of_noise(trial, stated.cost)]
    hypotheses.sort(key=lambda each: each.total)
    causes = _causes(trial, hypotheses)
    if causes and causes[0].scene is not None and _is_noise(flight, causes[0].scene, hypotheses):
        causes = []
    below_zero = _below_zero(trial)
    if not causes or np.isfinite(causes[0].cost):
        discrete = _without_number(trial, hypotheses)
        of_one = _of_one_clock(trial, hypotheses, stated.cost)
        faults = _faults([*discrete, *of_one, *hypotheses], stated.cost, described)
        causes = below_zero or faults or causes  # of logs upside down, a fault of one only seems to explain
    causes = [each for each in causes if _leaves_no_doubt(flight, each)] or below_zero
    if not causes and base.total >= DOUBTFUL:
        causes = _bad_camera(trial)
    if any(each.code == "scale" for each in causes):  # others change the size by making the rays fit worse
        causes = [each for each in causes if each.code == "scale"]
    doubts = [_doubt(_with_sigma(trial, each), found, described) for each in causes]
    if doubts or strange or base.total >= DOUBTFUL:
        named = {doubt.code for doubt in doubts}
        named |= {"scale"} if "unit" in named else set()
        oddities = _oddities(found, described, flight, alone=not doubts)
        doubts += [doubt for doubt in oddities if doubt.code not in named]
    return Diagnosis(doubts, base.total, len(hypotheses))


def _is_strange(described: Score) -> bool:
    """Test if a single oddity is so large that it is said, whatever the total."""
    limits = {"size": STRANGE_SIZE}
    return any(each.sigmas >= limits.get(name, STRANGE) for name, each in described.odd.items())


def _causes(trial: Trial, hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    """Return the hypotheses that score next to the best, one of each code; none if it explains too little.

    Those without a free number are first. Of clocks and frame rates, which are alike, the better score is.
    """
    explaining: list[Hypothesis] = []
    for each in hypotheses:
        if explaining and each.total > explaining[0].total + _ALIKE:
            break
        if each.total > trial.base.total - MARGIN_OF_TIMES:
            break
        if _explains(trial, each):
            explaining.append(each)
    causes: dict[str, Hypothesis] = {}
    free = [each for each in explaining if each.penalty > _DISCRETE and each.code not in TIMES]
    for each in [*(each for each in explaining if each not in free), *free]:
        causes.setdefault(each.code, each)
    discrete = [
        each
        for each in causes.values()
        if each.penalty <= _DISCRETE and each.scene is not None and each.code not in TIMES
    ]
    if len(discrete) > 1:  # alike in what is odd: the rays tell which of them fits
        costs = {each.code: _cost(trial, each) for each in discrete}
        least = min(costs.values()) + _ALIKE_COST  # where they do not tell, what is odd does, to a tenth
        discrete.sort(key=lambda each: (max(costs[each.code], least), round(each.total, 1), costs[each.code]))
    return [*discrete, *(each for each in causes.values() if each not in discrete)]


def _cost(trial: Trial, hypothesis: Hypothesis) -> float:
    """Return the chi^2 of a hypothesis without a free number, with constant errors of all poses."""
    if hypothesis.scene is None:
        raise ValueError(f"{hypothesis.what} has no scene")
    return fit(trial.flight, hypothesis.scene, "none", 0).cost


def _without_number(trial: Trial, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the best hypothesis without a free number with its cost, to compete with faults.

    It need not explain as much as the margin asks: of what lowers the chi^2 as much, it is the simpler. Other
    times do not compete: they show other pictures, or fewer, so that their chi^2 is another sum.
    """
    for each in hypotheses:
        if each.total > trial.base.total - MARGIN_OF_TIMES:
            break
        if each.scene is not None and each.penalty <= _DISCRETE and each.code not in TIMES:
            return [replace(each, cost=_cost(trial, each))]
    return []


def _of_one_clock(trial: Trial, hypotheses: Sequence[Hypothesis], stated: float) -> list[Hypothesis]:
    """Return clocks and frame rates of one camera with their cost, to compete with faults.

    The chi^2 of the rays is more sensitive to them than the score. Their gain of chi^2, on the moments that
    they show, is subtracted from the chi^2 of all moments, so that costs can be compared.

    Args:
        trial: the flight.
        hypotheses: all that were tried.
        stated: the cost of a fit without a fault.
    """
    found = []
    for each in hypotheses:
        if each.scene is None or each.code not in TIMES or each.alike is not None:
            continue
        if each.total <= trial.base.total - LEAST_GAIN_OF_TIMES:
            described = _same_moments(trial, each.scene)
            gain = fit(trial.flight, described, "none", 0).cost - _cost(trial, each)
            numbers = 0 if each.penalty <= _DISCRETE else 1
            found.append(replace(each, cost=stated - gain + numbers * _COST_OF_NUMBER))
    return [each for each in found if np.isfinite(each.cost)]


def _same_moments(trial: Trial, scene: SceneOfMoments) -> SceneOfMoments:
    """Return the description where another scene has rays, too."""
    seen = np.isfinite(scene.rays[..., :1]).any(axis=2, keepdims=True)
    return replace(trial.described, rays=np.where(seen, trial.described.rays, np.nan))


def _explains(trial: Trial, hypothesis: Hypothesis) -> bool:
    """Return True if a hypothesis explains markedly more than the description of the same moments.

    Another clock leaves moments out: in fewer, errors that wander are smaller, and they say less. Times of
    all cameras alike must explain more than the same pictures do at the times that are stated. Nor may the
    rays of a person in whom nothing is odd miss each other by more than before; with constant errors of all
    poses, they must fit markedly better. So must times of all cameras; those of one must fit about as well.
    """
    if hypothesis.scene is None:
        return True
    if not _leaves_no_doubt(trial.flight, hypothesis):
        return False
    is_odd = trial.base.total >= ODD or hypothesis.code in ("scale", "unit")
    described = _same_moments(trial, hypothesis.scene)
    if hypothesis.code in TIMES or not is_odd:
        of_one_clock = hypothesis.code in TIMES and hypothesis.alike is None
        least = -_ALIKE_COST if of_one_clock else GAIN
        if _cost(trial, hypothesis) > fit(trial.flight, described, "none", 0).cost - least:
            return False
    same = score(trial.flight, described, trial.base)
    share = np.isfinite(described.rays[..., 0]).sum() / np.isfinite(trial.described.rays[..., 0]).sum()
    margin = (MARGIN_OF_TIMES if hypothesis.code in TIMES else MARGIN) / share
    if hypothesis.total > min(same.total, trial.base.total) - margin:
        return False
    if hypothesis.alike is not None:
        flight, stated_scene = trial.as_stated(*hypothesis.alike)
        # That is so at the stated times alone.
        unposed = float(np.log1p(same.odd["unposed"].sigmas ** 2)) if "unposed" in same.odd else 0.0
        if hypothesis.total > score(flight, stated_scene, trial.base).total + unposed - margin:
            return False
    missed = [residual_px(scene, solve(scene)) for scene in (described, hypothesis.scene)]
    return is_odd or missed[1] <= _SAME_RESIDUAL * missed[0]


def _leaves_no_doubt(flight: Sampled, hypothesis: Hypothesis) -> bool:
    """Test if the flight without the mistake scores below the limit of a doubt.

    A remedy may explain the rays and still leave a flight that cannot be right, for example one in which all
    sizes shrink to zero. Such a remedy is not given.
    """
    return hypothesis.scene is None or score(flight, hypothesis.scene).total < DOUBTFUL


def _below_zero(trial: Trial) -> list[Hypothesis]:
    """Doubt drones that fly below zero all the time, where neither a map nor an actor says how high zero is.

    Where all fly about equally high, the rays are alike with z upwards and downwards: the penalty of a
    hypothesis, which has to explain more than the description, is not asked for.
    """
    located = trial.flight.hips is not None or trial.flight.ground is not None
    height = trial.described.position[trial.moving, :, 2]
    if located or not np.isfinite(height).any() or np.nanmax(height) > -_BELOW_M:
        return []
    place = trial.described.position.copy()
    place[trial.moving, :, 2] *= -1
    turned = trial.scored(
        Hypothesis(
            "axes",
            trial.names,
            "all drones fly below zero: their positions count z downwards, or zero is high above the ground",
            remedies.upside_down(trial.flight.cameras),
            _DISCRETE,
            replace(trial.described, position=place),
        )
    )
    alike = turned.score is not None and turned.score.total <= trial.base.total + _ALIKE
    return [turned] if alike else []


def _bad_camera(trial: Trial) -> list[Hypothesis]:
    """Find the one camera of three or more without which nothing is odd, where no mistake explains it."""
    if len(trial.names) < 3:
        return []
    tried = []
    for index, name in enumerate(trial.names):
        rays = trial.described.rays.copy()
        rays[index] = np.nan
        what = f"{name} does not fit the others, which fit each other: its poses, clock or lens may be wrong"
        tried.append(
            trial.scored(
                Hypothesis(
                    "pose",
                    (name,),
                    what,
                    remedies.another_pose(trial.flight.cameras, index),
                    _PENALTY_OF_CAMERA,
                    replace(trial.described, rays=rays),
                )
            )
        )
    best, second = sorted(tried, key=lambda each: each.total)[:2]
    explains = best.total <= min(trial.base.total - MARGIN, second.total - _ALIKE)
    return [best] if explains and _leaves_no_doubt(trial.flight, best) else []


def _is_noise(flight: Sampled, cause: SceneOfMoments, hypotheses: list[Hypothesis]) -> bool:
    """Return True if larger errors of the poses fit markedly better than the scene without a mistake."""
    noise = min((each.cost for each in hypotheses if each.code == "noise"), default=np.inf)
    return bool(noise < np.inf) and noise < fit(flight, cause, "none", 0).cost - GAIN


def _faults(hypotheses: list[Hypothesis], stated: float, scene: SceneOfMoments) -> list[Hypothesis]:
    """Return the faults of one camera's poses that fit best, one of each code; none if they gain too little.

    Args:
        hypotheses: all that were tried.
        stated: the cost of a fit without a fault.
        scene: as described.
    """
    best = min((each.cost for each in hypotheses), default=np.inf)
    # Where even the best fits badly, errors are larger than their model: chi^2 counts for less.
    pictures = int(np.isfinite(scene.rays[..., 0]).any(axis=-1).sum())
    if not best <= stated - GAIN * max(1.0, best / pictures):
        return []
    alike: dict[str, Hypothesis] = {}
    for each in sorted(hypotheses, key=lambda each: (each.penalty > _DISCRETE, each.cost)):
        if each.cost <= best + _ALIKE_COST:
            alike.setdefault(each.code, each)
    return list(alike.values())


def _of_turns(trial: Trial, tried: Sequence[Lateness]) -> list[Hypothesis]:
    """State the times that the backgrounds tell, where they tell them surely.

    Where they tell some, the rays help to say whose these are: other times of one camera change how its rays
    meet those of the others, times of all alike do not.
    """
    if not tried or tried[0].gain < LEAST_GAIN:
        return []
    late = max(tried, key=lambda each: each.gain + _gain_of_rays(trial, each))
    if late.gain < LEAST_GAIN:
        return []
    if late.slower == 1 and not is_sure_clock(late):
        return []
    names, cameras = trial.names, trial.flight.cameras
    whose = "all cameras" if len(late.cameras) == len(names) else names[late.cameras[0]]
    by = "as the turning of their backgrounds shows"
    if late.slower != 1:
        code, remedy = "frame_rate", remedies.frame_rate(cameras, late.cameras, late.slower)
        what = f"the frame rate of {whose} is {remedies.times_faster(late.slower)}, {by}"
    else:
        code, remedy = "clock", remedies.clock(cameras, late.cameras, late.late_s)
        what = f"the pictures of {whose} were taken {remedies.earlier_or_later(late.late_s)}, {by}"
    found = {"turning_gain": round(late.gain, 1)}
    found |= {"clock_sigma_s": _rounded(late.sigma_s)} if late.slower == 1 else {}
    named = tuple(names[index] for index in late.cameras)
    return [Hypothesis(code, named, what, remedy, 0.0, None, sigmas=found)]


def _gain_of_rays(trial: Trial, late: Lateness) -> float:
    """Return by how much other times of some cameras lower the chi^2 of the rays; 0 of times of all."""
    if len(late.cameras) == len(trial.names):
        return 0.0
    slower = np.ones(len(trial.names))
    slower[list(late.cameras)] = late.slower
    late_s = np.zeros(len(trial.names))
    late_s[list(late.cameras)] = late.late_s
    scene = scene_of(trial.flight, trial.described, late_s=late_s, slower=slower)
    costs = [fit(trial.flight, each, "none", 0).cost for each in (_same_moments(trial, scene), scene)]
    return costs[0] - costs[1] if np.isfinite(costs).all() else 0.0


def _of_logs(trial: Trial) -> Iterator[Hypothesis]:
    """Find cameras that fly the same path, or start at the same place: no picture is needed for that.

    Pictures tell where the logs have their zeros.

    Drones that hover together may also be apart in another unit: then the zeros have to explain more.
    """
    cameras = trial.flight.cameras
    logs = {camera.name: (camera.entry, camera.camera.trajectory) for camera in cameras}
    for doubt in doubts_of_logs(logs):
        remedy, sigmas, scene = doubt.remedy, dict[str, float](), None
        if doubt.code == "origin":
            shifts, sigma = origins(trial.flight, trial.described)
            if np.isfinite(shifts).all() and sigma.any():
                remedy = remedies.own_origins(cameras, shifts)
                sigmas = {"shift_sigma_m": round(float(sigma.max()), 2)}
                if doubt.evidence["apart_m"] < _HOVERING_M:
                    moved = trial.described.position + shifts[:, None]
                    scene = replace(trial.described, position=moved)
        penalty = 0.0 if scene is None else 1.1 * (len(trial.moving) - 1)
        names = tuple(doubt.cameras)
        found = Hypothesis(
            doubt.code, names, doubt.what, remedy, penalty, scene, same_scatter=True, sigmas=sigmas
        )
        yield trial.scored(found)


# --- faults of one camera's poses ----------------------------------------------------------------------


def _of_faults(trial: Trial) -> Iterator[Hypothesis]:
    """Fit a fault of each moving camera's poses: where its log has zero and north, and how it is turned."""
    located = trial.flight.hips is not None or trial.flight.ground is not None
    for index in trial.every:
        for name, penalty in _PENALTIES.items():
            if index not in trial.moving and name != "focal":
                continue
            if name in ("north", "zero") and len(trial.names) == 2 and index == 0 and not located:
                continue  # of two, one alone can be turned against the other
            fault = fit(trial.flight, trial.described, name, index, _first_turn(trial, name, index))
            yield trial.scored(_of_fault(trial, fault, penalty))


def _of_noise(trial: Trial, stated: float) -> list[Hypothesis]:
    """Try if errors of all poses, or of one camera's, some times larger than stated, fit as a fault would.

    Args:
        trial: the flight.
        stated: the cost of a fit with the errors as stated.

    Returns:
        That of all, and that of one camera where it fits markedly better; none that explains nothing, or
        where nothing is stated of the errors.
    """
    if not all(trial.flight.cameras[index].states_noise for index in trial.moving):
        return []
    found = [_noisiest(trial, stated)]
    if len(trial.names) > 2 and trial.moving:  # of two, either errs more
        of_one = (
            _noisier(trial, lasting, 1.0, [index])  # errors that change are shared among rays: whose is open
            for index, lasting in product(trial.moving, _NOISE_FACTORS_OF_ONE)
        )
        one = min(of_one, key=lambda each: each.cost)
        found += [one] if one.cost < found[0].cost - GAIN else []  # else all may err alike
    return [each for each in found if each.cost < stated]


def _noisiest(trial: Trial, stated: float) -> Hypothesis:
    """Fit errors of all poses that last, that change, and of both kinds, by the best factors."""
    factors = [(factor, 1.0) for factor in _NOISE_FACTORS] + [(1.0, factor) for factor in _NOISE_FACTORS]
    found = [_noisier(trial, lasting, changing, trial.every) for lasting, changing in factors]
    half = len(_NOISE_FACTORS)
    both = [min(part, key=lambda each: each.cost) for part in (found[:half], found[half:])]
    if all(each.cost < stated for each in both):
        chosen = [factors[found.index(each)] for each in both]
        found.append(_noisier(trial, chosen[0][0], chosen[1][1], trial.every))
    return min(found, key=lambda each: each.cost)


def _noisier(trial: Trial, lasting: float, changing: float, group: Sequence[int]) -> Hypothesis:
    """Fit errors of some cameras' poses that are larger by given factors: lasting ones, changing ones."""
    scene = trial.described
    larger = np.ones((len(trial.names), 2))
    larger[list(group)] = lasting, changing
    constant2 = np.maximum(scene.sigma[:, :2] ** 2 - scene.sigma[:, 4:] ** 2, 0.0)
    sigma = scene.sigma.copy()
    sigma[:, 2:] *= larger[:, 1:]
    sigma[:, :2] = np.sqrt(larger[:, :1] ** 2 * constant2 + sigma[:, 4:] ** 2)
    wider = replace(scene, sigma=sigma)
    # Larger errors are less likely to be what they are: 6 of each camera, and 2 of each picture.
    pictures = np.isfinite(scene.rays[..., 0]).any(axis=-1).sum(axis=1)
    before, after = (picture_variance(each) for each in (scene, wider))
    unlikely = 12 * len(group) * np.log(lasting) + 2 * float(pictures @ np.log(after / before))
    parts = (("constant", lasting), ("changing", changing))
    said = ", ".join(f"{part} ones {factor:g} times" for part, factor in parts if factor > 1)
    everyone, one = len(group) == len(trial.names), trial.names[group[0]]
    what = "errors of the poses are larger than stated"
    if not everyone:
        what = f"the poses of {one} do not fit the other cameras: their errors are larger than stated"
    return Hypothesis(
        "noise" if everyone else "pose",
        trial.names if everyone else (one,),
        f"{what}, {said}",
        remedies.pose_noise(trial.flight.cameras, group, lasting, changing),
        np.inf,  # its score says nothing: larger errors excuse everything
        wider,
        cost=fit(trial.flight, wider, "none", 0).cost + unlikely,
    )


_NOISE_FACTORS = (2.0, 4.0, 8.0, 16.0)
_NOISE_FACTORS_OF_ONE = (4.0, 8.0, 16.0, 32.0)  # a camera whose poses are wrong throughout
_PENALTIES = {
    "shift": 1.8,
    "heading": 1.3,
    "north": 1.8,
    "zero": 2.2,
    "pitch": 1.3,
    "roll": 1.5,
    "focal": 1.3,
}
_TURNS = np.radians([0, 45, 90, 135, 180, -135, -90, -45])


def _first_turn(trial: Trial, name: str, index: int) -> float:
    """Return from which turn to search: a fit from there finds the best within some 30 deg."""
    if name in ("shift", "focal"):
        return 0.0
    turns = (_TURNS[0], _TURNS[1], _TURNS[-1]) if name == "pitch" else _TURNS

    def misfit(turn: float) -> float:
        solved = solve(undone(trial.described, name, index, np.zeros(3), turn))
        chi2 = solved.chi2[solved.views >= 2]
        return float(np.median(chi2)) if chi2.size else np.inf

    return float(min(turns, key=misfit))


def _of_fault(trial: Trial, fault: Fault, penalty: float) -> Hypothesis:
    cameras, index, degrees = trial.flight.cameras, fault.index, fault.turn_deg
    name = trial.names[index]
    far = f"{np.linalg.norm(fault.shift):.1f} m"
    mounted = fault.name in ("pitch", "roll", "focal")  # of one camera, whatever the others
    said = {
        "shift": f"the log of {name} has its zero {far} from the world's",
        "north": f"the log of {name} has its north {degrees:+.0f} deg from the world's",
        "zero": f"the log of {name} has its zero {far} and its north {degrees:+.0f} deg from the world's",
        "heading": f"the heading of {name} is {degrees:+.0f} deg from what is logged",
        "pitch": f"{name} looks {abs(degrees):.0f} deg {higher_or_lower(degrees)} than stated",
        "roll": f"{name} is rolled by {degrees:+.0f} deg about the optical axis",
        "focal": f"the focal length of {name} is {zoom(fault.turn_rad):.3g} times what is stated",
    }[fault.name]
    codes = {"heading": "pose", "pitch": "mount", "roll": "mount", "focal": "intrinsics"}
    code = codes.get(fault.name, "origin")
    if code == "intrinsics":
        remedy = remedies.intrinsics(cameras, [index], zoom(fault.turn_rad))
    elif code == "origin":
        remedy = remedies.origin(cameras, index, fault.shift, degrees)
    elif mounted:
        own = turn_about("x" if fault.name == "pitch" else "z", degrees)
        remedy = remedies.mount(cameras, [index], lambda mount: mount @ own)
    else:
        remedy = remedies.mount(cameras, [index], lambda mount: turn_about("z", degrees) @ mount)
    return Hypothesis(
        code,
        (name,) if mounted else pair_of(trial, [index]),
        said if mounted else said + relative_to(trial, [index]),
        remedy,
        penalty,
        fault.scene,
        cost=fault.cost + _COST_OF_NUMBER * FREE[fault.name],
        sigmas=fault.sigmas,
    )


def _with_sigma(trial: Trial, cause: Hypothesis) -> Hypothesis:
    """Add how sure a tilt of several cameras is, which was searched by its score."""
    if cause.code != "mount" or cause.penalty <= _DISCRETE or cause.sigmas or cause.scene is None:
        return cause
    group = [trial.names.index(name) for name in cause.cameras]
    sigma_deg = tilt_sigma_deg(trial.flight, cause.scene, group)
    return replace(cause, sigmas={"turn_sigma_deg": round(sigma_deg, 2)})


def _doubt(cause: Hypothesis, described: Score, scene: SceneOfMoments) -> Doubt:
    evidence = {"residual_px": residual_px(scene, solve(scene)), "score": round(described.total, 2)}
    if cause.score is not None and cause.scene is not None:
        evidence |= {
            "residual_px_if": residual_px(cause.scene, solve(cause.scene)),
            "score_if": round(cause.score.total, 2),
            "stature_m": _rounded(described.stature_m),
            "stature_m_if": _rounded(cause.score.stature_m),
        }
    evidence |= cause.sigmas
    return Doubt(
        code=cause.code,
        cameras=list(cause.cameras),
        what=cause.what,
        evidence={name: value for name, value in evidence.items() if np.isfinite(value)},
        remedy=cause.remedy,
    )


def _rounded(value: float) -> float:
    return round(float(value), 3)


# What is odd about a person, by the name it has in a score: the code of its doubt, and the sentence.
_ODD = {
    "size": ("scale", "the person is {stature_m:.3g} m tall; grown-ups are {usual:.2f} m, 95 % within 17 %"),
    "shape": ("body", "the lengths of the limbs are not in the proportions of people"),
    "limp": ("body", "the lengths of the limbs change over time, by {limb_spread:.0%}"),
    "upright": ("body", "the person does not stand upright, but leans by {lean_deg:.0f} deg"),
    "wander": ("body", "the person leans to and fro"),
    "face": ("body", "the face looks backwards, or left is right"),
    "crossed": ("body", "limbs cross: left and right are exchanged in the names of some joints, not of all"),
    "bend": ("body", "knees or elbows bend the wrong way"),
    "course": ("body", "the person walks sideways or backwards"),
    "slide": ("body", "the foot that stands slides, with {foot_mps:.1f} m/s"),
    "speed": ("body", "the person is faster than people run: {pace_mps:.1f} m/s"),
    "climb": ("body", "the person rises and falls faster than people do: {climb_mps:.1f} m/s"),
    "above": ("ground", "the person is {above_m:.1f} m above the drones"),
    "ground": ("ground", "the feet are {feet_above_ground_m:+.1f} m from the ground of the map"),
    "beside": ("ground", "the person is beside the map"),
    "level": ("ground", "the feet rise by {rise_m:.1f} m on a way of {walked_m:.1f} m"),
    "unposed": ("clock", "pictures were taken when nothing logs a pose: {unposed_share:.0%} of one camera's"),
    "actor": ("actor", "the person is {from_actor_m:.1f} m from the logged actor"),
    "actor_path": ("actor", "the person takes another way than the logged actor, {path_apart_m:.1f} m apart"),
    "unused": ("residual", "{unused_share:.0%} of the joints cannot be used: their rays miss each other"),
    "behind": ("residual", "joints are behind the cameras that see them"),
    "parallax": ("residual", "the cameras look from the same side: the rays hardly cross"),
}
# What is less odd than this many standard deviations is not worth a sentence.
_LEAST_ODD = 2.0


def _oddities(described: Score, scene: SceneOfMoments, flight: Sampled, *, alone: bool) -> list[Doubt]:
    """State what is odd about the description as such, the oddest of each code, the oddest first.

    Where no cause is stated beside it (`alone`), the rays are what is odd if nothing else is.
    """
    names = [camera.name for camera in flight.cameras]
    solved = solve(scene)
    odd = sorted(described.odd.items(), key=lambda item: -item[1].sigmas)
    found: dict[str, Doubt] = {}
    for name, (sigmas, measured) in odd:
        if sigmas >= _LEAST_ODD and name in _ODD:
            code, said = _ODD[name]
            what = said.format(usual=STATURE_M, **measured)
            evidence = {key: _rounded(value) for key, value in (*measured.items(), ("sigmas", sigmas))}
            found.setdefault(code, Doubt(code=code, cameras=names, what=what, evidence=evidence, remedy=""))
    if described.misfit > _LEAST_ODD or (alone and not found):
        times = f"{described.misfit:.1f} times"
        what = f"the rays miss each other by {times} what keypoints and poses are stated to err by"
        evidence = {
            "misfit": round(described.misfit, 2),
            "residual_px": residual_px(scene, solved),
            "scatter": round(described.scatter, 2),
        }
        each = zip(names, residuals_px(scene, solved), strict=True)
        evidence |= {f"residual_px_{name}": value for name, value in each}
        evidence = {name: value for name, value in evidence.items() if np.isfinite(value)}
        found["residual"] = Doubt(code="residual", cameras=names, what=what, evidence=evidence, remedy="")
    return list(found.values())
