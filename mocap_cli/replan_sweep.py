"""`mocap replan-sweep`: ranges, tilts and numbers of drones, flown again and weighed against each other."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mocap_cli.options import Shown, any_path, force_option, grouped, output_options, seed_option
from mocap_cli.several import each
from mocap_cli.terminal import print_table, say, say_warnings, watching

if TYPE_CHECKING:
    from collections.abc import Callable

    from pipelines.planning.scene import ReplanSettings
    from pipelines.sweep import Over


def _over(radius: str | None, tilt: str | None, drones: str | None) -> Over:
    from pipelines.planning.scene import MOST_DRONES
    from pipelines.sweep import Over

    return Over(
        _numbers("--radius", radius, float, 0.5, 500),
        _numbers("--tilt", tilt, float, -10, 85),
        _numbers("--drones", drones, int, 2, MOST_DRONES),
    )


def _numbers(
    option: str, text: str | None, number: Callable[[str], Any], least: float, most: float
) -> tuple[Any, ...]:
    """Read numbers between commas; without the option there are none."""
    if text is None:
        return ()
    try:
        values = tuple(number(word) for word in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is no list of numbers like 2,3,4", param_hint=option) from None
    for value in values:
        if not least <= value <= most:
            raise click.BadParameter(f"{value:g} is not from {least:g} to {most:g}", param_hint=option)
    return values


_over_options = grouped(
    "over",
    _over,
    click.option("--radius", metavar="M,...", help="Distances of the slots from the actor."),
    click.option("--tilt", metavar="DEG,...", help="Tilts of the slots above the actor."),
    click.option("--drones", metavar="N,...", help="Numbers of drones, 2 to 8."),
)


def _settings(arms: str, config: Path | None, **others: Any) -> ReplanSettings:
    from pipelines.replan import settings_of

    return settings_of(
        () if config is None else (str(config),),
        arms=tuple(dict.fromkeys(name.strip() for name in arms.split(","))),
        **others,
    )


_settings_options = grouped(
    "settings",
    _settings,
    click.option(
        "--arms", metavar="NAME,...", default="adaptive", show_default=True, help="Arms that are flown."
    ),
    click.option(
        "--config", type=any_path, metavar="PLANNER.yaml", help="Planner settings (docs/planner.md)."
    ),
    click.option(
        "--trials",
        type=click.IntRange(1, 10_000),
        default=10,
        show_default=True,
        help="Draws of detector and pose noise.",
    ),
    seed_option("Seed of all noise."),
    click.option(
        "--pose-noise",
        metavar="MODEL",
        help="Errors of the cameras' poses, instead of those of the session.",
    ),
)


@click.command("replan-sweep", short_help="Weigh ranges, tilts and numbers of drones.")
@each("session", "SESSION")
@_over_options
@_settings_options
@force_option
@output_options
def replan_sweep_command(
    session: Path, over: Over, settings: ReplanSettings, force: bool, shown: Shown
) -> dict[str, Any] | None:
    """Fly every combination of ranges, tilts and numbers of drones against the log.

    Each is measured as `replan-compare` does (simulated). The table, SESSION/sweep/table.csv and tradeoff.svg
    show what each would have cost. An interrupted sweep goes on where it stopped.
    """
    from pipelines.sweep import sweep

    with watching(shown.level) as progress:
        result = sweep(session, settings, over, force=force, progress=progress)
    say_warnings(result.record.warnings, shown.quiet)
    if shown.as_json:
        return result.metrics
    if not shown.quiet:
        _print(result.metrics)
    say(f"{'unchanged' if result.skipped else 'written'}: {result.folder / 'sweep'}")
    return None


def _print(metrics: dict[str, Any]) -> None:
    header = ["arm", "radius m", "tilt", "drones", "error mm", "MPJPE mm", "PCK150 %", "covered %", "range m"]
    header += ["hidden %", "blind s", "path m", "energy kJ", "separation m", "violations", ""]
    rows: list[list[object]] = [
        [
            cell["arm"],
            cell["radius_m"],
            cell["tilt_deg"],
            cell["drones"],
            cell["capped_mm"],
            cell["mpjpe_mm"],
            100 * cell["pck150"],
            100 * cell["coverage"],
            cell["range_m"],
            100 * cell["hidden_share"],
            cell["blind_s"],
            cell["path_m"],
            cell["energy_kj"],
            cell["min_separation_m"],
            cell["violations"],
            "best" if cell["best"] else "trade-off" if cell["tradeoff"] else "",
        ]
        for cell in metrics["cells"]
    ]
    print_table(header, rows)
    say(metrics["verdict"])
