"""Sessions and flights of somebody else that attack: random links, special files, partial copies, URLs.

Input k of a seed is a copy of a small flight with its session beside a folder of the user's, damaged by one
class of attack (or with little memory), and random commands on it. Each must succeed or refuse in one line,
in little time and memory, and neither touch nor show what is the user's.
"""

import hashlib
import json
import os
import random
import shutil
import socket
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from contextlib import chdir, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

from ruamel.yaml import YAML

from pipelines.session.storage import MAX_JSON_BYTES, is_special, remove_tree
from tests.commands.runner import refusal
from tests.fuzz.attacking import MOST_S, Command, Met, Reader
from tests.fuzz.mutations import damage_one
from tests.kills.killing import SCENARIO
from tests.synthetic.flights import write_flight

KINDS = ("links", "special files", "partial copies", "URLs", "memory")
TURNS = KINDS[:4] + KINDS
"""Classes of the inputs in turns; memory comes less often, because its commands load everything anew."""
COMPUTING = ("reconstruct", "replan-compare", "report", "simulate", "check")
MOST_COMPUTING_S = 3 * MOST_S  # of processor time, of these commands
SECRET, FIRST_LINE = "a-secret-that-nobody-may-print", "years-of-work"
PUBLIC = "127.77.0.1"  # stands for a server of the Internet
SESSION = "a/flight.session"


def _rows(text: str, **places: str) -> list[list[str]]:
    """Split a text into rows that end with empty lines, and these at "; "."""
    return [" ".join(row.format(**places).split()).split("; ") for row in text.strip().split("\n\n")]


READING, WRITING, MAKING = _rows(
    """
    info {S}; check {S}; info a/flight.yaml; check a/flight.yaml; info a/drone1.tum; info
    a/drone2.json; export {S} --to csv; export {S} --to trc,c3d -o out/e; export {S} --to mcap --overwrite;
    export {S} --to tum; report {S} --video none -o out/page.html; reconstruct {S} --method dlt -o
    out/copy.session

    reconstruct {S} --method dlt; reconstruct {S} --method dlt --force; reconstruct {S} --method robust;
    report {S}; report {S} --force; ingest a/flight.yaml; ingest a/flight.yaml --force; ingest a/flight.yaml
    --overwrite; ingest a/flight.yaml -o a/other.session; replan-compare {S} --trials 1 --arms fixed --name
    mine; simulate scenario.yaml -o a/sim --no-video --force; simulate scenario.yaml -o a/sim --no-video
    --overwrite

    ingest precious/flight.yaml; ingest a/flight.yaml; reconstruct {S} --method dlt; report {S}; export {S}
    --to csv; simulate scenario.yaml -o a/sim --no-video
    """,
    S=SESSION,
)
"""Commands that leave the session as it is, those that do not, and those that make all."""
STATED = {"a/sim", "a/other.session", "a/flight.yaml", SESSION}
"""Places that the commands name: what lies there is what the user chose."""
SCHEMES, HOSTS, URLS, SECRETS, KEYS, SPECIAL = _rows(
    """
    http; http; https; HTTP; ftp; file; s3; gs; az; abfs; reference; dir; generic; memory; github; git; smb;
    data; dask; zip://x.csv::http; simplecache::http; filecache::file; tar://x::https; http::http; jar

    {P}; {P}; {P}; 127.0.0.1; 127.1; 127.0.1; 2130706433; 0x7f000001; 0x7f.1; 0177.0.0.1; 017700000001;
    localhost; LOCALHOST; localhost.; 0.0.0.0; 0; [::1]; [::]; [0:0:0:0:0:0:0:1]; [::ffff:127.0.0.1];
    [::ffff:7f00:1]; 127。0。0。1; [fe80::1%25lo]; 169.254.169.254; 10.0.0.1; 172.16.0.1; 192.168.1.1;
    100.64.0.1; [fd00::1]; [fe80::1]; １２７.0.0.1; 127.0.0.1%2f; %6cocalhost; 127.0.0.1%00.example.com;
    example.com@127.0.0.1; ①②⑦.0.0.1

    SCHEME://HOST/x.json; SCHEME://HOST/away; SCHEME:/HOST/x; SCHEME:///etc/shadow; SCHEME://HOST

    SCHEME://me:{W}@HOST/x; SCHEME://{W}@HOST/x; SCHEME://me%3A{W}%40HOST/x; SCHEME:/me:{W}@HOST/x;
    SCHEME://HOST/x?token={W}; SCHEME://HOST/x?X-Amz-Signature={W}; SCHEME://HOST/x?a=1&api_KEY={W};
    SCHEME://HOST/x?%74oken={W}; SCHEME://HOST/x#access_token={W}; SCHEME://HOST/x?pass={W};
    SCHEME://HOST/x?pw={W}; SCHEME://HOST/x?jwt={W}; SCHEME://HOST/x?code={W}; SCHEME://HOST/x;password={W}

    cameras.drone1.pose; cameras.drone1.pose.file; cameras.drone1.keypoints; cameras.drone1.keypoints.file;
    cameras.drone1.intrinsics; cameras.drone1.gimbal; cameras.drone1.video; cameras.drone1.video.file;
    cameras.drone1.frame_times; cameras.drone1.frame_times.file; truth; truth.file; truth.body;
    truth.poses.drone1; actor; actor.file; actors.p.file; map; map.file; plan.drone1; logs.l; logs.l.file;
    name

    /dev/zero; /dev/full; /proc/kmsg; /proc/self/environ; /etc/shadow
    """,
    P=PUBLIC,
    W=SECRET,
)
NEEDS = {
    "ingest": {"export", "report", "check", "reconstruct", "replan-compare"},
    "reconstruct": {"export", "report"},
}
"""Commands that refuse a session if a file of a stage is not as its record says."""


