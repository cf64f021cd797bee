"""`mocap report`: a page about a session."""

from __future__ import annotations

from pathlib import Path

import click

from mocap_cli.options import folder, force_option, json_option
from mocap_cli.terminal import print_json


@click.command("report")
@click.argument("sessions", nargs=-1, required=True, type=folder, metavar="SESSION...")
@force_option
@json_option
def report_command(sessions: tuple[Path, ...], force: bool, as_json: bool) -> None:
    """Write one self-contained HTML page for each session: how good, how sure, what is doubtful."""
    from pipelines.report import report

    results = [report(session, force=force) for session in sessions]
    if as_json:
        print_json({"pages": [str(result.page) for result in results]})
        return
    for result in results:
        click.echo(f"{'unchanged' if result.skipped else 'written'}: {result.page}")
