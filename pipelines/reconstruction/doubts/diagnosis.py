"""Doubts about a flight: what is odd about it, and the alternative to its description that explains that.

A flight whose score is small is believed, unless a clock or a frame rate explains markedly more. Else every
alternative is tried. All are compared by one number: by how much the score and the chi^2 of the rays fall,
less the price of the alternative. The best is named if that is enough, and if nothing odd is left with it. If
none is, the doubt is stated without a cause.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.reconstruction.background_tracks import Followed
from pipelines.reconstruction.doubts import alternatives, remedies
from pipelines.reconstruction.doubts.alternatives import (
    Alternative,
    Numbers,
    Trial,
)
from pipelines.reconstruction.doubts.logs import doubts_of_logs
from pipelines.reconstruction.doubts.scene import (
    JOINTS,
    STATURE_M,
    Sampled,
    SceneOfMoments,
    sample,
    scene_of,
    stature_m,
)
from pipelines.reconstruction.doubts.score import (
    Fit,
    Score,
    fit,
    picture_variance,
    residuals_px,
    score,
    solve,
    surprise,
    unposed,
)
from pipelines.reconstruction.doubts.turning import LEAST_GAIN, Lateness, all_turns, is_sure_clock, lateness
from pipelines.reconstruction.loading import load_truth
from pipelines.reconstruction.observations import Camera
from pipelines.session.description import Description, Doubt, Interpolation
from pipelines.session.maps import each_map
from pipelines.session.people import logged_actor

TIMES = ("clock", "frame_rate")
"""Codes of what is tried on every flight."""

# Score that clocks and frame rates must gain to be scored exactly: half of what their margin asks.
_LEAST_GAIN_OF_TIMES = 1.0
# By how much an alternative must lower the objective, beyond its price, to be named.
_MARGIN = 3.0
# Chi^2 that counts as much as one of the score.
_COST_OF_SCORE = 4.7
# Score of a description from which more than times is tried.
_ODD = 3.0
# Scatter of rays from which more than times is tried, whatever the score; 0.35 to 0.7 on right flights.
_SCATTERED = 0.65
# Misfit of rays from which more than times is tried, whatever the score; 0.4 to 1.6 on right flights.
_MISSED = 1.8
# Chi^2 of constant errors of poses from which numbers of one camera are tried.
_STRAINED = 10.0
# Standard deviations from which a single unusual measure is a doubt at any score.
_STRANGE = 5.0
# The same of the stature: mistakes of scale are less rare than people below 1.27 m or above 2.12 m.
_STRANGE_SIZE = 2.5
# Score of a description above which it is doubted although no alternative explains it.
_DOUBTFUL = 6.0
# Alternatives that lower the objective by this much less than the best are stated beside it.
_ALIKE = 1.0
# Numbers may be of five magnitudes, each e times the other: twice the logarithm of that is paid for it.
_OF_ANY_SIZE = 3.2
# So many alternatives of the best scores are fitted to the rays.
_FITTED = 12
# Alternatives whose scores are farther from the best need no exact score.
_SPARE = 2.0
# Clocks that are off by more leave no pictures in common in short flights.
_LONGEST_CLOCK_S = 3.0
# The grid of clocks has this step; between its values the score is smooth.
_CLOCK_STEP_S = 0.1
# Smaller offsets cannot be told from noise by the score.
_LEAST_CLOCK_S = 0.05
# Beside a clock that scores worse than the stated one by more than this lies no better one.
_REACH = 1.0
# A flight is doubted without a cause if some change lowers the objective by so much, and leaves a doubt.
_WITHOUT_CAUSE = 9.0
# Rays of a right flight scatter and miss each other by less, also where a remedy is not exact.
_MEETING, _LEFT_MISFIT = 0.9, 2.5
# Sums of chi^2 in other pictures, of which a clock's search tries many, differ by so many deviations.
_MOST_BY_CHANCE = 2.0


def doubts_of(
    folder: Path,
    description: Description,
    cameras: Sequence[Camera],
    *,
    chosen: Sequence[Int64],
    followed: Mapping[str, object],
    aside: Callable[[Camera, Followed, Interpolation], tuple[float, float] | None],
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
        aside: finds by how much a camera looks beside its log (`background.turned_aside`).
        pose_noise: the value of `--pose-noise`, if any.

    Raises:
        DataError: a table or map of the session is damaged.
    """
    for doubt in description.doubts:
        if doubt.code == "unit" and set(doubt.cameras) == set(description.cameras):
            return [doubt]  # rays tell little in a world of another size
    last = deque(each_map(folder) if description.map is not None else (), maxlen=1)
    actor, between = logged_actor(folder, description), description.pose_interpolation
    known = partial(
        sample, cameras, description, actor=actor, last_map=last[0] if last else None, pose_noise=pose_noise
    )
    first_ns = [description.cameras[camera.name].frames.first_t_ns for camera in cameras]
    late = lateness(cameras, all_turns(cameras, followed), between, first_ns)
    flight = _more_plausible(known(chosen=chosen), known())
    truth = load_truth(folder, description, JOINTS)
    if flight is not None and truth is not None:
        size_m = stature_m(truth.position[:, 0])
        flight = flight._replace(truth_m=size_m if np.isfinite(size_m) else None)
    looks = {}
    for index, camera in enumerate(flight.cameras if flight is not None else ()):
        seen = followed.get(camera.name)
        # Attitudes by pictures are not compared with themselves.
        if isinstance(seen, Followed) and camera.entry.picture_map is None:
            looks[index] = partial(aside, camera.camera, seen, between)
    found = diagnose(flight, late, looks)
    # A gimbal that nothing uses, where it can be, explains more than any other change would.
    unused = [doubt for doubt in description.doubts if doubt.code == "unused" and found]
    is_mended = any(doubt.remedy for doubt in unused)
    return [*unused, *(doubt for doubt in found if not is_mended or not doubt.remedy)]


