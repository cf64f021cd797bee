"""Output of commands: names and texts from files must not control a terminal or start new lines."""

import ast
import unicodedata
from pathlib import Path

import pytest

import mocap_cli
from mocap_cli.terminal import say
from tests.commands.runner import mocap, succeeds
from tests.synthetic.flights import write_flight

# A colour, the same by one byte of C1, a title with BEL, reversed reading order, new or forged lines.
EVIL = ["\x1b[31m", "\x9b31m", "\x1b]0;t\x07", "\u202e", "\r", "\nmocap: all is well", "\x7f", "\u2028"]
STEERING = {"Cc", "Cf", "Zl", "Zp", "Cs"}


def steering(text: str) -> set[str]:
    """Find the characters of a text that could control a terminal, except ends of lines."""
    return {c for c in text.replace("\n", "") if unicodedata.category(c) in STEERING}


def test_commands_print_in_one_place_only() -> None:
    found = []
    for path in sorted(Path(mocap_cli.__file__).parent.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
            if name in {"click.echo", "click.secho", "print", "sys.stdout.write", "sys.stderr.write"}:
                found.append(path.name)
    assert found == ["terminal.py", "terminal.py"]  # `say` and `print_json`


@pytest.mark.parametrize("evil", EVIL)
def test_a_line_stays_one_line_that_steers_nothing(evil: str, capsys: pytest.CaptureFixture[str]) -> None:
    say(f"  written: a{evil}b  c\u00a0d\u3000e \u00e9\u4e2d")
    printed = capsys.readouterr().out
    assert printed.count("\n") == 1
    assert not steering(printed)
    assert printed.startswith("  written: a?")
    assert printed.endswith("b  c\u00a0d\u3000e \u00e9\u4e2d\n")


def test_usage_errors_are_clicks_own_otherwise() -> None:
    alone = mocap()
    assert alone.returncode == 2
    assert alone.stderr.strip() == succeeds("--help").strip()
    wrong = mocap("reconstruct", "a.session", "--persons", "0")
    assert wrong.returncode == 2
    assert " reconstruct [OPTIONS] SESSION" in wrong.stderr.splitlines()[0]
    assert "'--persons': '0' " in wrong.stderr


def test_every_command_that_names_files(tmp_path: Path) -> None:
    forged = "mocap: all is well"
    folder = tmp_path / f"a\x1b[31m\n{forged}"
    flight = write_flight(folder, seconds=0.3)
    flight.settings["name"] = "Fly\x1b[2Jing\x9b"
    flight.save()
    session = folder / "flight.session"
    commands: list[tuple[str | Path, ...]] = [
        ("ingest", flight.manifest),
        ("reconstruct", session),
        ("export", session, "--to", "csv"),
        ("export", session, "--to", "csv"),
        ("report", session),
        ("info", flight.manifest),
        ("info", session, flight.manifest),
        ("init", folder, "-o", folder / "draft.yaml"),
        ("ingest", folder / "none.yaml"),
        ("reconstruct", session, folder, "-q"),
        ("reconstruct", session, f"--no\x1b[31m{folder}"),
        (f"no\x1b[31m{folder}",),
    ]
    for command in commands:
        done = mocap(*command)
        printed = done.stdout + done.stderr
        assert printed, command
        assert not steering(printed), (command, printed)
        assert forged not in printed.splitlines(), command
        assert "Traceback" not in printed
