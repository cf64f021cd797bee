"""`mocap replan-compare`: comparison of formation planners on a logged flight."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mocap_cli.options import (
    FiniteRange,
    Shown,
    any_path,
    force_option,
    grouped,
    output_options,
    seed_option,
)
from mocap_cli.several import each
from mocap_cli.terminal import print_table, say, say_warnings, watching

if TYPE_CHECKING:
    from pipelines import film
    from pipelines.planning.scene import Settings


def _settings(arms: str | None, config: Path | None, horizon_s: float | None, **others: Any) -> Settings:
    from pipelines.planning.scene import Settings
    from pipelines.replan import planner_settings

    stated = {name: others.pop(name) for name in ("radius_m", "tilt_deg", "yaws", "yaw_frame")}
    changes = {name: value for name, value in stated.items() if value is not None}
    return Settings(
        arms=None if arms is None else tuple(name.strip() for name in arms.split(",")),
        planner=planner_settings(config, changes, horizon_s=horizon_s),
        **others,
    )


_settings_options = grouped(
    "settings",
    _settings,
    click.option(
        "--arms",
        metavar="NAME,...",
        help="Arms to compare: adaptive, fixed, covariance, greedy, joint, group; flown and planned are the"
        " logged flight and its commands [default: adaptive, fixed, joint of one person, group of several,"
        " flown where cameras moved, planned where logged].",
    ),
    click.option(
        "--drones",
        type=click.IntRange(2, 8),
        help="Number of drones [default: the session's cameras, at least 2].",
    ),
    click.option(
        "--radius",
        "radius_m",
        type=FiniteRange(0.5, 500),
        metavar="M",
        help="Distance of the slots from the actor (`covariance`, `greedy` and `joint` only start there).",
    ),
    click.option(
        "--tilt",
        "tilt_deg",
        type=FiniteRange(-10, 85),
        metavar="DEG",
        help="Tilt of the slots above the actor (likewise).",
    ),
    click.option(
        "--yaws", type=click.IntRange(1, 360), help="Number of yaws of a full turn that the search considers."
    ),
    click.option(
        "--horizon",
        "horizon_s",
        type=FiniteRange(0.1, 600),
        metavar="S",
        help="Time that the search looks ahead, at most 60 knots.",
    ),
    click.option(
        "--yaw",
        "yaw_deg",
        type=FiniteRange(-360, 360),
        metavar="DEG",
        help="Yaw of the first camera at the start, counterclockwise from the zero of --yaw-frame"
        " [default: where it was].",
    ),
    click.option(
        "--yaw-frame",
        type=click.Choice(["world", "heading"]),
        help="Zero of yaws: east, or the actor's heading, so that formations turn with the actor"
        " [default: world].",
    ),
    click.option(
        "--config",
        type=any_path,
        metavar="PLANNER.yaml",
        help="Planner settings (docs/planner.md); the options above win over it.",
    ),
    click.option(
        "--mode",
        type=click.Choice(["closed-loop", "plan-only"]),
        default="closed-loop",
        show_default=True,
        help="Fly the plans as point masses, or put the drones exactly on them.",
    ),
    click.option(
        "--trials",
        type=click.IntRange(1, 10_000),
        default=20,
        show_default=True,
        help="Draws of detector and pose noise for the reconstruction error.",
    ),
    seed_option("Seed of all noise."),
    click.option(
        "--pose-noise",
        metavar="MODEL",
        help="Errors of the cameras' poses, instead of those of the session; for example"
        ' "white:position_m=0.3,rotation_deg=1".',
    ),
)


def _film_settings(
    *,
    render: bool,
    render_hz: float,
    render_start: float | None,
    render_end: float | None,
    detector: str,
    scenario: Path | None,
) -> tuple[film.Settings, Path | None] | None:
    """Return the settings of the film and the scenario; None without --render."""
    from pipelines import film

    return (film.Settings(render_hz, render_start, render_end, detector), scenario) if render else None


_film_options = grouped(
    "filmed",
    _film_settings,
    click.option(
        "--render",
        is_flag=True,
        help="Film every arm of a simulated flight and run the detector on the pictures:"
        " SESSION/film/ARM/CAMERA.mp4.",
    ),
    click.option(
        "--render-hz",
        type=FiniteRange(0.1, 30),
        default=5.0,
        show_default=True,
        help="Pictures filmed a second.",
    ),
    click.option("--render-start", type=FiniteRange(0, 1e6), metavar="S", help="First time to film."),
    click.option(
        "--render-end", type=FiniteRange(0, 1e6), metavar="S", help="Time from which nothing is filmed."
    ),
    click.option(
        "--detector",
        default="blazepose",
        show_default=True,
        help="Detector of --render (see `mocap models`).",
    ),
    click.option(
        "--scenario",
        type=any_path,
        metavar="SCENARIO.yaml",
        help="Scenario of the simulated flight [default: scenario.yaml beside the flight].",
    ),
)


@click.command("replan-compare", short_help="Fly other planners against the log, compare.")
@each("session", "SESSION")
@_settings_options
@click.option(
    "--name",
    metavar="NAME",
    help="Name under which the comparison is kept, SESSION/replan/NAME [default: by its settings].",
)
@_film_options
@force_option
@output_options
def replan_compare_command(
    session: Path,
    settings: Settings,
    name: str | None,
    filmed: tuple[film.Settings, Path | None] | None,
    force: bool,
    shown: Shown,
) -> dict[str, Any] | None:
    """Replay formation planners against the logged actor and map, and compare them in numbers.

    What each planner's cameras would measure of the actor's own skeleton is simulated, with errors of
    detector and poses. Every figure of a replay is simulated; `flown` and `planned` are what the log says.
    """
    from pipelines.precompile import precompile_for
    from pipelines.replan import refuse_name, replan
    from pipelines.session.stages import open_session

    refuse_name(name)
    open_session(session)  # a wrong session is refused before anything is compiled
    with watching(shown.level) as progress:
        precompile_for("replan", progress)
        result = replan(session, settings, name=name, force=force, progress=progress)
        figures = None
        if filmed is not None:
            from pipelines.film import film

            settings_of_film, scenario = filmed
            figures = film(
                session, settings_of_film, scenario=scenario, force=force, progress=progress
            ).metrics
    say_warnings(result.record.warnings, shown.quiet)
    if shown.as_json:
        return result.metrics if figures is None else result.metrics | {"filmed": figures}
    if not shown.quiet:
        _print(result.metrics)
        if figures is not None:
            _print_filmed(figures)
    place = result.folder / "replan"
    said = "unchanged" if result.skipped else "written"
    say(f"{said}: {place} (kept as {place / result.metrics['name']})")
    return None


def _print(metrics: dict[str, Any]) -> None:
    header = ["arm", "drones", "range m", "tilt deg", "max", "near obstacle", "hidden %", "blind s"]
    header += ["path m", "energy kJ", "clearance m", "separation m", "actor m"]
    header += ["PCK150 %", "MPJPE mm", "covered %", "violations"]
    rows: list[list[object]] = []
    near_first = [name for group in metrics["equal_ranges"] for name in group["arms"]]
    for name in near_first:  # arms of equal range stand beside each other
        arm = metrics["arms"][name]
        tilt, error = arm["tilt_deg"], arm["reconstruction_error"]
        rows.append(
            [
                name,
                arm["drones"],
                arm["range_m"]["mean"],
                tilt["mean"],
                tilt["max"],
                tilt["near_obstacle"],
                100 * arm["occluded_share"],
                arm["blind_s"],
                arm["path_m"],
                arm["energy_kj"],
                arm["min_clearance_m"],
                arm["min_separation_m"],
                arm["min_actor_distance_m"],
                None if error["pck150"] is None else 100 * error["pck150"]["mean"],
                _with_interval(error["mpjpe_mm"]),
                None if error["coverage"] is None else 100 * error["coverage"]["mean"],
                sum(arm["limit_violations"].values()),
            ]
        )
    print_table(header, rows)
    _print_people({name: metrics["arms"][name].get("by_person", {}) for name in near_first})
    say(metrics["verdict"])
    for group in metrics["equal_ranges"]:
        if len(metrics["equal_ranges"]) > 1 and group["best"] is not None:
            arms = ", ".join(group["arms"])
            say(f"of equal range ({arms}): best is {group['best']['arm']}")


def _print_people(arms: dict[str, dict[str, Any]]) -> None:
    """Print a table with one row for each of several people in each arm."""
    rows: list[list[object]] = [
        [
            arm,
            name,
            100 * one["occluded_share"],
            one["blind_s"],
            _percent((one.get("pck150") or {}).get("mean")),
            _with_interval(one.get("mpjpe_mm")),
            _percent((one.get("coverage") or {}).get("mean")),
            f"{one['view_quality']:.3f}",
        ]
        for arm, people in arms.items()
        for name, one in people.items()
    ]
    if rows:
        header = ["arm", "person", "hidden %", "blind s", "PCK150 %", "MPJPE mm", "covered %", "view quality"]
        print_table(header, rows)


def _with_interval(estimate: dict[str, Any] | None) -> str | None:
    if estimate is None:
        return None
    text = f"{estimate['mean']:.1f}"
    if estimate["interval"] is None:
        return text
    low, high = estimate["interval"]
    return f"{text} [{low:.1f}, {high:.1f}]"


def _print_filmed(metrics: dict[str, Any]) -> None:
    """Print a table with one row for each arm, and below it one for each of several people."""
    say()
    say(f"filmed (simulated) at {metrics['rate_hz']:g} Hz, keypoints by {metrics['detector']}:")
    header = [
        "arm",
        "pictures",
        "tilt deg",
        "max",
        "within 5 deg %",
        "in view %",
        "detected %",
        "PCK %",
        "keypoint px",
    ]
    header += ["reprojection px", "measured %", "MPJPE mm", "in common mm", "PCK150 %"]
    rows: list[list[object]] = [
        [
            name,
            arm["pictures"],
            arm["tilt_deg"]["mean"],
            arm["tilt_deg"]["max"],
            100 * arm["tilt_deg"]["within_5_share"],
            100 * arm["in_view_share"],
            100 * arm["detected_share"],
            _percent(arm["keypoint_pck"]),
            arm["keypoint_median_px"],
            None if arm["reprojection_px"] is None else arm["reprojection_px"]["mean"],
            _percent(arm["reconstructed_share"]),
            arm["mpjpe_mm"],
            arm.get("common_mpjpe_mm"),
            _percent(arm["pck150"]),
        ]
        for of_arm, over_all in metrics["arms"].items()
        for name, arm in (
            (of_arm, over_all),
            *((f"{of_arm}: {who}", own) for who, own in over_all.get("by_person", {}).items()),
        )
    ]
    print_table(header, rows)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