def doubts_of_clocks(description: Description, moved: Mapping[str, Mapping[str, float | str]]) -> list[Doubt]:
    """State which clocks were moved against what is stated of them, and by what evidence."""
    background = "the turning of their background"
    evidence = {"background": f"{background} shows", "keypoints": "the people in them show"}
    evidence |= {"log": f"{background} and the people in all pictures show"}
    doubts = []
    for name, found in moved.items():
        late_s, sigma_s = float(found["offset_s"]), float(found["sigma_s"])
        offset_s = description.cameras[name].clock.offset_s + late_s
        either = found["by"] == "keypoints" and len(description.cameras) == 2
        beside = ", though the other camera's clock may be the wrong one" if either else ""
        what = f"the pictures of {name} were taken {remedies.earlier_or_later(late_s)}"
        if found["by"] == "log":
            side = "late" if late_s < 0 else "early"
            what = f"the times of the log of {name} are {abs(late_s):.3f} s too {side}"
        what += f", as {evidence[str(found['by'])]} (sigma {sigma_s:.3f} s); the estimate uses that{beside}"
        clock = "log_clock" if found["by"] == "log" else "clock"
        known = {f"{clock}_s": round(late_s, 3), f"{clock}_sigma_s": round(sigma_s, 3)}
        remedy = "" if beside or found["by"] == "log" else f"cameras.{name}.clock.offset_s: {offset_s:.3f}"
        doubts.append(Doubt(code="clock", cameras=[name], what=what, evidence=dict(known), remedy=remedy))
    return doubts


def _more_plausible(chosen: Sampled | None, prominent: Sampled | None) -> Sampled | None:
    """Return the flight with the less odd person; the first if they are alike.

    Where most detections of both are others, the prominent person is not the one who was logged.
    """
    if chosen is None or prominent is None:
        return None
    one, other = (
        np.concatenate([camera.pixels.reshape(-1, 2) for camera in flight.cameras])
        for flight in (chosen, prominent)
    )
    if np.array_equal(one, other, equal_nan=True):
        return chosen
    both = np.isfinite(one + other)
    if both.any() and np.mean(one[both] != other[both]) > 0.5:
        prominent = prominent._replace(hips=None)
    return min(chosen, prominent, key=lambda flight: score(scene_of(flight)).total)


