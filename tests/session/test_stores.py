"""Sources and sessions in an object store, against an S3 server on the loopback."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from pipelines.attempt import Settings
from pipelines.reconstruct import reconstruct
from pipelines.reconstruction import segments
from pipelines.session.clusters import Cluster
from pipelines.session.errors import BusyError, DataError
from pipelines.session.stores import (
    Copy,
    fetched,
    get,
    holds_session,
    located,
    matching,
    put,
    source_url,
    staged,
    url_of,
)
from tests.commands.runner import content, mocap, refused, succeeds
from tests.keypoints.spotted_flights import spot_detector, write_spotted_flight
from tests.synthetic.flights import write_flight

SERVER = str(Path(sys.executable).with_name("moto_server"))
KEY, SECRET = "AKIAEXAMPLEOFAKEY", "a-secret-that-nobody-may-print"


class Server:
    """An S3 server in a process of its own."""

    def __init__(self, *, refusing: bool = False) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port: int = free.getsockname()[1]
        # After so many requests without a known key, moto refuses as AWS does.
        more = {"INITIAL_NO_AUTH_ACTION_COUNT": "0"} if refusing else {}
        self._process = subprocess.Popen(
            [SERVER, "-H", "127.0.0.1", "-p", str(self.port)],
            env=os.environ | more,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def wait(self) -> None:
        until_s = time.monotonic() + 60
        while time.monotonic() < until_s:
            try:
                socket.create_connection(("127.0.0.1", self.port), 1).close()
            except OSError:
                time.sleep(0.05)
            else:
                return
        raise TimeoutError(self.port)

    def close(self) -> None:
        self._process.kill()
        self._process.wait()


@pytest.fixture(scope="module")
def servers() -> Iterator[tuple[Server, Server]]:
    """One that admits everybody, and one that refuses everybody."""
    with ExitStack() as stack:
        both = Server(), Server(refusing=True)
        for server in both:
            stack.callback(server.close)
        for server in both:
            server.wait()
        yield both


@pytest.fixture
def bucket(servers: tuple[Server, Server], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Make an empty bucket; return its URL."""
    for name, value in {
        "AWS_ACCESS_KEY_ID": KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": servers[0].address,
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }.items():
        monkeypatch.setenv(name, value)
    name = tmp_path.name.replace("_", "-")[:60].strip("-")
    connection = HTTPConnection("127.0.0.1", servers[0].port)
    connection.request("PUT", f"/{name}")
    assert connection.getresponse().status == 200
    connection.close()
    yield f"s3://{name}"
    from s3fs import S3FileSystem

    S3FileSystem.clear_instance_cache()  # of the clients of this endpoint