class Server(BaseHTTPRequestHandler):
    """Server that notes where it was asked, and sends those who ask for `away` to `target`."""

    asked: list[str]
    target: str

    def _answer(self) -> None:
        self.asked.append(self.connection.getsockname()[0].removeprefix("::ffff:"))
        self.send_response(302 if "away" in self.path else 200)
        self.send_header("Location", self.target)
        self.send_header("Content-Length", f"{len(FIRST_LINE)}")
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(FIRST_LINE.encode())

    do_GET = do_HEAD = _answer  # noqa: N815  # the base class's names

    def log_message(self, *arguments: object) -> None:
        """Stay silent."""


class _Everywhere(ThreadingHTTPServer):
    address_family = socket.AF_INET6


@contextmanager
def served() -> Iterator[int]:
    """Serve on all addresses of this machine; yield the port."""
    Server.asked, Server.target = [], ""
    with _Everywhere(("::", 0), Server) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port
        server.shutdown()


def foreign(folder: Path, numbers: Iterable[int], *, seed: int = 0) -> Iterator[Met]:
    """Attack by the inputs of these numbers, in an empty folder; input k does not depend on the others."""
    with Reader() as reader, served() as port:
        names = _make(folder / "made", reader)
        for number in numbers:
            choice, kind = random.Random(f"{seed} {number}"), TURNS[number % len(TURNS)]  # noqa: S311
            place = shutil.copytree(folder / "made", folder / "input")
            most_mb = choice.randint(200, 3000) if kind == "memory" else None
            commands = choice.choices(READING * 2 + WRITING, k=choice.choice((1, 1, 2)))
            if kind == "URLs":
                commands = _name_urls(place / "a" / "flight.yaml", choice, port)
            elif kind != "memory":
                for _ in range(choice.choice((1, 1, 2, 3))):
                    _ATTACKS[kind](place, choice, names)
            for arguments in commands:
                yield _met(reader, place, Command(arguments.split(" "), most_mb, PUBLIC), kind, number)
            shutil.rmtree(place)