def diagnose(
    flight: Sampled | None,
    late: Sequence[Lateness] = (),
    looks: Mapping[int, Callable[[], tuple[float, float] | None]] | None = None,
) -> list[Doubt]:
    """Find what is odd about a flight, and why, that first that explains the most.

    A flight of one camera, one without people, or whose cameras share no time, is not doubted here. A world
    on its side is named where no usual convention turns it upright.

    Args:
        flight: the flight.
        late: what the backgrounds tell of the cameras' times.
        looks: what finds the angle, and its standard deviation, rad, by which a camera looks beside its log.
    """
    if flight is None or len(flight.cameras) < 2:
        return []
    trial = Trial(flight, scene_of(flight))
    if not np.isfinite(trial.described.rays).any():
        return []
    found = score(trial.described)
    # A turned world leaves rays and bodies as they are; rolled cameras mirror the body.
    mirrored = any(found.odd[name].sigmas >= _STRANGE for name in ("face", "bend") if name in found.odd)
    fits = found.misfit < _MISSED and found.scatter < _MEETING and not mirrored
    objective = Objective(trial, found)
    tried: list[Tried | None] = [*_of_logs(objective), *_of_turns(objective, late)]
    strange = _is_strange(found)
    odd = strange or found.total >= _ODD or found.scatter >= _SCATTERED or found.misfit >= _MISSED
    if odd:
        tried += map(objective.scored, alternatives.discrete(trial))
        tried += map(objective.with_numbers, alternatives.numbers_of_all(trial))
    is_strained = odd or objective.described.strain >= _STRAINED
    if is_strained:
        tried += map(objective.with_numbers, alternatives.numbers_of_one(trial))
        tried += map(objective.with_noise, alternatives.larger_errors(trial))
    if "size" in found.odd and is_strained:
        dearer = 0.0 if found.odd["size"].sigmas >= _STRANGE_SIZE else _MARGIN
        size = fit(partial(alternatives.scaled, trial.described), np.log([STATURE_M / found.stature_m]))
        fitted = float(size.numbers[0]), float(np.sqrt(size.covariance[0, 0]))
        tried += map(objective.scored, alternatives.scales(trial, found.stature_m, fitted, dearer))
    # Times come last, since most of them need no exact score beside what fits by then.
    tried += map(objective.scored, alternatives.rates(trial))
    groups = [*([index] for index in trial.every), *([trial.every] if odd and trial.moving else [])]
    tried += map(objective.best_clock, groups)
    causes, gained = _causes(objective, [each for each in tried if each is not None], odd)
    if not causes or causes[0].alternative.code not in ("axes", "convention"):  # which turn the world, too
        level = alternatives.level(trial, solve(trial.described).joints) if fits else ()
        causes = [Tried(each) for each in level] or causes
    if is_strained and not _is_explained(causes):
        causes = _of_looks(trial, looks or {}) or causes
    codes = [cause.alternative.code for cause in causes if cause.score]
    doubts = [_doubt(trial, each, found, codes) for each in causes]
    if doubts or strange or found.total >= _DOUBTFUL or gained >= _WITHOUT_CAUSE:
        named = {doubt.code for doubt in doubts}
        named |= {"scale"} if "unit" in named else set()
        named |= {"clock"} if "frame_rate" in named else set()
        unusual = _unusual_measures(trial, found, alone=not doubts)
        doubts += [each for each in unusual if each.code not in named]
    return doubts


def _is_strange(described: Score) -> bool:
    """Test if a single unusual measure is a doubt at any total."""
    # A log may end early, or begin high above the ground.
    limits = {"size": _STRANGE_SIZE, "unposed": np.inf, "below": np.inf}
    return any(each.sigmas >= limits.get(name, _STRANGE) for name, each in described.odd.items())


# --- one number by which all alternatives are compared ----------------------------------------------------


