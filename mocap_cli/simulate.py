"""`mocap simulate`: a flight with known truth."""

from pathlib import Path

import click

from mocap_cli.options import (
    Shown,
    any_path,
    force_option,
    output_options,
    overwrite_option,
    workers_option,
)
from mocap_cli.terminal import print_json, print_table, say, say_next, watching


@click.command("simulate", short_help="Make a flight with known truth.")
@click.argument("scenario", type=any_path, required=False, metavar="[SCENARIO.yaml]")
@click.option(
    "--example",
    type=click.Choice(["mound_walk"]),
    help="Simulate the scenario of the sample flight instead of one of yours.",
)
@click.option("-o", "--output", type=any_path, required=True, help="Folder of the flight.")
@click.option(
    "--no-video",
    is_flag=True,
    help="Write keypoints with the modelled errors of a detector instead of videos; a thousand times faster.",
)
@workers_option("Pictures rendered at once; the flight does not depend on them.")
@overwrite_option
@force_option
@output_options
def simulate_command(
    scenario: Path | None,
    example: str | None,
    output: Path,
    no_video: bool,
    workers: int,
    overwrite: bool,
    force: bool,
    shown: Shown,
) -> None:
    """Make the files of a flight (logs, videos, calibration, map) and the truth."""
    from pipelines.simulate import example_scenario, simulate

    if (scenario is None) == (example is None):
        raise click.UsageError("State either a SCENARIO.yaml or --example NAME.")
    if scenario is None:
        scenario = example_scenario(str(example))
    with watching(shown.level) as progress:
        result = simulate(
            scenario,
            output,
            video=not no_video,
            workers=workers,
            overwrite=overwrite,
            force=force,
            progress=progress,
        )
    if shown.as_json:
        print_json(result.summary)
        return
    if not shown.quiet:
        summary = result.summary
        rows = [(name, count, summary["poses"][name]) for name, count in summary["frames"].items()]
        say(f"{summary['name']}: {summary['duration_s']:g} s, simulated, {summary['pictures']}")
        print_table(("camera", "frames", "poses"), rows)
    say(f"{'unchanged' if result.skipped else 'written'}: {result.folder / 'flight.yaml'}")
    say_next("mocap run {}", result.folder / "flight.yaml", shown.quiet)
