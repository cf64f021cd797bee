"""`mocap export`: a session for other programs."""

from __future__ import annotations

from pathlib import Path

import click

from mocap_cli.options import any_path, json_option, overwrite_option, session_argument
from mocap_cli.terminal import print_json


@click.command("export", short_help="Write TRC, CSV or TUM.")
@session_argument
@click.option(
    "--to",
    "formats",
    required=True,
    metavar="FORMAT[,FORMAT...]",
    help="trc (OpenSim, metres, Y up), csv (everything, long), tum (camera trajectories).",
)
@click.option("-o", "--output", type=any_path, help="Folder [default: the session's name with .export].")
@overwrite_option
@json_option
def export_command(session: Path, formats: str, output: Path | None, overwrite: bool, as_json: bool) -> None:
    """Write the skeleton and the cameras in the formats of other programs."""
    from pipelines.export import export

    names = [name.strip() for name in formats.split(",") if name.strip()]
    if not names:
        raise click.BadParameter("names no format", param_hint="--to")
    result = export(session, names, output, overwrite=overwrite)
    if as_json:
        print_json(
            {
                "written": [str(path) for path in result.written],
                "unchanged": [str(path) for path in result.unchanged],
            }
        )
        return
    for path in result.written:
        click.echo(f"written: {path}")
    for path in result.unchanged:
        click.echo(f"unchanged: {path}")