class Tried(NamedTuple):
    """An alternative, and how well it fits; the objective has two parts, the score and the rays."""

    alternative: Alternative
    score: Score | None = None  # None of what is seen directly
    cost: float = np.inf  # of what is fitted: chi^2 of the rays, and what the numbers cost
    numbers: int = 0  # how many were fitted
    before: tuple[float, float] = (np.inf, np.inf)  # the objective of the description
    after: tuple[float, float] = (-np.inf, -np.inf)  # and with this change and its price

    @property
    def total(self) -> float:
        """The score with the price; what is seen directly, without a scene, wins over everything."""
        return -np.inf if self.score is None else self.score.total + self.alternative.price

    @property
    def gains(self) -> tuple[float, float]:
        """By how much the alternative lowers the two parts of the objective, beyond its price."""
        with np.errstate(invalid="ignore"):  # infinite both, where no rays can be fitted
            by_score, by_rays = np.subtract(self.before, self.after)
        return float(by_score), float(by_rays)

    @property
    def gain(self) -> float:
        """By how much the alternative lowers the objective."""
        return sum(self.gains)

    def is_enough(self, odd: bool) -> bool:
        """Test if the gain is more than chance.

        People who lie or stand look alike at all times. So where nothing is odd, and of times of all cameras,
        the rays alone must tell it; of times of one camera, they must fit as well, or tell it if nothing else
        does.
        """
        by_score, by_rays = self.gains
        if self.alternative.code in TIMES:
            is_scored = by_score >= _LEAST_GAIN_OF_TIMES
            least = -_ALIKE if is_scored and self.alternative.same_pictures is None else _MARGIN
        else:
            least = -np.inf if odd else _MARGIN
        # Whoever is far too tall or small is doubted anyway.
        margin = 0.0 if self.alternative.code == "scale" else _MARGIN
        return self.gain >= margin and by_rays >= least


