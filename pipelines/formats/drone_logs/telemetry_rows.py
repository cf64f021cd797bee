"""Cleaning of telemetry rows into tracks: one set of rules for every drone's log."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping, MutableMapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.formats.common.rows import NORM_TOLERANCE, describe_times, kept_rows
from pipelines.geometry.arrays import Bool, ClockFit, Float, Int64, Place, RelativeTo
from pipelines.geometry.clocks import fit_clock
from pipelines.geometry.mounting import attitude_from_angles, attitude_in_enu, level_heading
from pipelines.geometry.poses import interpolate_points, interpolate_rotations, multiply
from pipelines.session.errors import DataError
from pipelines.session.records import AttitudeTrack, Height, PositionTrack, Telemetry
from pipelines.session.registries import TelemetryChoice
from pipelines.session.storage import damaged

# Late messages scatter GPS times by less.
_UNEVEN_S = 0.5
# Receivers on drones report at least once a second.
_HELD_NS = 1_000_000_000
# The time since boot goes back by more only if the autopilot was restarted; a second link is late by less.
_RESTART_NS = 1_000_000_000
# The medians of so many messages before and after a restart or a step say how large it is.
_AROUND = 20
# A step of GPS time stays for this many fixes.
_LEAST_FIXES = 5
# Delays of fixes scatter by as much in some receivers.
_LEAST_STEP_NS = 100_000_000
# Beside such a step, fixes come with smaller differences in delay.
_STEADY_NS = 200_000_000
# Fewer intervals between changes do not show if they are regular.
_LEAST_REFRESHES = 4


class DroneLog(ABC):
    """Base of the readers of drones' own logs: they are described alike, by what is taken of them."""

    @abstractmethod
    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read positions and attitudes, as `registries.TelemetryFormat` says."""

    def describe(self, path: Path) -> dict[str, object]:
        """Describe positions, times, ranges, attitudes, clock and losses; or why nothing is taken."""
        try:
            found = self.read_telemetry(path, TelemetryChoice())
        except DataError as error:
            if error.code not in _DESCRIBED:
                raise
            return {"positions": 0, "why": f"{error.problem}; {error.remedy}"}
        track = found.position
        facts: dict[str, object] = {
            "positions": f"{len(track.t_ns)} of {track.name}",
            **describe_times(track.t_ns),
            "clock": found.clock,
        }
        columns = ("latitude_deg", "longitude_deg", "height_m") if track.on_earth else ("x_m", "y_m", "z_m")
        for name, values in zip(columns, track.values.T, strict=True):
            facts[name] = [round(float(value), 7) for value in (values.min(), values.max())]
        if track.on_earth:
            facts["heights"] = track.height
        for name, turned in (("body", found.body), ("gimbal", found.gimbal)):
            facts[f"{name}_attitudes"] = f"{len(turned.t_ns)} of {turned.name}" if turned else "none"
        if found.video_began is not None:
            facts["video_began_s"] = found.video_began[0] / 1e9
        return facts | {
            "notes": [note.removeprefix(f"{path}: ") for note in found.notes],
            **{f"dropped: {cause}": count for cause, count in found.dropped.items()},
        }


# A log without positions, or of several vehicles, is described by what it lacks.
_DESCRIBED = ("no-positions", "clock-unknown", "ambiguous")


def position_track(
    source: Path | str,
    name: str,
    t_ns: Int64,
    values: Float,
    dropped: MutableMapping[str, int],
    *,
    on_earth: bool,
    height: Height = "unknown",
    origin: Place | None = None,
    unusable: dict[str, Bool] | None = None,
) -> PositionTrack:
    """Drop the positions that cannot be used; count each in `dropped` under its first cause."""
    causes: dict[str, Bool] = dict(unusable or {})
    with np.errstate(invalid="ignore"):
        causes["not finite"] = np.asarray(~np.isfinite(values).all(axis=1))
        if on_earth:
            causes["not on Earth"] = (np.abs(values[:, 0]) > 90) | (np.abs(values[:, 1]) > 360)
            causes["no fix (0, 0)"] = np.asarray((values[:, :2] == 0).all(axis=1))
    found: dict[str, int] = {}
    keep = kept_rows(t_ns, causes, found)
    if not keep.any():
        counts = ", ".join(f"{count} {cause}" for cause, count in found.items()) or "it is empty"
        problem = f"{name} holds no usable position ({counts})"
        raise DataError(source, problem, "name another log", code="no-positions")
    for cause, count in found.items():
        dropped[cause] = dropped.get(cause, 0) + count
    return PositionTrack(name, t_ns[keep], values[keep], on_earth, height, origin)


def require_position(
    path: Path | str, found: Collection[str], wanted: str | None, lacking: str, remedy: str
) -> None:
    """Refuse a log without the position that is asked for, or without any (`lacking`)."""
    if wanted is not None and wanted not in found:
        problem = f"has no {wanted} position"
        raise DataError(path, problem, f"there is {', '.join(found) or 'none'}", code="no-positions")
    if not found:
        raise DataError(path, lacking, remedy, code="no-positions")


def attitude_track(
    name: str,
    t_ns: Int64,
    quaternion_xyzw: Float,
    dropped: MutableMapping[str, int],
    *,
    stated: Mapping[RelativeTo, Float] | None = None,
) -> AttitudeTrack | None:
    """Drop unusable attitudes [N, 4] (FLU in ENU), counted as "attitude ..."; return None without any."""
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.linalg.norm(quaternion_xyzw, axis=1)
        causes: dict[str, Bool] = {
            "attitude not finite": ~np.isfinite(norm),
            "attitude not a unit quaternion": np.abs(norm - 1) > NORM_TOLERANCE,
        }
    found: dict[str, int] = {}
    keep = kept_rows(t_ns, causes, found, prefix="attitude ")
    if not keep.any():
        return None
    for cause, count in found.items():
        dropped[cause] = dropped.get(cause, 0) + count
    of_kept = {reference: angles[keep] / norm[keep, None] for reference, angles in (stated or {}).items()}
    return AttitudeTrack(name, t_ns[keep], quaternion_xyzw[keep] / norm[keep, None], "world", of_kept)


def turned_as_stated(yaw_pitch_roll_deg: Float, *, relative_to: RelativeTo = "world") -> Float:
    """Return quaternions [N, 4] of autopilots' angles [N, 3]: FRD in NED, yaw from north to east."""
    return attitude_in_enu(of_angles(yaw_pitch_roll_deg), relative_to=relative_to, axes="ned")