def written(folder: Path, **files: str) -> None:
    for name, text in {"session_json": "{}", **files}.items():
        path = folder / name.replace("_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def published(url: str) -> dict[str, str]:
    """Fetch the newest version of a session with a cache of its own; return its files."""
    with pytest.MonkeyPatch.context() as patch, staged_elsewhere(patch, url) as copy:
        return {path.name: path.read_text() for path in copy.folder.iterdir()}


def staged_elsewhere(patch: pytest.MonkeyPatch, url: str) -> Any:
    patch.setenv("XDG_CACHE_HOME", f"{os.environ['XDG_CACHE_HOME']}-of-a-reader")
    return staged(url)


def at(url: str) -> list[str]:
    return matching(f"{url}/*")


def test_a_flight_in_a_store_makes_the_same_tables_as_on_disk(bucket: str, tmp_path: Path) -> None:
    flight = write_flight(tmp_path / "flight")
    for path in sorted((tmp_path / "flight").iterdir()):
        put(f"{bucket}/flights/{path.name}", path.read_bytes())
    succeeds("ingest", flight.manifest, "-o", tmp_path / "here.session")
    succeeds("ingest", f"{bucket}/flights/flight.yaml", "-o", f"{bucket}/there.session")
    succeeds("ingest", f"{bucket}/flights/flight.yaml", "-o", tmp_path / "both.session")
    tables = {
        name: digest
        for name, digest in content(tmp_path / "here.session").items()
        if name.endswith(".parquet") or name == "session.json"
    }
    assert len(tables) > 5
    assert tables.items() <= content(tmp_path / "both.session").items()
    with staged(f"{bucket}/there.session") as copy:
        assert tables.items() <= content(copy.folder).items()
    assert "unchanged" in succeeds("ingest", f"{bucket}/flights/flight.yaml", "-o", f"{bucket}/there.session")
    assert "Test flight" in succeeds("info", f"{bucket}/there.session")
    assert "drone1" in succeeds("info", f"{bucket}/flights/flight.yaml")
    assert not list((tmp_path / "cache" / "mocap" / "stores" / "sessions").glob("*/*.session"))


def test_segments_of_a_session_in_a_store_go_to_workers_elsewhere(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed: Any = pytest.importorskip("distributed")
    for name, value in {"LENGTH_S": 2.0, "OVERLAP_S": 1.0, "_BLENDED_NS": 600_000_000}.items():
        monkeypatch.setattr(segments, name, value)
    (tmp_path / "flight").mkdir()
    manifest = write_spotted_flight(tmp_path / "flight", frames=130)
    for path in sorted((tmp_path / "flight").iterdir()):
        put(f"{bucket}/flights/{path.name}", path.read_bytes())
    succeeds("ingest", manifest, "-o", tmp_path / "here.session")
    succeeds("ingest", f"{bucket}/flights/flight.yaml", "-o", f"{bucket}/there.session")
    settings = Settings(method="robust", detector=spot_detector(tmp_path))
    reconstruct(tmp_path / "here.session", settings, workers=1)
    elsewhere = {"XDG_CACHE_HOME": str(tmp_path / "cache-elsewhere")}
    with (
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # its usual port may be taken
            env=elsewhere,
        ) as workers,
        distributed.Client(workers) as client,
        staged(f"{bucket}/there.session") as copy,
    ):
        made = reconstruct(copy.folder, settings, cluster=Cluster.of(client))
        assert len(made.metrics["segments"]) == 3
        found = content(copy.folder / "reconstruct")
    here = content(tmp_path / "here.session" / "reconstruct")
    tables = [name for name in here if name.endswith(".parquet")]
    assert len(tables) == 3
    assert {name: here[name] for name in tables} == {name: found[name] for name in tables}
    # The worker fetched two versions: without keypoints for its blocks, with them for its segments.
    versions = list((tmp_path / "cache-elsewhere" / "mocap" / "stores" / "sources").glob("*/*/session.json"))
    assert len(versions) == 2
    assert not list((tmp_path / "cache-elsewhere").rglob("skeleton.parquet"))
    with staged(f"{bucket}/there.session") as copy:
        assert content(copy.folder / "reconstruct") == found


def test_an_export_of_a_session_in_a_store_is_written_here(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = write_flight(tmp_path / "flight")
    succeeds("ingest", flight.manifest, "-o", f"{bucket}/there.session")
    succeeds("reconstruct", f"{bucket}/there.session", "--method", "robust")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    succeeds("export", f"{bucket}/there.session", "--to", "trc")
    assert list(Path("there.export").glob("*.trc"))


def test_sources_by_url_are_fetched_when_they_change(bucket: str, tmp_path: Path) -> None:
    put(f"{bucket}/logs/one.csv", b"1")
    put(f"{bucket}/logs/deep/two.csv", b"2")
    assert located(tmp_path, f"{bucket}/logs/one.csv").read_bytes() == b"1"
    folder = located(tmp_path, f"{bucket}/logs")
    assert (folder / "deep" / "two.csv").read_bytes() == b"2"
    put(f"{bucket}/logs/one.csv", b"other")
    assert fetched(f"{bucket}/logs/one.csv").read_bytes() == b"1"
    assert fetched(f"{bucket}/logs/one.csv", fresh=True).read_bytes() == b"other"
    inside = fetched(f"{bucket}/logs/one.csv").parent
    assert source_url(inside, "deep/two.csv") == f"{bucket}/logs/deep/two.csv"
    assert source_url(tmp_path, "deep/two.csv") is None


def test_of_two_writers_one_publishes_and_the_other_is_told(bucket: str, tmp_path: Path) -> None:
    url = f"{bucket}/x.session"
    with staged(url, create=True) as copy:
        written(copy.folder, a="1")
    late = Copy(url, tmp_path / "late-machine")
    late.begin(create=False)
    written(late.folder, a="late")
    for k in range(2):  # the second removes the number that the late writer takes
        with staged(url) as copy:
            written(copy.folder, a=f"early {k}")
    with pytest.raises(BusyError):
        late.publish()
    assert published(url)["a"] == "early 1"
    late.begin(create=False)
    assert (late.folder / "a").read_text() == "early 1"
    written(late.folder, b="2")
    assert late.publish()
    assert published(url) == {"session.json": "{}", "a": "early 1", "b": "2"}
    assert len(at(url)) == 2  # one version, and the object that names it


def test_one_machine_writes_a_session_once_at_a_time(bucket: str) -> None:
    url = f"{bucket}/x.session"
    with staged(url, create=True), pytest.raises(BusyError), staged(url, create=True):
        pass


KILLED = """
import os, signal, sys
from s3fs import S3FileSystem
from pipelines.session.stores import Copy, staged

def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)

moment, url = sys.argv[1:]
if moment == "uploading":
    put, done = S3FileSystem._put_file, []
    async def counted(self, *arguments, **options):
        done.append(await put(self, *arguments, **options))
        if len(done) == 2:
            die()
    S3FileSystem._put_file = counted
elif moment == "uploaded":
    Copy._point = die
else:
    Copy._remove_older = die
with staged(url, create=True) as copy:
    copy.folder.mkdir(exist_ok=True)
    for name in ("session.json", "a", "b", "c", "d"):
        (copy.folder / name).write_text(f"{name} of the killed")
"""


@pytest.mark.parametrize("moment", ["uploading", "uploaded", "published"])
def test_a_kill_leaves_one_version_or_the_other(bucket: str, moment: str) -> None:
    url = f"{bucket}/x.session"
    with staged(url, create=True) as copy:
        written(copy.folder, a="before")
    before = published(url)
    killed = subprocess.run([sys.executable, "-c", KILLED, moment, url], check=False, timeout=60)
    assert killed.returncode == -signal.SIGKILL
    whole = {name: f"{name} of the killed" for name in ("session.json", "a", "b", "c", "d")}
    assert published(url) == (whole if moment == "published" else before)
    with staged(url) as again:  # what the killed one made is still there
        assert {path.name: path.read_text() for path in again.folder.iterdir()} == whole
    assert published(url) == whole
    with staged(url) as next_one:
        written(next_one.folder, e="after")
    assert len(at(url)) == 2


def test_refused_credentials_are_one_line_without_a_secret(
    servers: tuple[Server, Server], bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", servers[1].address)
    flight = write_flight(tmp_path / "flight")
    for line in (
        refused("info", f"{bucket}/x.session"),
        refused("ingest", f"{bucket}/flight.yaml"),
        refused("ingest", flight.manifest, "-o", f"{bucket}/x.session"),
    ):
        assert bucket in line
        assert KEY not in line
        assert SECRET not in line
    with pytest.raises(DataError) as caught:
        holds_session(f"{bucket}/x.session")
    assert caught.value.__cause__ is None  # whose words might repeat a key


def test_a_url_with_a_secret_is_refused_without_repeating_it() -> None:
    for url in (f"s3://{KEY}:{SECRET}@bucket/x", f"https://host/x?X-Amz-Signature={SECRET}"):
        with pytest.raises(DataError) as caught:
            url_of(url)
        assert SECRET not in str(caught.value)


def test_what_is_no_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert url_of("C:/flights/flight.yaml") is None
    assert url_of("a/b.yaml") is None
    assert url_of(Path("s3://bucket/x/flight.yaml")) == "s3://bucket/x/flight.yaml"
    assert url_of("file:///x/y") == url_of(Path("file:///x/y")) == "file:///x/y"
    (tmp_path / "s3:").mkdir()
    assert url_of(Path("s3:")) is None


class Flaky(BaseHTTPRequestHandler):
    """Proxy that answers every third request with 503."""

    behind: int
    count = 0

    def _pass_on(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        type(self).count += 1
        if self.count % 3 == 0:
            self.send_response(503)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        connection = HTTPConnection("127.0.0.1", self.behind)
        connection.request(self.command, self.path, body, dict(self.headers))
        answer = connection.getresponse()
        text = answer.read()
        self.send_response(answer.status)
        for name, value in answer.getheaders():
            if name.lower() not in {"transfer-encoding", "content-length", "connection", "server", "date"}:
                self.send_header(name, value)
        length = answer.getheader("Content-Length") if self.command == "HEAD" else str(len(text))
        self.send_header("Content-Length", length or "0")
        self.end_headers()
        self.wfile.write(text)
        connection.close()

    protocol_version = "HTTP/1.1"  # else nobody answers `Expect: 100-continue`
    do_GET = do_PUT = do_HEAD = do_POST = do_DELETE = _pass_on  # noqa: N815  # the base class's names

    def log_message(self, *arguments: object) -> None:
        """Stay silent."""


def test_a_store_that_fails_now_and_then_is_asked_again(
    servers: tuple[Server, Server], bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    Flaky.behind = servers[0].port
    with ThreadingHTTPServer(("127.0.0.1", 0), Flaky) as proxy:
        Thread(target=proxy.serve_forever, daemon=True).start()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{proxy.server_address[1]}")
        with staged(f"{bucket}/x.session", create=True) as copy:
            written(copy.folder, a="1")
        assert published(f"{bucket}/x.session")["a"] == "1"
        proxy.shutdown()
    assert Flaky.count > 6


def test_damage_in_the_store_is_refused(bucket: str) -> None:
    url = f"{bucket}/x.session"
    with staged(url, create=True) as copy:
        written(copy.folder, a="1")
    put(f"{copy.version}/a", b"2")
    with pytest.raises(DataError) as caught, staged(url):
        pass
    assert caught.value.source == f"{copy.version}/a"
    put(f"{url}/00000009.json", b'{"schema": 1, "folder": "../../other", "files": {}}')
    with pytest.raises(DataError), staged(url):
        pass


def test_urls_where_only_paths_go_are_refused(bucket: str, tmp_path: Path) -> None:
    assert mocap("export", "x.session", "-o", f"{bucket}/out").returncode == 2
    refused("reconstruct", f"{bucket}/none.session")
    refused("ingest", f"{bucket}/none.yaml")
    refused("ingest", f"nothing://{bucket[5:]}/none.yaml")
    assert get(f"{bucket}/none.yaml") is None
    assert Copy(f"{bucket}/x", tmp_path).version.startswith(bucket)