class Objective:
    """The score of a scene, and the chi^2 of its rays with constant errors of all poses.

    Stated errors have a level that is not exact: beyond one of each picture, chi^2 counts by its logarithm
    (the likelihood of Student's t).
    """

    def __init__(self, trial: Trial, base: Score) -> None:
        self.trial, self.base, self.best_total = trial, base, base.total
        self._pictures = np.isfinite(trial.described.rays[..., 0]).any(axis=-1).sum(axis=1)  # [C]
        self.described = self._fit(trial.described)

    def _fit(self, scene: SceneOfMoments, beside: Fit | None = None) -> Fit:
        return fit(lambda _: scene, beside=beside)

    def scored(self, alternative: Alternative, cost: float = np.inf) -> Tried:
        """Score an alternative."""
        if alternative.scene is None:
            return Tried(alternative)
        least = _LEAST_GAIN_OF_TIMES if alternative.code in TIMES else -_SPARE
        limit = min(self.best_total + _SPARE, self.base.total - least)
        same = alternative.same_scatter
        found = score(alternative.scene, self.base, same_scatter=same, limit=limit)
        tried = Tried(alternative, found, cost)
        self.best_total = min(self.best_total, tried.total)
        return tried

    def best_clock(self, group: list[int]) -> Tried | None:
        """Search the clock of one camera, or of all: a grid, then ever smaller steps about its best."""

        def at(late_s: float) -> tuple[Tried, float]:
            return self.scored(alternatives.of_times(self.trial, group, late_s)), late_s

        step_s = _CLOCK_STEP_S
        grid = np.arange(-_LONGEST_CLOCK_S, _LONGEST_CLOCK_S + step_s / 2, step_s)
        best, late_s = min(map(at, grid.tolist()), key=lambda each: each[0].total)
        while np.isfinite(best.total) and best.total < self.base.total + _REACH and step_s > 0.004:
            step_s /= 2
            beside = [(best, late_s), at(late_s - step_s), at(late_s + step_s)]
            best, late_s = min(beside, key=lambda each: each[0].total)
        return best if abs(late_s) >= _LEAST_CLOCK_S else None

    def _at_moments_of(self, scene: SceneOfMoments) -> SceneOfMoments:
        """Return the description at the moments that a scene shows."""
        described = self.trial.described
        seen = np.isfinite(scene.rays[..., :1] + scene.position[:, :, None, :1]).any(axis=2, keepdims=True)
        return replace(described, rays=np.where(seen, described.rays, np.nan))

    def with_numbers(self, free: Numbers) -> Tried | None:
        """Fit numbers, from where the rays miss each other least; None if they are too small to matter.

        Numbers cost as chi^2, beside their fit, the logarithm of how much surer the rays make them (the Occam
        factor; MacKay 2003, chapter 28), with a prior of their own size. So one that stated errors leave open
        costs little, and gains little.
        """

        def misfit(numbers: Float) -> float:
            solved = solve(free.make(numbers))
            chi2 = np.where(solved.in_front, solved.chi2, np.inf)[solved.views >= 2]
            return float(np.median(chi2)) if chi2.size else np.inf

        start = min(free.starts, key=misfit) if len(free.starts) > 1 else free.starts[0]
        found = fit(free.make, start)
        if not np.isfinite(found.cost):
            return None  # too few joints are seen by two cameras
        alternative = free.alternative(found.numbers, found.covariance)
        if alternative is None:
            return None
        size, normal = alternatives.sizes(found.numbers), np.linalg.pinv(found.covariance)
        surer = float(np.linalg.slogdet(np.eye(len(size)) + size[:, None] * normal * size)[1])
        tried = self.scored(replace(alternative, scene=found.scene), found.cost + surer + _OF_ANY_SIZE)
        return tried._replace(numbers=len(size))

    def with_noise(self, tried: Sequence[Alternative]) -> Tried:
        """Take the factor of larger errors that fits best; 6 of a camera and 2 of a picture pay for it."""
        described, known = self.trial.described, []
        for each in tried:
            wider = each.scene or described
            uncertain = described.sigma[:, 0] > 0  # exact poses have no larger errors
            of_cameras = wider.sigma[uncertain, 0] / described.sigma[uncertain, 0]
            constant = 12 * float(np.log(of_cameras).sum())
            changing = np.log(picture_variance(wider) / picture_variance(described))
            cost = self._fit(wider).cost + constant + 2 * float(self._pictures @ changing)
            known.append(self.scored(each, cost))
        return min(known, key=lambda each: each.cost)

    def _rays(self, cost: float, scene: SceneOfMoments) -> float:
        pictures = float(self._pictures.sum())
        return 2 * pictures * float(np.log1p(cost / pictures)) / _COST_OF_SCORE + surprise(unposed(scene))

    def _cost_of_pictures(self, scene: SceneOfMoments) -> float:
        """Return the chi^2 of the description in the pictures that a scene shows, for as many as it has."""
        described = self.trial.described
        seen = np.isfinite(described.rays[..., 0]).any(axis=2)
        shown = np.where(np.isfinite(scene.rays[..., 0]).any(axis=2), scene.stated_ns, np.nan)
        begin, end = (bound.reduce(shown, axis=1, keepdims=True) for bound in (np.fmin, np.fmax))
        kept = seen & (described.stated_ns >= begin) & (described.stated_ns <= end)
        if not kept.any():
            return np.inf
        rays = np.where(kept[..., None, None], described.rays, np.nan)
        return self._fit(replace(described, rays=rays), self.described).cost * float(seen.sum() / kept.sum())

    def compared(self, tried: Tried) -> Tried:
        """Compare an alternative and its price with the description.

        Other times leave moments and pictures out: then the description is judged by the same ones, since
        those left out may show somebody else. If all times are others, pictures or poses are others, with
        other errors: whichever saves less counts. Larger errors excuse everything: of them only the chi^2
        counts.
        """
        alternative, scene = tried.alternative, tried.alternative.scene
        if scene is None or tried.score is None:
            return tried
        is_time, of_one = alternative.code in TIMES, alternative.same_pictures is None
        beside = self.described if is_time else None
        cost = tried.cost if np.isfinite(tried.cost) else self._fit(scene, beside).cost
        found = self._told(tried, self.base.total, self.described.cost, cost)
        by_score, by_rays = found.gains
        # The same pictures cost the description no more, and chance excuses rays that fit worse.
        if not (is_time or alternative.code == "videos_swapped") or by_score + max(by_rays, 0.0) < _MARGIN:
            return found
        same = self._at_moments_of(scene)
        before = min(self._fit(same, self.described).cost, self._cost_of_pictures(scene))
        total = min(self.base.total, score(same, self.base).total)
        if alternative.same_pictures is not None:
            of_poses = alternative.same_pictures()
            saved = self._fit(self._at_moments_of(of_poses), beside).cost - self._fit(of_poses, beside).cost
            cost = max(cost, before - saved) if np.isfinite(saved) else np.inf
        if is_time:
            others = [self.trial.names.index(name) for name in alternative.cameras]
            deviation = before * float(np.sqrt(2 * self._pictures[others].sum()) / self._pictures.sum())
            # Few rates of one camera are tried, and its rays must go on meeting those of the others.
            chance = deviation if of_one and alternative.code == "frame_rate" else _MOST_BY_CHANCE * deviation
            cost = before + float(np.sign(cost - before)) * max(0.0, abs(cost - before) - chance)
        return self._told(tried, total, before, cost)

    def _told(self, tried: Tried, total: float, before: float, cost: float) -> Tried:
        """Put the objective beside an alternative: of the description, by score and chi^2, and of itself."""
        scores = (0.0, 0.0) if tried.alternative.price == np.inf else (total, tried.total)
        described = self._rays(before, self.trial.described)
        rays = described, self._rays(cost, tried.alternative.scene or self.trial.described)
        return tried._replace(before=(scores[0], rays[0]), after=(scores[1], rays[1]))


