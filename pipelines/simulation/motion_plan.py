"""Plan of a motion: the body's way, times and places of the footsteps, and the keys of every curve."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.session.storage import own_table

# People walk at this speed if no other one is stated; the curves of feet and knees were fitted at it.
WALK_SPEED_MPS = 1.3
# People jog at this speed if no other one is stated.
JOG_SPEED_MPS = 2.7
# People who go faster than this run (Novacheck 1998).
FASTEST_WALK_MPS = 2.1
_RUNNING_FROM_MPS, _RUNNING_FULLY_MPS = 1.0, 1.9

# Step length over cadence is the same at all speeds of walking (Sekiya & Nagasaki 1998).
_WALK_RATIO_M_S = 0.0064 * 60
# The walk ratio holds for people with legs of this length.
_LEG_OF_WALK_RATIO_M = 0.93
# A first or last step takes no longer than at this cadence.
_SLOWEST_CADENCE = 1.1

_GAITS = own_table(__file__, "gait")
# In walking strides longer than that at 1.3 m/s the heel rises farther, by a share of the extra length.
_USUAL_STRIDE, _LONG_STRIDE_LIFTS = 1.09, 0.8


def running_share(speed_mps: float) -> float:
    """Return the share of running in the gait at a speed, for a person in a jog: 0 walks, 1 runs."""
    share = (speed_mps - _RUNNING_FROM_MPS) / (_RUNNING_FULLY_MPS - _RUNNING_FROM_MPS)
    share = min(max(share, 0.0), 1.0)
    return share * share * (3 - 2 * share)


def steps_per_s(speed_mps: float, run: float, leg_m: float) -> float:
    """Return steps per second; the cadence of runners depends little on their speed."""
    size = _LEG_OF_WALK_RATIO_M / leg_m
    walk = np.sqrt(max(speed_mps, 0.0) * size / _WALK_RATIO_M_S)
    slowest = _SLOWEST_CADENCE * np.sqrt(size)
    jog = (2.3 + 0.13 * speed_mps) * np.sqrt(size)
    return float((1 - run) * max(walk, slowest) + run * jog)


def swing_steps(speed_mps: float, run: float) -> float:
    """Return the time of a foot off the ground, in steps (halves of a stride): above 1 both feet fly."""
    walk = 2 * min(max(0.295 + 0.077 * speed_mps, 0.28), 0.43)  # 0.39 of a stride at 1.3 m/s
    jog = 2 * (1 - min(max(0.47 - 0.035 * speed_mps, 0.27), 0.44))  # 0.61 to 0.66 of a stride
    return (1 - run) * walk + run * jog


@dataclass(frozen=True)
class Roll:
    """Strike, roll and swing of a foot, as (share of stance or swing, value) keys."""

    strike_deg: float
    lift_deg: float
    stance_deg: tuple[tuple[float, float], ...]
    swing_deg: tuple[tuple[float, float], ...]
    clearance_m: tuple[tuple[float, float], ...]
    onward: tuple[tuple[float, float], ...]
    carries: float  # from this share of a swing on
    toes: float  # bend that they keep in swing: 0 straight, 1 level
    knee_deg: tuple[tuple[float, float], ...]


def roll(run: float, before: float, after: float) -> Roll:
    """Compute the roll of a foot (`run` 0 walks, 1 runs) between swings of shares of a full stride."""

    def mix(name: str) -> Any:
        walk, jog = np.array(_GAITS["walk"][name]), np.array(_GAITS["run"][name])
        return ((1 - run) * walk + run * jog).tolist()

    came, goes = (float(np.sin(np.pi / 2 * min(share, 1.0))) for share in (before, after))
    toes_up = (1 - run) * min(before, 1.0) + run * came
    heel_up = goes * (1 + (1 - run) * _LONG_STRIDE_LIFTS * max(after - _USUAL_STRIDE, 0.0))
    return Roll(
        strike_deg=toes_up * mix("strike_deg"),
        lift_deg=heel_up * mix("lift_deg"),
        stance_deg=tuple((share, heel_up * angle) for share, angle in mix("stance_deg")),
        swing_deg=tuple(
            (share, angle * (toes_up if angle > 0 else goes)) for share, angle in mix("swing_deg")
        ),
        clearance_m=tuple(
            (share, high * (goes if run > 0.5 else 0.6 + 0.4 * goes)) for share, high in mix("clearance_m")
        ),
        onward=tuple((share, there) for share, there in mix("onward")),
        carries=mix("carries"),
        toes=mix("toes"),
        knee_deg=tuple(
            (share, 4.0 + (angle - 4.0) * (1 - run) * came) for share, angle in _GAITS["walk"]["knee_deg"]
        ),
    )


@dataclass(frozen=True)
class Swing:
    """Motion of the body above the legs over a stride, [T] each; angles to the left are positive."""

    pelvis_yaw: Float  # rad: the hip of the leg in front goes with it
    pelvis_list: Float  # rad: the hip of the leg in the air is lower
    sway_m: Float  # towards the foot that carries
    chest_yaw: Float  # rad, of the heading: against the pelvis
    lean: Float  # rad forward
    shoulder: Float  # [T, 2] rad flexed, left then right
    elbow: Float  # [T, 2] rad
    abduction: Float  # [T, 2] rad


def body_swing(stride: Float, speed_mps: Float, run: Float, arm_share: float) -> Swing:
    """Compute pelvis, trunk and arms. The left heel strikes at stride angle 0, the right at pi.

    All but the arms' rest swells with the speed and is gone at 0. `run` is 0 for walking, 1 for running.
    """
    walk = 1 - run
    size = 1.3 * np.tanh(speed_mps * np.arctanh(1 / 1.3) / WALK_SPEED_MPS)  # 1 at the usual speed
    in_front = np.cos(stride)  # 1 at the left strike
    carried = np.sin(stride)  # 1 where the left foot stands alone
    shoulders, elbows = [], []
    for sign in (1.0, -1.0):
        # Perry: 24 deg extended at the heel strike of its side, then 8 flexed; elbow 20 to 44.
        shoulder = walk * (-4.0 - 18.0 * sign * in_front) + run * (-8.0 - 19.0 * sign * in_front)
        elbow = walk * (16.0 - 11.0 * sign * in_front) + run * (58.0 - 9.0 * sign * in_front)
        shoulders.append(np.radians(size * arm_share * shoulder))
        elbows.append(np.radians(14.0 + size * elbow))
    abducted = np.radians(7.0 + 8.0 * run)
    return Swing(
        pelvis_yaw=np.radians(-size * (4.0 * walk + 5.0 * run) * in_front),
        pelvis_list=np.radians(size * (3.5 * walk + 4.0 * run) * np.sin(stride + 0.3)),
        sway_m=size * (0.020 * walk + 0.010 * run) * carried,
        chest_yaw=np.radians(size * (4.0 * walk + 6.0 * run) * in_front),
        lean=np.radians(size * (2.0 * walk + 6.0 * run)),
        shoulder=np.stack(shoulders, axis=1),
        elbow=np.stack(elbows, axis=1),
        abduction=np.stack([abducted, abducted], axis=1),
    )


def bounce_m(stride: Float, step_s: Float, swing_share: Float) -> Float:
    """Compute the height of a runner's pelvis above its height at the strikes, every multiple of pi, [T] m.

    Free fall while both feet are off (`swing_share` of a step), a half sine on the springy leg; the speeds
    are equal where they meet (the spring-mass runner of Blickhan 1989).
    """
    since = np.mod(stride / np.pi, 1.0)  # of a step, from the strike
    flight = np.clip(swing_share, 0.0, 0.9)
    contact = 1.0 - flight
    up_mps = 9.81 * flight * step_s / 2
    on_leg = -up_mps * contact * step_s / np.pi * np.sin(np.pi * np.minimum(since / contact, 1.0))
    t = np.maximum(since - contact, 0.0) * step_s
    return np.asarray(on_leg + up_mps * t - 9.81 * t * t / 2, dtype=np.float64)


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


Pace = list[tuple[float, float, float]]
"""Speeds over time, as knots: time in s from the start, speed in m/s, share of running."""


def pace(parts: Sequence[WayPart]) -> Pace:
    """Compute speeds over time from a stand to a stand; long parts have their own, reached smoothly."""
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
    return knots


# Keys closer than this count as one moment, so that no curve jumps.
_SAME_MOMENT_S = 1e-6


class Keys:
    """Named curves through key values; a curve without keys is 0.

    Curves are monotone cubics (Fritsch & Carlson 1980): smooth, never beyond two neighbouring keys, and
    constant between equal ones, which keeps a planted foot in its place. They are constant before the first
    and after the last key.
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
        return speed, float(np.interp(t_s - self.start_s, times, runs)) * running_share(speed)

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
        first = LEFT if angle > 0 else RIGHT
        self._walk_steps(stretch, [(0.0, 0.0, 0.0)], first, None, least=_TURN_CADENCE)

    def travel(self, parts: Sequence[WayPart]) -> None:
        """Travel from a stand to a stand."""
        knots = pace(parts)
        stretch = self._along(parts, knots)
        self._walk_steps(stretch, knots, RIGHT, None, least=_LAST_STEPS_CADENCE)

    def run_up(self, parts: Sequence[WayPart], speeds: Pace, plant_s: float, foot: int) -> None:
        """Run so that `foot` strikes `plant_s` after the start, its last step; the caller plans the rest."""
        stretch = self._along(parts, speeds)
        knots = [knot for knot in speeds if knot[0] <= plant_s + 1e-9]
        count = max(2, round(float(self._phase(knots, 0.0)(np.array(plant_s)))))
        first = foot if count % 2 else 1 - foot
        self._walk_steps(stretch, knots, first, count, least=0.0)

    def step(self, foot: int, lift_s: float, strike_s: float, at: tuple[Float, float], run: float) -> None:
        """Put a foot beside the body's future place: its place [2] in m and its heading in rad."""
        self._put(foot, lift_s, strike_s, self._beside(foot, *at, 0.0, 0.0), run)

    # --- steps of a stretch ----------------------------------------------------------------------------

    def _along(self, parts: Sequence[WayPart], speeds: Pace) -> Stretch:
        from scipy.interpolate import CubicHermiteSpline

        times, values, run = np.array(speeds).T
        along = CubicHermiteSpline(times, values, np.zeros_like(values)).antiderivative()
        way = Way(self.place, parts)
        for name, curve in (("speed", values), ("run", run)):
            self.keys.add(name, *zip(self.t_s + times, curve, strict=True))
        running = [running_share(v) * r for v, r in zip(values, run, strict=True)]
        self.keys.add("running", *zip(self.t_s + times, running, strict=True))
        return Stretch(self.t_s, self.t_s + times[-1], way, along, self.place, (0.0, 0.0))

    def _phase(self, knots: Pace, least: float) -> Curve:
        """Return a function: steps since the start, by seconds since then."""
        from scipy.interpolate import CubicHermiteSpline

        cadence = [max(steps_per_s(v, r * running_share(v), self.leg_m), least) for _, v, r in knots]
        times = [knot[0] for knot in knots]
        # Standing still at either end, the steps go on at a pace of their own.
        times, cadence = [times[0] - 5.0, *times, times[-1] + 5.0], [cadence[0], *cadence, cadence[-1]]
        phase = CubicHermiteSpline(times, cadence, np.zeros(len(times))).antiderivative()
        began = float(phase(0.0))
        return lambda t_s: phase(t_s) - began

    def _walk_steps(
        self, stretch: Stretch, knots: Pace, first: int, count: int | None, *, least: float
    ) -> None:
        """Plan the steps of a stretch: `count` of them up to the last knot, or until both feet stand.

        `first` is the foot of the first one, `least` the least cadence.
        """
        rhythm = self._rhythm(stretch, knots, count, least)
        landed, number = 0, 0
        while (landed < 2) if count is None else (number < count):
            number += 1
            foot = first if number % 2 else 1 - first
            strike_s = rhythm.when(number)
            speed, run = rhythm.gait_at(strike_s)
            in_air = swing_steps(speed, run)
            # A person who slows down lifts the foot behind at the speed of the step before.
            before = swing_steps(*rhythm.gait_at(rhythm.when(number - 1)))
            lift_s = max(rhythm.when(number - max(in_air, before)), stretch.start_s)
            lift_s = min(lift_s, rhythm.outruns(self.feet[foot][-1], _REACH * self.leg_m))
            # The stance lasts 2 - in_air steps; at this share of it the pelvis passes above the ankle.
            above_s = rhythm.when(number + (0.36 - 0.05 * run) * (2 - in_air))
            place, heading = _reached(stretch, strike_s, above_s, speed)
            self._put(foot, lift_s, strike_s, self._beside(foot, place, heading, speed, run), run)
            self.t_s = strike_s
            landed = landed + 1 if above_s >= stretch.end_s else 0
        self.stretches.append(stretch)
        (self.place,), (self.heading,) = (values.copy() for values in stretch.at(np.array([stretch.end_s])))

    def _rhythm(self, stretch: Stretch, knots: Pace, count: int | None, least: float) -> _Rhythm:
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
