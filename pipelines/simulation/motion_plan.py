"""Plan of a motion: the body's way, times and places of the footsteps, and the keys of every curve."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.simulation import gait

# Points this close follow an arc of half a metre to a tenth of a millimetre.
_SPACING_M = 0.02
_WALK_MPS2, _RUN_MPS2 = 0.9, 1.9  # mean accelerations
# A person cuts a corner over about this length on either side.
_ROUNDED_M = 0.4


@dataclass(frozen=True)
class WayPart:
    """A straight line or an arc."""

    length_m: float
    heading: float  # rad at its beginning, counterclockwise from east
    turn: float  # rad to the left over its length
    speed_mps: float  # as requested
    run: float  # 0 if walked, 1 if run

    @property
    def end_heading(self) -> float:
        """Heading at the end, rad."""
        return self.heading + self.turn

    def end(self, start: Float) -> Float:
        """Return the end point [2], m."""
        return np.asarray(self._points(start, np.array([self.length_m]))[0])

    def _points(self, start: Float, along_m: Float) -> Float:
        """Return points [N, 2] m of the way; straight on beyond its ends."""
        if abs(self.turn) < 1e-9:
            ahead, left = along_m, np.zeros_like(along_m)
        else:
            angle = np.clip(along_m, 0.0, self.length_m) * self.turn / self.length_m
            radius = self.length_m / self.turn
            over = along_m - np.clip(along_m, 0.0, self.length_m)
            ahead = radius * np.sin(angle) + over * np.cos(angle)
            left = radius * (1 - np.cos(angle)) + over * np.sin(angle)
        cosine, sine = np.cos(self.heading), np.sin(self.heading)
        moved = np.stack([cosine * ahead - sine * left, sine * ahead + cosine * left], axis=1)
        return np.asarray(start + moved, dtype=np.float64)


class Way:
    """Parts one after the other, smoothed so that position and heading bend without a jerk.

    Every point is the mean, weighed by a raised cosine, of the points within 0.4 m of it on the way: lines
    stay straight, an arc of radius r shrinks by 1 cm^2 / r, corners are cut, and both ends are kept.
    """

    def __init__(self, start: Float, parts: Sequence[WayPart]) -> None:
        from scipy.interpolate import CubicSpline

        self.length_m = sum(part.length_m for part in parts)
        margin = 2 * _ROUNDED_M
        count = int(np.ceil((self.length_m + 2 * margin) / _SPACING_M)) + 1
        along = np.linspace(-margin, self.length_m + margin, count)
        points = np.empty((count, 2))
        begin, place = 0.0, np.asarray(start, dtype=np.float64)
        for index, part in enumerate(parts):
            inside = along >= begin if index else np.ones(count, dtype=bool)
            points[inside] = part._points(place, along[inside] - begin)
            begin, place = begin + part.length_m, part.end(place)
        half = int(_ROUNDED_M / (along[1] - along[0]))
        weight = 1 + np.cos(np.pi * np.arange(-half, half + 1) / (half + 1))
        weight /= weight.sum()
        smooth = np.stack([np.convolve(points[:, axis], weight, mode="valid") for axis in (0, 1)], axis=1)
        inner = along[half : len(along) - half]
        self._spline = CubicSpline(inner, smooth)
        tangent = self._spline(inner, 1)
        heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        # Before and after an arc the way goes straight on, so that the mean bends less at its ends.
        ends = np.interp([0.0, self.length_m], inner, heading)
        missing = [parts[0].heading - ends[0], parts[-1].end_heading - ends[1]]
        heading += np.interp(inner, [0.0, self.length_m], missing)
        self._heading = CubicSpline(inner, heading)

    def place(self, along_m: Float) -> tuple[Float, Float]:
        """Compute the place [N, 2] m after some way, and the heading [N] in rad."""
        return (
            np.asarray(self._spline(along_m), dtype=np.float64),
            np.asarray(self._heading(along_m), dtype=np.float64),
        )


@dataclass(frozen=True)
class Pace:
    """Speeds over time, as knots: time in s from the start, speed in m/s, share of running."""

    knots: tuple[tuple[float, float, float], ...]


def pace(parts: Sequence[WayPart]) -> Pace:
    """Compute speeds over time from a stand to a stand.

    Each part has its own speed where it is long enough for that.

    Speed goes from one knot to the next as a smooth step, at `_WALK_MPS2` or `_RUN_MPS2` on average; where a
    part is slower than the next, it is slower to its end.
    """
    gains = [_RUN_MPS2 if part.run else _WALK_MPS2 for part in parts]
    between = [0.0, *(min(a.speed_mps, b.speed_mps) for a, b in pairwise(parts)), 0.0]
    for i, (part, gain) in enumerate(zip(parts, gains, strict=True)):
        between[i + 1] = min(between[i + 1], (between[i] ** 2 + 2 * gain * part.length_m) ** 0.5)
    for i in reversed(range(len(parts))):
        between[i] = min(between[i], (between[i + 1] ** 2 + 2 * gains[i] * parts[i].length_m) ** 0.5)
    knots = [(0.0, 0.0, parts[0].run)]
    for i, (part, gain) in enumerate(zip(parts, gains, strict=True)):
        enter, leave = between[i], between[i + 1]
        peak = min(part.speed_mps, ((enter**2 + leave**2) / 2 + gain * part.length_m) ** 0.5)
        ramps_m = (2 * peak**2 - enter**2 - leave**2) / (2 * gain)
        for duration_s, speed in (
            ((peak - enter) / gain, peak),
            ((part.length_m - ramps_m) / peak, peak),
            ((peak - leave) / gain, leave),
        ):
            if duration_s > 1e-6:
                knots.append((knots[-1][0] + duration_s, speed, part.run))
    return Pace(tuple(knots))


# Keys closer than this count as one moment, so that no curve jumps.
_SAME_MOMENT_S = 1e-6


class Keys:
    """Named curves through key values; a curve without keys is 0.

    Between keys a curve is the monotone cubic of Fritsch & Carlson 1980: its slope is continuous, it never
    leaves the span of two neighbouring keys, and it stays exactly constant between equal ones. This keeps a
    planted foot in its place. Before the first and after the last key the curve is constant.
    """

    def __init__(self) -> None:
        self._keys: dict[str, list[tuple[float, float]]] = {}

    def add(self, name: str, *keys: tuple[float, float]) -> None:
        """Append (time in s, value) pairs; a pair at or before the time of the last key replaces that key."""
        curve = self._keys.setdefault(name, [])
        for t_s, value in keys:
            while curve and curve[-1][0] >= t_s - _SAME_MOMENT_S:
                curve.pop()
            curve.append((t_s, value))

    def last(self, name: str) -> float:
        """Return the last value of a curve."""
        curve = self._keys.get(name)
        return curve[-1][1] if curve else 0.0

    def pulse(self, name: str, *keys: tuple[float, float]) -> None:
        """Append keys of something that departs from 0 and returns to it: the first and last value are 0."""
        self.add(name, (keys[0][0], 0.0), *keys[1:-1], (keys[-1][0], 0.0))

    def at(self, name: str, t_s: Float) -> Float:
        """Return the values [T] of a curve."""
        from scipy.interpolate import PchipInterpolator

        curve = self._keys.get(name)
        if not curve:
            return np.zeros(len(t_s))
        times, values = np.array(curve).T
        # Held ends are keys as well, so that the slope is 0 where they begin.
        times = np.concatenate([[times[0] - 1.0], times, [times[-1] + 1.0]])
        values = np.concatenate([values[:1], values, values[-1:]])
        held = np.clip(t_s, times[0], times[-1])
        return np.asarray(PchipInterpolator(times, values)(held), dtype=np.float64)


Curve = Callable[[Float], Float]

LEFT, RIGHT = 0, 1
_STANDING_HALF_M, _WALKING_HALF_M, _RUNNING_HALF_M = 0.085, 0.048, 0.025  # between the feet, per 1.75 m
# The feet of somebody who stands point outward by this angle.
_TOE_OUT = np.radians(6.0)
_TURN_RATE, _TURN_CADENCE = np.radians(65.0), 1.9
# The last steps before a stand are no slower than this.
_LAST_STEPS_CADENCE = 1.5
# A foot that is farther away than this share of the leg is lifted.
_REACH = 0.72
# The cadence rises by this times the slope, because steps are shorter uphill.
_SHORTER_UPHILL = 0.9
_STILL_M, _STILL_RAD = 0.01, np.radians(2.0)
# The time at which a foot is out of reach is searched for in pieces of 2 s.
_LOOKED_AHEAD = 400


@dataclass(frozen=True)
class Footstep:
    """A foot leaves the ground and comes down elsewhere."""

    lift_s: float
    strike_s: float
    place: Float  # [2] m, below the ankle when the sole is flat
    yaw: float  # rad
    run: float  # 0 walks, 1 runs


@dataclass(frozen=True)
class Stretch:
    """A time during which the body travels or turns; its place is a function of time."""

    start_s: float
    end_s: float
    way: Way | None
    along_m: Curve | None  # an antiderivative of the speed, of seconds since the start; None on the spot
    place: Float  # [2] m, where there is no way
    turn: tuple[float, float]  # rad, heading from and to, where there is no way

    def at(self, t_s: Float) -> tuple[Float, Float]:
        """Return the place [N, 2] m and the heading [N] rad; constant before the start and after the end."""
        since = np.clip(t_s - self.start_s, 0.0, self.end_s - self.start_s)
        if self.way is not None and self.along_m is not None:
            return self.way.place(self.along_m(since))
        share = since / (self.end_s - self.start_s)
        smooth = share * share * share * (10 - 15 * share + 6 * share * share)
        heading = self.turn[0] + smooth * (self.turn[1] - self.turn[0])
        return np.broadcast_to(self.place, (len(t_s), 2)), heading


@dataclass(frozen=True)
class _Rhythm:
    """Times of the steps of a stretch, at N moments from some seconds before it to some seconds after."""

    start_s: float
    knots: Float  # [K, 3] seconds since then, m/s, share of running
    since_s: Float  # [N] since then
    moments_s: Float  # [N]
    steps: Float  # [N] since then, and parts of one
    places: Float  # [N, 2] m, of the body

    def when(self, step: float) -> float:
        """Return the time at which so many steps are taken."""
        return self.start_s + float(np.interp(step, self.steps, self.since_s))

    def gait_at(self, t_s: float) -> tuple[float, float]:
        """Return the speed in m/s and the share of running in the gait."""
        times, speeds, runs = self.knots.T
        speed = float(np.interp(t_s - self.start_s, times, speeds))
        return speed, float(np.interp(t_s - self.start_s, times, runs)) * gait.running(speed)

    def outruns(self, step: Footstep, reach_m: float) -> float:
        """Return the first time at which the body is as far from a foot as a leg reaches, or infinity."""
        soonest = int(np.searchsorted(self.moments_s, step.strike_s + 0.1, side="right"))
        for begin in range(soonest, len(self.moments_s), _LOOKED_AHEAD):  # long ways have many steps
            ahead = slice(begin, begin + _LOOKED_AHEAD)
            far = np.hypot(*(self.places[ahead] - step.place).T) > reach_m
            if far.any():
                return float(self.moments_s[begin + int(far.argmax())])
        return np.inf


def _reached(stretch: Stretch, strike_s: float, above_s: float, speed: float) -> tuple[Float, float]:
    """Compute the body's place and heading when it stands above a foot that has come down."""
    (now, place), (_, heading) = stretch.at(np.array([strike_s, above_s]))
    # A person who still gains speed does not yet reach as far ahead.
    mean = float(np.hypot(*(place - now))) / (above_s - strike_s)
    if mean > 1.1 * speed:
        early_s = strike_s + (above_s - strike_s) * 1.1 * speed / mean
        (place,), (heading,) = stretch.at(np.array([early_s]))
    return place, heading