def _causes(objective: Objective, tried: Sequence[Tried], odd: bool) -> tuple[list[Tried], float]:
    """Return the alternatives that lower the objective next to most, one of each code; none if by too little.

    Of each code the one with the fewest numbers is taken; those without one are first. What leaves
    something odd is no cause. Also return the most that any alternative lowers the objective by.
    """
    by_score = sorted((each for each in tried if not np.isfinite(each.cost)), key=lambda each: each.total)
    fitted = [each for each in tried if np.isfinite(each.cost)]
    known = [objective.compared(each) for each in [*by_score[:_FITTED], *fitted]]
    weighed = sorted((each for each in known if each.is_enough(odd)), key=lambda each: -each.gain)
    causes: list[Tried] = []
    for each in weighed:
        if causes and each.gain < causes[0].gain - _ALIKE:
            break
        if _leaves_no_doubt(each.alternative):
            causes.append(each)
    simplest: dict[str, Tried] = {}
    for each in sorted(causes, key=lambda each: each.numbers):
        simplest.setdefault(each.alternative.code, each)
    by_gain = sorted(simplest.values(), key=lambda each: (each.numbers > 0, -each.gain))
    told = [each._replace(alternative=_of_either(objective.trial, each, known)) for each in by_gain]
    return told, weighed[0].gain if weighed else 0.0


def _of_either(trial: Trial, cause: Tried, known: Sequence[Tried]) -> Alternative:
    """Return a cause of one of two cameras; as one of both, if the other's would explain about as much.

    Then no remedy is sure. Where nothing else places the flight, one log is placed beside the other: the
    flight is then right but for its place, which nobody knows.
    """
    own = cause.alternative
    other = tuple(name for name in trial.names if name not in own.cameras)
    if len(trial.names) != 2 or len(other) != 1:
        return own
    beside = own.code == "origin" and trial.is_loose_pair
    alike = (
        _leaves_no_doubt(each.alternative)
        for each in known
        if (each.alternative.code, each.alternative.cameras) == (own.code, other)
        and cause.gain - each.gain < _MARGIN
    )
    if not beside and not any(alike):
        return own
    what = f"{own.what} (relative to {other[0]}: either may be wrong)"
    return replace(own, cameras=trial.names, what=what, remedy=own.remedy if beside else "")


def _leaves_no_doubt(alternative: Alternative) -> bool:
    """Test if the flight would not be doubted as the alternative has it.

    It may explain the rays and still leave a flight that cannot be right, for example one in which all
    sizes shrink to zero.
    """
    if alternative.scene is None:
        return True
    found = score(alternative.scene)
    meets = found.misfit < _LEFT_MISFIT and found.scatter < _MEETING
    # Larger errors of poses are no cause that mends the rays.
    return found.total < _DOUBTFUL and (meets or alternative.price == np.inf) and not _is_strange(found)


# --- what is seen without a scene -------------------------------------------------------------------------