def of_angles(yaw_pitch_roll_deg: Float) -> Float:
    """Return quaternions [N, 4] of angles [N, 3], in the axes of the angles."""
    with np.errstate(invalid="ignore"):
        return attitude_from_angles(yaw_pitch_roll_deg, order="ypr", units="deg")


def same_angles_for_every_reference(attitude: Float) -> Mapping[RelativeTo, Float]:
    """Return the same angles for every reference, because the log does not name one and the user may."""
    return {"world": attitude, "body": attitude, "heading": attitude}


def fixes_track(
    source: Path | str, name: str, t_ns: Int64, values: Float, fixed: Bool, dropped: MutableMapping[str, int]
) -> PositionTrack:
    """Apply `position_track` to latitude, longitude and height above the sea [N, 3] with 3D fixes [N]."""
    unusable = {"no 3D fix": ~fixed}
    return position_track(
        source, name, t_ns, values, dropped, on_earth=True, height="sea level", unusable=unusable
    )


def pictures_on_gps_time(source: Path, t_ns: Int64, fit: ClockFit | None, choice: TelemetryChoice) -> Int64:
    """Return the times of pictures, sorted and each once, in UTC as in `on_gps_time`."""
    fit = on_gps_time(source, fit, choice.time, [])
    return np.unique(t_ns) if fit is None else np.unique(fit.other_ns(np.unique(t_ns)))


