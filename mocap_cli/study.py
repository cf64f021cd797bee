"""`mocap study`: how an error depends on what is varied."""

from contextlib import ExitStack
from pathlib import Path

import click

from mocap_cli.options import Shown, any_path, force_option, output_options, overwrite_option, workers_option
from mocap_cli.terminal import print_json, print_table, say, say_next, say_warnings, watching


@click.command("study", short_help="Study an error against tilt, range, drones, noise, settings.")
@click.argument("words", nargs=-1, required=True, metavar="VARIABLE=VALUES... [SESSION|SCENARIO.yaml]")
@click.option("-o", "--output", type=any_path, required=True, help="Folder of the results.")
@workers_option("Conditions of a walk worked on at once; the results do not depend on them.")
@overwrite_option
@force_option
@output_options
def study_command(
    words: tuple[str, ...], output: Path, workers: int, overwrite: bool, force: bool, shown: Shown
) -> None:
    """Measure an error for every combination of values, and write a table, metrics.json and a figure.

    VALUES are separated by commas, or numbers as START:STOP:STEP. An interrupted study goes on where it
    stopped. Everything is simulated.

    \b
    mocap study tilt_deg=0:60:15 -o tilt/
    mocap study robots=2,3,4,5 noise=none,high scenario.yaml -o robots/
    mocap study range_m=8,10,12 arm=adaptive,joint flight.session -o ranges/

    Without a session, ideal cameras film a person who walks on a circle, or the first one of a scenario, and
    every method reconstructs the same data. Variables: tilt_deg, robots (the number of drones), method, and
    noise: a level (none, low: 0.1 m and 0.5 deg per axis, medium: 0.3, 1, high: 0.5, 2) or models as in
    --pose-noise, between semicolons. With a single value: keypoints (model, exact), seconds, rate_hz, trials,
    seed.

    On a session, planner arms fly again against the log. Variables: arm, range_m, tilt_deg, robots, every
    setting of the planner, actor: a number of other walks by chance, or walks like speed:0.8+delay:2+turn:30
    between commas. With a single value: config (PLANNER.yaml), pose_noise, trials, seed.
    """  # noqa: D301  # click keeps the lines of a paragraph that begins with the character \b
    from pipelines.reporting.studies import setting, tables
    from pipelines.session.urls import session_here
    from pipelines.study import study

    variables = [word for word in words if "=" in word.partition("/")[0]]
    places = [Path(word) for word in words if word not in variables]
    if not variables or len(places) > 1:
        raise click.UsageError("State VARIABLE=VALUES, and at most one session or scenario.")
    with watching(shown.level) as progress, ExitStack() as stack:
        result = study(
            variables,
            stack.enter_context(session_here(places[0])) if places else None,
            output,
            workers=workers,
            overwrite=overwrite,
            force=force,
            progress=progress,
        )
    metrics = result.metrics
    say_warnings(metrics.get("warnings", []), shown.quiet)
    if shown.as_json:
        print_json(metrics)
        return
    if not shown.quiet:
        say(f"Simulated: {setting(metrics)}")
        for table in tables(metrics):
            say()
            say(table.title)
            print_table(table.header, table.rows, names=table.names)
        if metrics.get("verdict"):
            say()
            say(metrics["verdict"])
    say(f"{'unchanged' if result.skipped else 'written'}: {result.folder}")
    if not places:
        say_next("mocap simulate --example mound_walk -o {}", Path("mound_walk"), shown.quiet)
    elif places[0].suffix in {".yaml", ".yml"}:
        say_next("mocap simulate {} -o simulated", places[0], shown.quiet)
    else:
        say_next("mocap replan-compare {}", places[0], shown.quiet)