def _of_turns(objective: Objective, tried: Sequence[Lateness]) -> list[Tried]:
    """State the times that the backgrounds tell, where they tell them surely.

    The rays help to say whose these are: other times of one camera change how its rays meet those of the
    others, times of all alike do not.
    """
    if not tried or tried[0].gain < LEAST_GAIN:
        return []
    trial = objective.trial

    def gain(late: Lateness) -> float:
        if len(late.cameras) == len(trial.names):
            return late.gain
        scene = trial.with_times(late.cameras, late.late_s, late.slower)
        found = objective.compared(objective.scored(Alternative("clock", (), "", "", np.inf, scene)))
        return late.gain + _COST_OF_SCORE * found.gain

    late = max(tried, key=gain)
    if late.gain < LEAST_GAIN or (late.slower == 1 and not is_sure_clock(late)):
        return []
    group, evidence = list(late.cameras), {"turning_gain": round(late.gain, 1)}
    evidence |= {"clock_sigma_s": round(late.sigma_s, 3)} if late.slower == 1 else {}
    seen = alternatives.of_times(trial, group, late.late_s, late.slower)
    what = f"{seen.what}, as the turning of their backgrounds shows"
    return [Tried(replace(seen, what=what, scene=None, evidence=evidence))]


def _is_explained(causes: Sequence[Tried]) -> bool:
    """Test for a cause beside which attitudes need no other: numbers that are fitted to people hide them."""
    if not causes:
        return False
    first = causes[0]
    fits = first.score is not None and first.score.misfit < _MISSED
    return first.numbers == 0 or (first.alternative.code in ("mount", "intrinsics") and fits)


def _of_looks(trial: Trial, looks: Mapping[int, Callable[[], tuple[float, float] | None]]) -> list[Tried]:
    """State which cameras look beside their logs, as their backgrounds show, and let their films say how."""
    found = {index: seen for index, find in looks.items() if (seen := find()) is not None}
    degrees = {trial.names[index]: np.degrees(seen).round(1).tolist() for index, seen in found.items()}
    angles = ", ".join(f"{name} by {angle:.0f} deg" for name, (angle, _) in degrees.items())
    evidence = {f"aside_deg_{name}": angle for name, (angle, _) in degrees.items()}
    evidence |= {f"aside_sigma_deg_{name}": sigma for name, (_, sigma) in degrees.items()}
    what = f"the background shows that the camera looks elsewhere than logged: {angles}"
    remedy = trial.lines(list(found), remedies.by_pictures)
    return [Tried(Alternative("mount", tuple(degrees), what, remedy, 0.0, evidence=evidence))] * bool(found)


def _of_logs(objective: Objective) -> list[Tried]:
    """Find cameras that fly the same path, or start at the same place: no picture is needed for that.

    Pictures tell where the logs have their zeros.
    """
    found, trial = [], objective.trial
    for doubt in doubts_of_logs({each.name: (each.entry, each.camera.trajectory) for each in trial.cameras}):
        seen = Tried(Alternative(doubt.code, tuple(doubt.cameras), doubt.what, doubt.remedy, 0.0))
        if doubt.code == "origin":
            placed = objective.with_numbers(alternatives.own_origins(trial, tuple(doubt.cameras), doubt.what))
            seen = seen if placed is None else Tried(placed.alternative)
        found.append(seen)
    return found


# --- texts of doubts ----------------------------------------------------------------------------------


def _doubt(trial: Trial, cause: Tried, described: Score, codes: Sequence[str]) -> Doubt:
    """State an alternative; without a remedy, if others of all the `codes` explain the flight as well."""
    alternative = cause.alternative
    others = " or ".join(f"`{code}`" for code in codes if code != alternative.code)
    evidence = {"residual_px": residuals_px(trial.described)[0], "score": round(described.total, 2)}
    if cause.score is not None and alternative.scene is not None:
        evidence |= {
            "residual_px_if": residuals_px(alternative.scene)[0],
            "score_if": round(cause.score.total, 2),
            "stature_m": round(described.stature_m, 3),
            "stature_m_if": round(cause.score.stature_m, 3),
        }
    evidence |= alternative.evidence
    told: dict[str, float | dict[str, float]] = {k: v for k, v in evidence.items() if np.isfinite(v)}
    if np.isfinite(cause.gain):
        before, after = (round(sum(parts), 2) for parts in (cause.before, cause.after))
        told["tried"] = {"misfit_before": before, "misfit_after": after, "doubts_after": 0}
    what = alternative.what + (f" (not sure: {others} explains the flight as well)" if others else "")
    remedy, named = "" if others else alternative.remedy, list(alternative.cameras)
    return Doubt(code=alternative.code, cameras=named, what=what, evidence=told, remedy=remedy)