def world_from_heading(body: AttitudeTrack, t_ns: Int64, heading_from_gimbal: Float) -> Float:
    """Return attitudes [N, 4] of an FLU gimbal in ENU, from an FRD one with yaw relative to the nose."""
    limits = {"max_gap_ns": _HELD_NS, "max_extrapolation_ns": _HELD_NS // 10}
    turned = interpolate_rotations(body.t_ns, body.quaternion_xyzw, t_ns, **limits)
    in_heading = attitude_in_enu(heading_from_gimbal, relative_to="heading", axes="ned")
    return multiply(level_heading(turned), in_heading)


def on_one_clock(
    path: Path | str,
    position: PositionTrack,
    body: AttitudeTrack | None,
    gimbal: AttitudeTrack | None,
    *,
    fit: ClockFit | None,
    notes: Iterable[str],
    dropped: dict[str, int],
) -> Telemetry:
    """Assemble the telemetry of a log; convert all stamps to UTC if there is a fit of its clock."""
    if fit is not None:
        position = replace(position, t_ns=fit.other_ns(position.t_ns))
        body = replace(body, t_ns=fit.other_ns(body.t_ns)) if body else None
        gimbal = replace(gimbal, t_ns=fit.other_ns(gimbal.t_ns)) if gimbal else None
    return Telemetry(
        position=position,
        body=body,
        gimbal=gimbal,
        clock="UTC by GPS" if fit else "boot",
        fit=fit,
        notes=tuple(f"{path}: {note}" for note in notes),
        dropped=dropped,
    )


@dataclass(frozen=True)
class Boots:
    """Parts of a log between restarts of the autopilot, at which its time since boot falls."""

    places: Int64  # [B - 1] of the first frequent message of each later part, as bytes or by another clock
    before: Int64  # [B - 1] of the last one before it
    before_ns: Int64  # [B - 1] its time since boot
    shifts_ns: Int64  # [B] by which the times of each part go on in those of the first
    known: Bool  # [B] False where no other clock tells the shift

    def parts(self, boot_ns: Int64, places: Int64) -> Int64:
        """Return the part of each message [N]; between two frequent messages, by its time since boot."""
        part = np.searchsorted(self.places, places, side="right")
        for k, (last, first, last_ns) in enumerate(
            zip(self.before, self.places, self.before_ns, strict=True), start=1
        ):
            part[(places > last) & (places < first) & (boot_ns < last_ns - _RESTART_NS // 2)] = k
        return part

    def going_on(self, boot_ns: Int64, places: Int64) -> Int64:
        """Return the times [N] of messages since the first boot; 0 where they are not known."""
        part = self.parts(boot_ns, places)
        return np.where(self.known[part], boot_ns + self.shifts_ns[part], 0)

    def notes(self) -> list[str]:
        """Describe the restarts, in one line or none."""
        if not len(self.places):
            return []
        lost = int(np.count_nonzero(~self.known))
        told = f"the autopilot was restarted {len(self.places)} times; its times go on by another clock"
        return [f"{told}, but for {lost} parts, of which no clock tells when they began" if lost else told]


def find_boots(
    boot_ns: Int64, places: Int64, clock_boot_ns: Int64, clock_ns: Int64, clock_places: Int64
) -> Boots:
    """Find the restarts of an autopilot by times since boot [N] of frequent messages, and their places.

    `clock_boot_ns`, `clock_ns` and `clock_places` [M] are of messages that also state another clock's time.
    """
    starts = []
    for k in (np.flatnonzero(np.diff(boot_ns) < -_RESTART_NS) + 1).tolist():
        before, after = boot_ns[max(0, k - _AROUND) : k], boot_ns[k : k + _AROUND]
        if (np.diff(before) >= 0).all() and (np.diff(after) >= 0).all() and after.max() < before.max():
            starts.append(k)
    firsts = np.array(starts, np.intp)
    count = len(starts) + 1
    shifts_ns, known = np.zeros(count, np.int64), np.ones(count, np.bool_)
    found = Boots(places[firsts], places[firsts - 1], boot_ns[firsts - 1], shifts_ns, known)
    part = found.parts(clock_boot_ns, clock_places)
    lead_ns = clock_ns - clock_boot_ns
    for k in range(1, count):
        before, after = lead_ns[part == k - 1][-_AROUND:], lead_ns[part == k][:_AROUND]
        known[k] = known[k - 1] and len(before) > 0 and len(after) > 0
        if known[k]:
            middle_ns = int(before[0])  # differences are exact as float64, times are not
            shift_ns = float(np.median(after - middle_ns) - np.median(before - middle_ns))
            shifts_ns[k] = shifts_ns[k - 1] + round(shift_ns)
    return found


def fit_gps_time(boot_ns: Int64, utc_ns: Int64) -> ClockFit | None:
    """Fit UTC to the time since boot by its last values: a receiver learns of its errors in flight."""
    lead_ns = utc_ns - boot_ns
    mended, steps_s = utc_ns.copy(), []
    for k in np.flatnonzero(np.abs(np.diff(lead_ns)) > _LEAST_STEP_NS).tolist():
        before, after = lead_ns[: k + 1][-_LEAST_FIXES:], lead_ns[k + 1 :][:_LEAST_FIXES]
        step_ns = round(float(np.median(after) - np.median(before)))
        whole_ns = round(step_ns / 1e9) * 1_000_000_000
        if whole_ns and abs(step_ns - whole_ns) < _STEADY_NS:
            step_ns = whole_ns
        apart_ns = np.ptp(np.concatenate([before, after - step_ns]))
        if min(len(before), len(after)) == _LEAST_FIXES and apart_ns < min(_STEADY_NS, abs(step_ns) / 4):
            mended[: k + 1] += step_ns
            steps_s.append(round(step_ns / 1e9, 3))
    fit = fit_clock(boot_ns, mended)
    if fit and steps_s and fit.residual_s > min(map(abs, steps_s)) / 4:  # its clock runs unevenly
        return fit_clock(boot_ns, utc_ns)
    return fit and replace(fit, steps_s=tuple(steps_s))


def on_gps_time(
    source: Path, fit: ClockFit | None, wanted: Literal["gps", "boot"] | None, notes: list[str]
) -> ClockFit | None:
    """Return the fit to GPS time if it exists and the user did not ask for time since boot; else None."""
    if wanted == "gps" and fit is None:
        problem, remedy = "holds no GPS time", "leave time: gps out; its stamps count from boot"
        raise DataError(source, problem, remedy, code="clock-unknown")
    if fit is None:
        notes.append("holds no GPS time: its stamps count from boot")
        return None
    if wanted == "boot":
        notes.append(f"its stamps count from boot, as asked ({describe_fit(fit)})")
        return None
    notes.append(f"its stamps are turned to UTC: {describe_fit(fit)}")
    if fit.residual_s > _UNEVEN_S:
        notes.append(
            f"its clock does not keep step with GPS time: times may be {fit.residual_s:.1f} s off, and its"
            " rates wrong; do not rely on its poses in motion"
        )
    return fit


def refuse_marks(path: Path, *marks: bytes, most: int | None = None) -> None:
    """Refuse a log with more beginnings of messages than fit into it (100,000, or one for eight bytes)."""
    size = path.stat().st_size
    if size < _FEW_MARKS:
        return
    most = most or max(_FEW_MARKS, size // _SMALLEST_MESSAGE)
    with path.open("rb") as file:
        found = sum(block.count(mark) for block in iter(partial(file.read, 1 << 20), b"") for mark in marks)
    if found > most:
        raise damaged(path, f"has {found} beginnings of messages in {size} bytes")


# A parser tries so many marks in a second.
_FEW_MARKS = 100_000
# No message of an autopilot takes fewer bytes.
_SMALLEST_MESSAGE = 8


def describe_fit(fit: ClockFit) -> str:
    """Describe clock offset and drift between a log's own clock and GPS time, in words."""
    steps = ", ".join(f"{step_s:+g} s" for step_s in fit.steps_s)
    stepped = f"GPS time steps by {steps}: the last times count (else clock.offset_s); " if steps else ""
    return stepped + (
        f"GPS time is {fit.offset_ns / 1e9:.3f} s ahead of its clock, drifting {fit.drift_ppm:.1f} ppm"
        f" (+- {min(fit.drift_sigma_ppm, 1e6):.2g}; {fit.events} fixes, scatter"
        f" {fit.residual_s * 1e3:.1f} ms)"
    )


def between_repeats(t_ns: Int64, values: Float) -> tuple[Float, int]:
    """Interpolate positions [N, D] that a log repeats, the last second of each hold; count changed rows."""
    smooth = np.stack([_between_changes(t_ns, column, len(t_ns)) for column in values.T], axis=1)
    return smooth, int(np.count_nonzero((smooth != values).any(axis=1)))


def between_refreshed_angles(t_ns: Int64, angles: Float) -> Float:
    """Interpolate the angles [N, D] of a log that repeats each measurement until the next one comes.

    A gimbal that keeps an angle gives the same number at each measurement. So of a longer hold, only the last
    refresh interval becomes a line to the new angle. That is the shortest time between two changes, if most
    follow each other so soon. Angles have no jumps by full turns; each column may be refreshed at its own
    rate.
    """
    return np.stack([_between_changes(t_ns, column, _refreshed_rows(column)) for column in angles.T], axis=1)


def _refreshed_rows(values: Float) -> int:
    """Return for how many rows a log repeats each measurement; 1 if there is no evidence of repeats."""
    apart = np.diff(np.flatnonzero(np.diff(values) != 0))
    if len(apart) < _LEAST_REFRESHES or apart.min() == 1:
        return 1
    longest = int(apart.min()) + 1  # pictures and measurements do not keep step: one row more or less
    return longest if np.count_nonzero(apart <= longest) > len(apart) / 2 else 1


def _between_changes(t_ns: Int64, values: Float, most_rows: int) -> Float:
    """Interpolate to each change of a column, over at most `most_rows` rows and a second of the hold."""
    changes = np.flatnonzero(np.diff(values) != 0) + 1
    if not len(changes):
        return values
    rows = np.arange(len(t_ns))
    next_change = np.searchsorted(changes, rows, side="right")
    last = np.append(changes, len(t_ns) - 1)[next_change]
    measured = np.zeros(len(t_ns), dtype=np.bool_)
    measured[[0, *changes.tolist()]] = True
    measured |= (t_ns[last] - t_ns >= _HELD_NS) | (last - rows >= most_rows) | (next_change == len(changes))
    return interpolate_points(t_ns[measured], values[measured], t_ns, max_gap_ns=int(np.ptp(t_ns)) + 1)