@dataclass
class Plan:
    """The motion planned up to `t_s`; then the body stands at `place` and looks along `heading`."""

    place: Float  # [2] m
    heading: float  # rad
    leg_m: float
    ground: Callable[[Float], Float]  # height of places [N, 2]
    step_width: float = 1.0  # by the usual
    t_s: float = 0.0
    stride: float = 0.0  # rad, of the last strike
    keys: Keys = field(default_factory=Keys)
    stretches: list[Stretch] = field(default_factory=list)
    feet: tuple[list[Footstep], list[Footstep]] = field(default_factory=lambda: ([], []))

    def __post_init__(self) -> None:
        """Put both feet beside each other under the body."""
        for foot in (LEFT, RIGHT):
            place, yaw = self._beside(foot, self.place, self.heading, 0.0, 0.0)
            self.feet[foot].append(Footstep(-2.0, -1.0, place, yaw, 0.0))
        self.keys.add("stride", (-1.0, 0.0))

    def body_at(self, t_s: Float, start: Float, heading: float) -> tuple[Float, Float]:
        """Compute the body's place [T, 2] m and heading [T] rad, from those at the start."""
        place = np.broadcast_to(start, (len(t_s), 2)).copy()
        towards = np.full(len(t_s), heading)
        for stretch in self.stretches:
            later = t_s >= stretch.start_s
            place[later], towards[later] = stretch.at(t_s[later])
        return place, towards

    # --- actions of the feet ----------------------------------------------------------------------------

    def stay(self, seconds: float) -> None:
        """Leave the feet where they are."""
        self.t_s += seconds

    def turn(self, angle: float) -> None:
        """Turn on the spot by an angle in rad, to the left if positive."""
        if abs(angle) < _STILL_RAD / 20:
            return
        duration_s = abs(angle) / _TURN_RATE * 1.4 + 0.3
        turn = (self.heading, self.heading + angle)
        stretch = Stretch(self.t_s, self.t_s + duration_s, None, None, self.place, turn)
        self._step_through(
            stretch, [(0.0, 0.0, 0.0)], first=LEFT if angle > 0 else RIGHT, least=_TURN_CADENCE
        )

    def travel(self, parts: Sequence[WayPart]) -> None:
        """Travel from a stand to a stand."""
        knots = pace(parts).knots
        stretch = self._along(parts, Pace(knots))
        self._step_through(stretch, knots, first=RIGHT)

    def run_up(self, parts: Sequence[WayPart], speeds: Pace, plant_s: float, foot: int) -> None:
        """Run so that `foot` strikes `plant_s` after the start, and take no step after that one.

        The caller plans the rest of the steps and sets the time.
        """
        stretch = self._along(parts, speeds)
        knots = [knot for knot in speeds.knots if knot[0] <= plant_s + 1e-9]
        count = max(2, round(float(self._phase(knots, 0.0)(np.array(plant_s)))))
        first = foot if count % 2 else 1 - foot
        self._walk_steps(stretch, knots, first, count)

    def step(self, foot: int, lift_s: float, strike_s: float, at: tuple[Float, float], run: float) -> None:
        """Put a foot beside the body's future place: its place [2] in m and its heading in rad."""
        self._put(foot, lift_s, strike_s, self._beside(foot, *at, 0.0, 0.0), run)

    # --- steps of a stretch ----------------------------------------------------------------------------

    def _along(self, parts: Sequence[WayPart], speeds: Pace) -> Stretch:
        from scipy.interpolate import CubicHermiteSpline

        times, values, run = np.array(speeds.knots).T
        along = CubicHermiteSpline(times, values, np.zeros_like(values)).antiderivative()
        way = Way(self.place, parts)
        for name, curve in (("speed", values), ("run", run)):
            self.keys.add(name, *zip(self.t_s + times, curve, strict=True))
        running = [gait.running(v) * r for v, r in zip(values, run, strict=True)]
        self.keys.add("running", *zip(self.t_s + times, running, strict=True))
        return Stretch(self.t_s, self.t_s + times[-1], way, along, self.place, (0.0, 0.0))

    def _phase(self, knots: Sequence[tuple[float, float, float]], least: float) -> Curve:
        """Return a function: steps since the start, by seconds since then."""
        from scipy.interpolate import CubicHermiteSpline

        cadence = [max(gait.cadence(v, r * gait.running(v), self.leg_m), least) for _, v, r in knots]
        times = [knot[0] for knot in knots]
        # Standing still at either end, the steps go on at a pace of their own.
        times, cadence = [times[0] - 5.0, *times, times[-1] + 5.0], [cadence[0], *cadence, cadence[-1]]
        phase = CubicHermiteSpline(times, cadence, np.zeros(len(times))).antiderivative()
        began = float(phase(0.0))
        return lambda t_s: phase(t_s) - began

    def _step_through(
        self,
        stretch: Stretch,
        knots: Sequence[tuple[float, float, float]],
        *,
        first: int,
        least: float = _LAST_STEPS_CADENCE,
    ) -> None:
        """Step until both feet stand under the body at the end of the stretch."""
        self._walk_steps(stretch, knots, first, None, least=least)

    def _walk_steps(
        self,
        stretch: Stretch,
        knots: Sequence[tuple[float, float, float]],
        first: int,
        count: int | None,
        *,
        least: float = 0.0,
    ) -> None:
        """Plan the steps of a stretch: `count` of them up to the last knot, or until both feet stand."""
        rhythm = self._rhythm(stretch, knots, count, least)
        landed, number = 0, 0
        while (landed < 2) if count is None else (number < count):
            number += 1
            foot = first if number % 2 else 1 - first
            strike_s = rhythm.when(number)
            speed, run = rhythm.gait_at(strike_s)
            in_air = gait.swing_steps(speed, run)
            # A person who slows down lifts the foot behind at the speed of the step before.
            before = gait.swing_steps(*rhythm.gait_at(rhythm.when(number - 1)))
            lift_s = max(rhythm.when(number - max(in_air, before)), stretch.start_s)
            lift_s = min(lift_s, rhythm.outruns(self.feet[foot][-1], _REACH * self.leg_m))
            # The stance lasts 2 - in_air steps.
            above_s = rhythm.when(number + gait.above_foot(run) * (2 - in_air))
            place, heading = _reached(stretch, strike_s, above_s, speed)
            self._put(foot, lift_s, strike_s, self._beside(foot, place, heading, speed, run), run)
            self.t_s = strike_s
            landed = landed + 1 if above_s >= stretch.end_s else 0
        self.stretches.append(stretch)
        (self.place,), (self.heading,) = (values.copy() for values in stretch.at(np.array([stretch.end_s])))

    def _rhythm(
        self, stretch: Stretch, knots: Sequence[tuple[float, float, float]], count: int | None, least: float
    ) -> _Rhythm:
        """Compute the cadence from the speed; steps are shorter where it is steep."""
        phase = self._phase(knots, least)
        duration_s = stretch.end_s - stretch.start_s
        since_s = np.linspace(-3.0, duration_s + 5.0, int((duration_s + 8.0) / 0.005))
        moments_s = stretch.start_s + since_s
        places, _ = stretch.at(moments_s)
        climbed = np.abs(np.diff(self.ground(places))) / np.maximum(
            np.hypot(*np.diff(places, axis=0).T), 1e-9
        )
        taken = np.diff(phase(since_s)) * (1 + _SHORTER_UPHILL * np.minimum(climbed, 1.0))
        steps = np.concatenate([[0.0], np.cumsum(taken)])
        steps -= np.interp(0.0, since_s, steps)
        if count is not None:
            steps *= count / np.interp(knots[-1][0], since_s, steps)
        return _Rhythm(stretch.start_s, np.array(knots), since_s, moments_s, steps, places)

    def _beside(
        self, foot: int, place: Float, heading: float, speed: float, run: float
    ) -> tuple[Float, float]:
        walks = min(speed / 0.9, 1.0)
        half = (1 - walks) * _STANDING_HALF_M + walks * ((1 - run) * _WALKING_HALF_M + run * _RUNNING_HALF_M)
        half *= self.step_width * self.leg_m / 0.86 * (1 if foot == LEFT else -1)
        across = half * np.array([-np.sin(heading), np.cos(heading)])
        return place + across, heading + _TOE_OUT * (1 if foot == LEFT else -1) * (1 - 0.6 * run)

    def _put(self, foot: int, lift_s: float, strike_s: float, at: tuple[Float, float], run: float) -> None:
        before = self.feet[foot][-1]
        place, yaw = at
        moved = float(np.hypot(*(place - before.place)))
        side = 0.0 if foot == LEFT else np.pi
        # The next stride angle, beyond the last strike's, that belongs to this foot.
        steps = np.ceil((self.stride - side) / (2 * np.pi) + 0.25)
        self.stride = side + 2 * np.pi * float(steps)
        self.keys.add("stride", (strike_s, self.stride))
        if moved < _STILL_M and abs(yaw - before.yaw) < _STILL_RAD:
            return
        self.feet[foot].append(Footstep(max(lift_s, before.strike_s + 0.05), strike_s, place, yaw, run))