def _make(place: Path, reader: Reader) -> list[str]:
    """Make the flight, its session and the user's folder; return all names in it that commands use."""
    for name, seed in (("a", 0), ("precious", 1)):
        write_flight(place / name, seconds=0.4, seed=seed)
    (place / "scenario.yaml").write_text(SCENARIO, encoding="utf-8")
    for folder in ("out", "precious/deep"):
        (place / folder).mkdir()
    (place / "precious" / "deep" / "thesis.txt").write_text(FIRST_LINE, encoding="utf-8")
    found, touched = (
        {path.relative_to(place).as_posix() for path in place.rglob("*")},
        place.with_name("touched"),
    )
    for command in MAKING:
        done = reader.ask(place, "", Command(command.split(), touched=str(touched)))
        assert not done["status"], (command, (place / "told").read_text())
        found |= {os.path.relpath(place / name, place) for name in touched.read_text().splitlines()}
    return sorted(name for name in found - STATED if name.startswith("a/"))


def _emptied(place: Path, name: str) -> Path:
    """Return the path of a name, with a folder around it and nothing there."""
    path = place / name
    for parent in reversed(path.parents[: -len(place.parts)]):
        if parent.is_symlink() or not parent.is_dir():
            parent.unlink(missing_ok=True)
            parent.mkdir()
    remove_tree(path)
    return path


def _link(place: Path, choice: random.Random, names: Sequence[str]) -> None:
    """Put a link where mocap writes or reads anything, more often where it is near the top."""
    path = _emptied(place, choice.choices(names, [2.0 ** -name.count("/") for name in names])[0])
    precious = place / "precious"
    targets = [precious, precious / "deep" / "thesis.txt", precious / "flight.session", path, path.parent]
    same = precious / path.relative_to(place / "a")
    path.symlink_to(choice.choice([*targets, same, precious / "nothing", *map(Path, SPECIAL)]))


def _special_file(place: Path, choice: random.Random, names: Sequence[str]) -> None:
    """Put something else in the place of a file or folder that is there."""
    name = choice.choice([name for name in names if os.path.lexists(place / name)])
    was_folder = (place / name).is_dir()
    path = _emptied(place, name)
    match choice.choice(("pipe", "socket", "device", "sparse", "other", "forbidden")):
        case "pipe":
            os.mkfifo(path)
        case "socket":
            with socket.socket(socket.AF_UNIX) as made, chdir(path.parent):
                made.bind(path.name)
        case "device":
            path.symlink_to(choice.choice(SPECIAL))
        case "sparse":
            path.touch()
            os.truncate(path, 1 << 40)
        case "other" if not was_folder:
            path.mkdir()
        case _:
            path.write_bytes(b"" if was_folder else b"x")
            path.chmod(0)


def _copy_partly(place: Path, choice: random.Random, names: Sequence[str]) -> None:
    """Remove a part of the session, damage it, or take that of another session."""
    name = choice.choice([name for name in names if name.startswith(SESSION) and (place / name).exists()])
    path, other = place / name, place / "precious" / Path(name).relative_to("a")
    match choice.choice(("gone", "damaged", "damaged", "exchanged", "record")):
        case "exchanged" if other.exists():
            remove_tree(path)
            (shutil.copytree if other.is_dir() else shutil.copy2)(other, path)
        case "damaged" if path.is_file():
            damage_one(path, choice)
        case "record" if records := sorted((place / SESSION).glob("*/stage.json")):
            damage_one(choice.choice(records), choice)
        case _:
            remove_tree(path)


_ATTACKS = {"links": _link, "special files": _special_file, "partial copies": _copy_partly}


def _name_urls(flight: Path, choice: random.Random, port: int) -> list[str]:
    """State URLs in a flight.yaml, and choose a command on it or on such a URL itself."""
    yaml = YAML(typ="safe", pure=True)
    settings = yaml.load(flight)
    Server.target, *urls = (_url(choice, port) for _ in range(choice.choice((2, 2, 3))))
    for url in urls:
        within = settings
        *above, last = choice.choice(KEYS).split(".")
        for key in above:
            within[key] = within[key] if isinstance(within.get(key), dict) else {}
            within = within[key]
        within[last] = url
    with flight.open("w", encoding="utf-8") as file:
        yaml.dump(settings, file)
    where = choice.choice(("a/flight.yaml", "a/flight.yaml", urls[0]))
    return [choice.choice((f"ingest {where} -o out/b.session", f"check {where}", f"info {where}"))]


