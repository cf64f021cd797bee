"""`mocap report`: a page about a session."""

from __future__ import annotations

from pathlib import Path

import click

from mocap_cli.options import any_path, force_option, json_option, level, verbosity_options
from mocap_cli.terminal import print_json, say_warnings, watching


@click.command("report", short_help="Write a page about each session.")
@click.argument("sessions", nargs=-1, required=True, type=any_path, metavar="SESSION...")
@force_option
@json_option
@verbosity_options
def report_command(sessions: tuple[Path, ...], force: bool, as_json: bool, quiet: bool, verbose: int) -> None:
    """Write one self-contained HTML page for each session: how good, how sure, what is doubtful."""
    from pipelines.report import report

    results = []
    with watching(level(quiet, verbose)) as progress:
        progress.start("Writing pages", len(sessions))
        for session in sessions:
            results.append(report(session, force=force))
            progress.advance()
    for result in results:
        say_warnings(result.record.warnings, quiet)
    if as_json:
        print_json({"pages": [str(result.page) for result in results]})
        return
    for result in results:
        click.echo(f"{'unchanged' if result.skipped else 'written'}: {result.page}")