# What is odd about a person, by the name it has in a score: the code of its doubt, and the sentence.
_UNUSUAL = {
    "size": ("scale", "the person is {stature_m:.3g} m tall; grown-ups are {usual:.2f} m, 95 % within 17 %"),
    "shape": ("body", "the lengths of the limbs are not in the proportions of people"),
    "limp": ("body", "the lengths of the limbs change over time, by {limb_spread:.0%}"),
    "upright": ("body", "the person does not stand upright, but leans by {lean_deg:.0f} deg"),
    "face": ("body", "the face looks backwards, or left is right"),
    "crossed": ("body", "limbs cross: left and right are exchanged in the names of some joints, not of all"),
    "bend": ("body", "knees or elbows bend the wrong way"),
    "course": ("body", "the person walks sideways or backwards"),
    "slide": ("body", "the foot that stands slides, with {foot_mps:.1f} m/s"),
    "tread": ("body", "legs go at {legs_over_pace:.1f} times the pace: the standing foot slides"),
    "speed": ("body", "the person is faster than people run: {pace_mps:.1f} m/s"),
    "above": ("ground", "the person is {above_m:.1f} m above the drones"),
    "below": (
        "axes",
        "all drones fly {below_m:.1f} m or more below zero: their positions count z downwards, or zero is"
        " high above the ground",
    ),
    "ground": ("ground", "the feet are {feet_above_ground_m:+.1f} m from the ground of the map"),
    "beside": ("ground", "the person is beside the map"),
    "level": ("ground", "the feet rise by {rise_m:.1f} m on a way of {walked_m:.1f} m"),
    "unposed": (
        "clock",
        "pictures were taken when nothing logs a pose: {unposed_share:.0%} of each camera's",
    ),
    "actor": ("actor", "the person is {from_actor_m:.1f} m from the logged actor"),
    "actor_path": ("actor", "the person takes another way than the logged actor, {path_apart_m:.1f} m apart"),
    "unused": ("residual", "{unused_share:.0%} of the joints cannot be used: their rays miss each other"),
    "behind": ("residual", "joints are behind the cameras that see them"),
    "parallax": ("residual", "the cameras look from the same side: the rays hardly cross"),
}
# What is less odd than this many standard deviations is not worth a sentence.
_LEAST_UNUSUAL = 2.0


def _unusual_measures(trial: Trial, described: Score, *, alone: bool) -> list[Doubt]:
    """State what is odd about the description as such, the oddest of each code, the oddest first.

    Where no cause is stated beside it (`alone`), the rays are what is odd if nothing else is.
    """
    names = list(trial.names)
    found: dict[str, Doubt] = {}
    for name, (sigmas, measured) in sorted(described.odd.items(), key=lambda item: -item[1].sigmas):
        if sigmas >= _LEAST_UNUSUAL and name in _UNUSUAL:
            code, words = _UNUSUAL[name]
            what = words.format(usual=STATURE_M, **measured)
            known = {key: round(value, 3) for key, value in (*measured.items(), ("sigmas", sigmas))}
            found.setdefault(code, Doubt(code=code, cameras=names, what=what, evidence=known, remedy=""))
    if described.misfit > _LEAST_UNUSUAL or (alone and not found):
        evidence = {"misfit": round(described.misfit, 2), "scatter": round(described.scatter, 2)}
        keys = ["residual_px", *(f"residual_px_{name}" for name in names)]
        evidence |= zip(keys, residuals_px(trial.described), strict=True)
        evidence = {name: value for name, value in evidence.items() if np.isfinite(value)}
        what = f"the rays miss each other by {described.misfit:.1f} times what keypoints and poses"
        what += " are stated to err by"
        found["residual"] = Doubt(code="residual", cameras=names, what=what, evidence=evidence, remedy="")
    return list(found.values())
