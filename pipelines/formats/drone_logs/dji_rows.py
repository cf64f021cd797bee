"""Rows of DJI's subtitles, records, tags and videos: positions, heights with their references, angles."""

from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pipelines.formats.common.rows import longest_rising
from pipelines.formats.drone_logs.telemetry_rows import (
    attitude_track,
    between_refreshed_angles,
    between_repeats,
    of_angles,
    position_track,
    turned_as_stated,
    whatever_from,
)
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.telemetry import Attitudes, AttitudeTrack, Height, Telemetry, TelemetryChoice

_HIGHEST_M = 500  # above the take-off: the largest height that DJI's drones reach


@dataclass(frozen=True)
class DjiRows:
    """Rows of a file of DJI's, of whatever kind; NaN where a row does not hold a value."""

    t_ns: Int64  # [N]
    timed: Bool  # [N] True where the time is known
    columns: Mapping[str, Float]  # [N] by name: latitude, longitude (deg), relative, absolute, altitude (m)
    clock: str  # as in `Telemetry`
    body: Float  # [N, 3] yaw, pitch, roll (deg)
    gimbal: Float  # [N, 3] the same of the camera
    names: tuple[str, str] = ("its body's angles", "its gimbal angles")
    rows: str = "rows"  # name of the rows where losses are counted
    repeats: bool = True  # a position is repeated until the next measurement
    dropped: Mapping[str, int] = field(default_factory=dict)


def telemetry_of_rows(
    path: Path, found: DjiRows, choice: TelemetryChoice, notes: Sequence[str] = ()
) -> Telemetry:
    """Build positions and attitudes; a repeated position is replaced by linear interpolation."""
    columns, dropped = found.columns, dict(found.dropped)
    height, which, note_on_height = choose_height(path, columns, choice)
    track = position_track(
        path,
        "its GPS",
        found.t_ns,
        np.stack([columns["latitude"], columns["longitude"], height], axis=1),
        dropped,
        on_earth=True,
        height=which,
        unusable={"no time": ~found.timed, "no position": ~np.isfinite(columns["latitude"])},
    )
    said = [*notes, note_on_height]
    if found.repeats:
        values, moved = between_repeats(track.t_ns, track.values)
        track = replace(track, values=values)
        if moved:
            said.append(
                f"{moved} of {len(values)} positions repeat the one before: taken between measurements"
            )
    body, gimbal = (
        angles_track(name, found.t_ns[found.timed], angles[found.timed], dropped, rows=found.rows)
        for name, angles in zip(found.names, (found.body, found.gimbal), strict=True)
    )
    return Telemetry(
        position=track,
        body=body,
        gimbal=gimbal,
        clock=found.clock,
        notes=tuple(f"{path}: {note}" for note in said),
        dropped=dropped,
    )


def attitudes_of_rows(path: Path, found: DjiRows) -> Attitudes:
    """Build the attitudes of the camera, whatever the rows say of positions."""
    dropped = dict(found.dropped)
    camera = angles_track(
        found.names[1], found.t_ns[found.timed], found.gimbal[found.timed], dropped, rows=found.rows
    )
    if camera is None:
        raise DataError(
            path,
            "holds no gimbal angles",
            "name the log and topic that do, or fixed angles",
            code="no-attitude",
        )
    return Attitudes(replace(camera, dropped=dropped), found.clock)


def choose_height(
    path: Path, columns: Mapping[str, Float], choice: TelemetryChoice
) -> tuple[Float, Height, str]:
    """Choose the height of each position; return it with its reference and a note about the choice.

    Args:
        path: the file, for messages.
        columns: [N] m: `relative` to the take-off, `absolute`, and `altitude` without a reference, which is
            used for each of the two that has no column of its own. NaN where there is none.
        choice: the user's choice.
    """
    stated, unnamed = choice.altitude, columns["altitude"]
    if isinstance(stated, int | float):
        throughout = np.full(len(columns["latitude"]), float(stated))
        return throughout, "stated", "its height is the one stated, throughout"
    both = ("relative", "absolute")
    named = {name: columns[name] for name in both if any_finite(columns[name])}
    there = (dict.fromkeys(both, unnamed) if any_finite(unnamed) else {}) | named
    if not there:
        raise DataError(
            path,
            "holds no height",
            "state it, in metres above the take-off: pose: {dji: ..., altitude: 30}",
            code="no-positions",
        )
    if stated is not None and stated not in there:
        raise DataError(
            path, f"holds no {stated} height", f"write altitude: {next(iter(there))}, or the metres"
        )
    if stated is None and not named:
        highest_m = float(np.nanmax(unnamed))
        if highest_m > _HIGHEST_M:
            problem = f"its altitude of up to {highest_m:.0f} m is no height above the take-off"
            return unnamed, "unknown", f"{problem}: taken as absolute, from a barometer"
        problem = "its altitude does not say what it counts from"
        return unnamed, "take-off", f"{problem}: taken from the take-off (else write altitude: absolute)"
    name = stated or ("relative" if "relative" in named else "absolute")
    if name == "relative":
        return there[name], "take-off", "heights count from the take-off"
    return (
        there[name],
        "unknown",
        "heights are absolute (barometer or terrain model): drones differ by many metres",
    )


def angles_track(
    name: str,
    t_ns: Int64,
    yaw_pitch_roll_deg: Float,
    dropped: MutableMapping[str, int],
    *,
    rows: str = "subtitles",
) -> AttitudeTrack | None:
    """Build the attitude from angles [N, 3]; None if there are none.

    An angle that is repeated until the next measurement is replaced by linear interpolation. `rows` names
    the rows of the file where losses are counted.
    """
    stated = np.isfinite(yaw_pitch_roll_deg).all(axis=1)
    if not stated.any():
        return None
    if missing := int(np.count_nonzero(~stated)):
        dropped[f"{rows} without {name}"] = missing
    kept = np.flatnonzero(stated)
    kept = kept[longest_rising(t_ns[kept])]
    if late := int(np.count_nonzero(stated)) - len(kept):
        dropped[f"{name} out of order"] = late
    continuous = np.degrees(np.unwrap(np.radians(yaw_pitch_roll_deg[kept]), axis=0))
    between = between_refreshed_angles(t_ns[kept], continuous)
    as_logged = whatever_from(of_angles(between))
    return attitude_track(name, t_ns[kept], turned_as_stated(between), dropped, stated=as_logged)


def any_finite(values: Float) -> bool:
    """Return True if there is any number."""
    return bool(np.isfinite(values).any())


def range_of(values: Float, decimals: int) -> list[float]:
    """Return the smallest and the largest number, rounded; empty without any."""
    finite = values[np.isfinite(values)]
    return [round(float(v), decimals) for v in (finite.min(), finite.max())] if len(finite) else []
