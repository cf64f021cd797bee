"""`mocap replan-compare`: comparison of formation planners on a logged flight."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mocap_cli.options import Shown, force_option, grouped, output_options
from mocap_cli.several import each
from mocap_cli.terminal import print_table, say, say_next, say_warnings, watching

if TYPE_CHECKING:
    from pipelines.film import FilmSettings
    from pipelines.planning.scene import ReplanSettings


def _settings(arms: str | None, config: tuple[str, ...], **others: Any) -> ReplanSettings:
    from pipelines.replan import settings_of

    names = None if arms is None else tuple(name.strip() for name in arms.split(","))
    return settings_of(config, arms=names, **others)


_settings_options = grouped(
    "settings",
    _settings,
    click.option(
        "--arms",
        metavar="NAME,...",
        help="Arms to compare: adaptive, fixed, joint, group; flown and planned are the logged flight and its"
        " commands [default: adaptive, fixed, joint of one person, group of several, flown where cameras"
        " moved, planned where logged].",
    ),
    click.option(
        "--drones",
        type=click.IntRange(2, 20),
        help="Number of drones [default: the session's cameras, at least 2].",
    ),
    click.option(
        "--config",
        multiple=True,
        metavar="PLANNER.yaml|KEY=VALUE",
        help="Settings (docs/planner.md) of a file, or one of them: radius_m=8, tilt_deg=20, horizon_s=7,"
        " yaw_deg=45, ...; repeat it for several, the last one counts.",
    ),
    click.option(
        "--trials",
        type=click.IntRange(1, 10_000),
        default=100,
        show_default=True,
        help="Draws of detector and pose noise for the reconstruction error.",
    ),
    click.option(
        "--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True, help="Seed of all noise."
    ),
    click.option(
        "--pose-noise",
        metavar="MODEL",
        help="Errors of the cameras' poses, instead of those of the session; for example"
        ' "white:position_m=0.3,rotation_deg=1".',
    ),
)


def _film_settings(
    _: click.Context, __: click.Parameter, stated: str | None
) -> tuple[FilmSettings, Path | None] | None:
    """Return the settings of the film and the scenario; None without --render."""
    if stated is None:
        return None
    from pipelines.film import film_settings

    try:
        return film_settings(stated)
    except ValueError as error:
        raise click.BadParameter(str(error)) from None


@click.command("replan-compare", short_help="Fly other planners against the log, compare.")
@each("session", "SESSION")
@_settings_options
@click.option(
    "--name",
    metavar="NAME",
    help="Name under which the comparison is kept, SESSION/replan/NAME [default: by its settings].",
)
@click.option(
    "--render",
    "filmed",
    metavar="HZ[,KEY=VALUE...]",
    callback=_film_settings,
    help="Film every arm of a simulated flight, HZ pictures a second, and run a detector on the pictures:"
    " SESSION/film/ARM/CAMERA.mp4. Keys: start and end (s), detector [default: blazepose], scenario"
    " [default: scenario.yaml beside the flight].",
)
@force_option
@output_options
def replan_compare_command(
    session: Path,
    settings: ReplanSettings,
    name: str | None,
    filmed: tuple[FilmSettings, Path | None] | None,
    force: bool,
    shown: Shown,
) -> dict[str, Any] | None:
    """Replay formation planners against the logged actor and map, and compare them in numbers.

    What each planner's cameras would measure of the actor's own skeleton is simulated, with errors of
    detector and poses. Every figure of a replay is simulated; `flown` and `planned` are what the log says.
    """
    from pipelines.replan import refuse_name, replan
    from pipelines.session.stages import refuse_no_session

    refuse_name(name)
    refuse_no_session(session)
    with watching(shown.level) as progress:
        result = replan(session, settings, name=name, force=force, progress=progress)
        figures = None
        if filmed is not None:
            from pipelines.film import film

            film_settings, scenario = filmed
            figures = film(session, film_settings, scenario=scenario, force=force, progress=progress).metrics
    say_warnings(result.record.warnings, shown.quiet)
    if shown.as_json:
        return result.metrics if figures is None else result.metrics | {"filmed": figures}
    if not shown.quiet:
        _print(result.metrics, filmed=figures is not None)
        if figures is not None:
            _print_filmed(figures)
    place = result.folder / "replan"
    said = "unchanged" if result.skipped else "written"
    say(f"{said}: {place} (kept as {place / result.metrics['name']})")
    say_next("mocap report {}", result.folder, shown.quiet)
    return None


def _print(metrics: dict[str, Any], *, filmed: bool) -> None:
    from pipelines.planning.comparison import outcome

    arms = {name: metrics["arms"][name] for group in metrics["equal_ranges"] for name in group["arms"]}
    _print_rows(
        [
            {
                "arm": name,
                "range m": arm["range_m"]["mean"],
                "tilt": arm["tilt_deg"]["mean"],
                "max": arm["tilt_deg"]["max"],
                "hidden %": 100 * arm["occluded_share"],
                **_errors(arm["reconstruction_error"]),
                "broken": sum(arm["limit_violations"].values()),
            }
            for name, arm in arms.items()  # near ones first
        ]
    )
    _print_rows(
        [
            {
                "arm": arm,
                "person": name,
                "hidden %": 100 * one["occluded_share"],
                "blind s": one["blind_s"],
                **_errors(one),
                "view quality": f"{one['view_quality']:.3f}",
            }
            for arm, scores in arms.items()
            for name, one in scores.get("by_person", {}).items()
        ]
    )
    say(f"modelled: {metrics['verdict']}" if filmed else metrics["verdict"])
    for group in metrics["equal_ranges"] if len(metrics["equal_ranges"]) > 1 else ():
        if group["best"] is not None:
            say(f"of equal range ({', '.join(group['arms'])}): {outcome(group['best'])}")


def _print_rows(rows: list[dict[str, object]]) -> None:
    if rows:
        print_table(list(rows[0]), [list(row.values()) for row in rows])


def _errors(stated: dict[str, Any]) -> dict[str, object]:
    scales = {"PCK150 %": ("pck150", 100), "MPJPE mm": ("mpjpe_mm", 1), "covered %": ("coverage", 100)}
    return {title: _with_interval(stated.get(key) or {}, scale) for title, (key, scale) in scales.items()}


def _with_interval(stated: dict[str, Any], scale: float) -> str | None:
    """Return a mean and half of its interval, which lies about it evenly."""
    if not stated:
        return None
    low, high = stated["interval"] or (None, None)
    ends = "" if low is None or high is None else f" ±{scale * (high - low) / 2:.1f}"
    return f"{scale * stated['mean']:.1f}{ends}"


def _print_filmed(metrics: dict[str, Any]) -> None:
    say()
    say(f"filmed (simulated) at {metrics['rate_hz']:g} Hz, keypoints by {metrics['detector']}:")
    _print_rows(
        [
            {
                "arm": name,
                "pictures": arm["pictures"],
                "tilt": arm["tilt_deg"]["mean"],
                "max": arm["tilt_deg"]["max"],
                "detected %": 100 * arm["detected_share"],
                "PCK %": None if arm["keypoint_pck"] is None else 100 * arm["keypoint_pck"],
                **_errors(arm.get("reconstruction_error", {})),
            }
            for of_arm, over_all in metrics["arms"].items()
            for name, arm in (
                (of_arm, over_all),
                *((f"{of_arm}: {who}", own) for who, own in over_all.get("by_person", {}).items()),
            )
        ]
    )
    say(metrics["verdict"])
    say(f"modelled over these pictures, with the same pose errors: {metrics['modelled_verdict']}")
