"""`mocap ablate`: studies of the reconstruction error on simulated flights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import click

from mocap_cli.options import (
    FiniteRange,
    Shown,
    any_path,
    force_option,
    grouped,
    output_options,
    overwrite_option,
    seed_option,
    workers_option,
)
from mocap_cli.terminal import print_json, print_table, say, watching

if TYPE_CHECKING:
    from pipelines.simulation.study.settings import Study


@click.group("ablate", short_help="Study the error against tilt, number of drones, noise.")
def ablate_command() -> None:
    """Measure how the reconstruction error depends on tilt, the number of drones, or the noise of poses.

    A simulated person walks, drones film from ideal positions, keypoints and logged poses err by known
    numbers, and every method reconstructs the same data. Everything is simulated.
    """


_study_options = grouped(
    "study",
    dict,
    click.option("-o", "--output", type=any_path, required=True, help="Folder of the results."),
    click.option(
        "--levels",
        metavar="NAME,...",
        help="Pose noise: none, low (0.1 m, 0.5 deg), medium (0.3, 1), high (0.5, 2), per axis"
        " [default: all; for noise: medium].",
    ),
    click.option(
        "--noise",
        metavar="MODEL",
        multiple=True,
        help='Pose noise instead of levels, such as "bias:position_m=0.3,rotation_deg=1"; repeat'
        " it for several.",
    ),
    click.option(
        "--methods",
        metavar="NAME,...",
        default="dlt,midpoint,robust,auto",
        show_default=True,
        help="Methods to compare. auto takes most of the time.",
    ),
    click.option(
        "--keypoints",
        type=click.Choice(["model", "exact"]),
        help="Keypoints with the measured errors of a detector, or exact ones [default: model].",
    ),
    click.option(
        "--detector",
        metavar="NAME",
        help="Render pictures and run this detector on them (`mocap models`).",
    ),
    click.option(
        "--seconds",
        type=FiniteRange(0.1, 600),
        default=75.0,
        show_default=True,
        help="Length of the walk.",
    ),
    click.option(
        "--rate",
        type=FiniteRange(0.1, 240),
        metavar="HZ",
        help="Rate of the pictures [default: 30; 1 with --detector].",
    ),
    click.option(
        "--trials",
        type=click.IntRange(1, 10_000),
        default=10,
        show_default=True,
        help="Draws of all noise.",
    ),
    seed_option("Seed of all noise."),
    workers_option("Conditions worked on at once; the results do not depend on them."),
    overwrite_option,
    force_option,
)


_drones_option = click.option(
    "--drones", type=click.IntRange(2, 8), default=2, show_default=True, help="Number of drones."
)
_tilt_option = click.option(
    "--tilt",
    type=FiniteRange(-10, 85),
    default=15.0,
    show_default=True,
    metavar="DEG",
    help="Tilt of the slots.",
)


@ablate_command.command("tilt", short_help="Error against the tilt of the formation.")
@click.option(
    "--tilts", metavar="DEG,...", default="0,15,30,45,60", show_default=True, help="Tilts of the slots."
)
@_drones_option
@_study_options
@output_options
def tilt_command(tilts: str, drones: int, study: dict[str, Any], shown: Shown) -> None:
    """Error against tilt, for every level of pose noise and every method."""
    _run("tilt", {"tilts_deg": _numbers("--tilts", tilts, float), "drones": [drones]}, study, shown)


@ablate_command.command("robots", short_help="Error against the number of drones.")
@click.option("--robots", metavar="N,...", default="2,3,4,5", show_default=True, help="Numbers of drones.")
@_tilt_option
@_study_options
@output_options
def robots_command(robots: str, tilt: float, study: dict[str, Any], shown: Shown) -> None:
    """Error against the number of drones, for every level of pose noise and every method."""
    _run("robots", {"tilts_deg": [tilt], "drones": _numbers("--robots", robots, int)}, study, shown)


@ablate_command.command("noise", short_help="Error against the kind of pose noise.")
@_drones_option
@_tilt_option
@_study_options
@output_options
def noise_command(drones: int, tilt: float, study: dict[str, Any], shown: Shown) -> None:
    """Error against the kind of pose noise, equally large on the average, for every method."""
    _run("noise", {"tilts_deg": [tilt], "drones": [drones]}, study, shown)


def _run(name: Study, varied: Mapping[str, Any], study: dict[str, Any], shown: Shown) -> None:
    from pipelines.ablate import ablate
    from pipelines.simulation.study.settings import settings_for

    levels, methods, rate_hz = study.pop("levels"), study.pop("methods"), study.pop("rate")
    run = {key: study.pop(key) for key in ("workers", "overwrite", "force")}
    output = study.pop("output")
    settings = settings_for(
        name,
        **varied,
        **study,
        levels=None if levels is None else _words(levels),
        methods=_words(methods),
        rate_hz=rate_hz,
    )
    with watching(shown.level) as progress:
        result = ablate(settings, output, progress=progress, **run)
    if shown.as_json:
        print_json(result.summary)
        return
    if not shown.quiet:
        _print(result.summary)
    say(f"{'unchanged' if result.skipped else 'written'}: {result.folder}")


def _print(summary: Mapping[str, Any]) -> None:
    from pipelines.reporting.studies import tables

    settings = summary["settings"]
    say(
        f"Simulated: {settings['seconds']:g} s of walking at {settings['rate_hz']:g} Hz, keypoints:"
        f" {summary['keypoints']}; mean [95 % interval], trials: {settings['trials']};"
        " MPJPE, root-relative and PA on the joint-frames that every method has"
    )
    for table in tables(summary):
        say()
        say(table.title)
        print_table(table.header, table.rows)


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",")]


def _numbers(option: str, text: str, number: Callable[[str], Any]) -> list[Any]:
    from pipelines.session.errors import DataError

    try:
        return [number(word) for word in _words(text)]
    except ValueError:
        raise DataError(
            option, f"{text!r} is no list of numbers", "write them like 2,3,4", code="bad-value"
        ) from None