def _url(choice: random.Random, port: int) -> str:
    form = choice.choice(SECRETS if choice.random() < 0.4 else URLS)
    return form.replace("SCHEME", choice.choice(SCHEMES)).replace("HOST", f"{choice.choice(HOSTS)}:{port}")


def _met(reader: Reader, place: Path, command: Command, kind: str, number: int) -> Met:
    """Run a command and look for what must not be."""
    name, text = command.arguments[0], " ".join(command.arguments)
    kept = [place / "precious"] + [place / SESSION] * (text in READING)
    before, unfit = [_state(folder) for folder in kept], _unfit(place / SESSION, name) * (SESSION in text)
    Server.asked = []
    answer = reader.ask(place, "", command, most_s=MOST_COMPUTING_S if name in COMPUTING else MOST_S)
    troubles = [answer["trouble"]] * bool(answer["trouble"])
    printed, told = ((place / part).read_text("utf-8", "replace") for part in ("printed", "told"))
    try:
        line = ""
        if answer["status"]:
            line = refusal(subprocess.CompletedProcess(text, answer["status"], printed, told))
        assert "Traceback" not in told
        assert not (command.most_mb and line) or "memory" in line or name == "replan-compare"  # too short
    except (AssertionError, IndexError):
        troubles.append(f"exit status {answer['status']}: {told[-1500:]}")
    if unfit and not answer["status"]:
        troubles.append(f"used {unfit}")
    for folder, was in zip(kept, before, strict=True):
        if changed := sorted({path for path, _ in was.items() ^ _state(folder).items()}):
            troubles.append(f"changed {', '.join(changed[:5])}")
    troubles += [f"asked {host}" for host in set(Server.asked) - {PUBLIC}]
    troubles += [f"showed {line[:14]} in {path}" for line, path in _shown(place)]
    answer |= {"trouble": "; ".join(troubles), "refused": bool(answer.pop("status"))}
    return Met(kind, f"--number {number}: {text}", 0, **answer)


def _state(folder: Path) -> dict[str, object]:
    """Return what lies in a folder, by path: kind, size, time of change and content."""
    found: dict[str, object] = {}
    for path in [folder, *folder.rglob("*")]:
        status = path.lstat()
        content = str(path.readlink()) if path.is_symlink() else _digest(path)
        found[str(path)] = (status.st_mode, status.st_size, status.st_mtime_ns, content)
    return found


def _digest(path: Path) -> str:
    """Hash a file; "" for one that is no usual file."""
    usual = path.is_file() and not is_special(path) and path.stat().st_size < MAX_JSON_BYTES
    return hashlib.sha256(path.read_bytes()).hexdigest() if usual else ""


def _unfit(session: Path, command: str) -> str:
    """Name a file that is not as a sound record of a stage says which the command needs; "" if none is."""
    for stage in [stage for stage, commands in NEEDS.items() if command in commands]:
        path = session / stage / "stage.json"
        try:
            outputs = json.loads(path.read_bytes())["outputs"] if _digest(path) else {}
            changed = [name for name, digest in outputs.items() if _digest(session / name) != digest]
        except (ValueError, KeyError, TypeError, AttributeError, OSError):
            continue
        if changed:
            return str(changed[0])
    return ""


def _shown(place: Path) -> Iterator[tuple[str, str]]:
    """Find secrets, and lines of the user's, in what was printed or written."""
    shadow = Path("/etc/shadow")
    lines = [SECRET, FIRST_LINE]
    lines += shadow.read_text().splitlines()[:1] if os.access(shadow, os.R_OK) else []
    for path in place.rglob("*"):
        inside = path.relative_to(place).as_posix()
        theirs = path.is_symlink() or inside.startswith(("precious/", "cache/", "a/flight.yaml"))
        if not theirs and _digest(path):
            yield from ((line, inside) for line in lines if line.encode() in path.read_bytes())
