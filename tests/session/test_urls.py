"""Sources and sessions that are named by URL."""

from pathlib import Path

import pytest

from pipelines.session import urls
from pipelines.session.errors import BusyError
from pipelines.session.storage import url_of
from pipelines.session.urls import fetched, located, matching, put, session_here, source_url
from tests.commands.runner import content, mocap, refused, succeeds
from tests.fuzz.foreign import FIRST_LINE, PUBLIC, SECRET, Server, served
from tests.raising import refused as refusing
from tests.synthetic.flights import write_flight


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "mocap" / "stores"


@pytest.fixture
def store(tmp_path: Path, cache: Path) -> str:
    """Return the URL of an empty folder."""
    (tmp_path / "store").mkdir()
    return f"file://{tmp_path}/store"


def written(folder: Path, **files: str) -> None:
    """Write a session of these files."""
    for name, text in {"session.json": "{}", **files}.items():
        folder.mkdir(exist_ok=True)
        (folder / name).write_text(text)


def texts(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_a_flight_in_a_store_makes_the_same_tables_as_on_disk(
    store: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = write_flight(tmp_path / "flight", seconds=0.4)
    for path in sorted((tmp_path / "flight").iterdir()):
        put(f"{store}/flights/{path.name}", path.read_bytes())
    there, manifest = f"{store}/there.session", f"{store}/flights/flight.yaml"
    succeeds("ingest", flight.manifest, "-o", tmp_path / "here.session")
    succeeds("ingest", manifest, "-o", there)
    succeeds("ingest", manifest, "-o", tmp_path / "both.session")
    tables = {
        name: digest
        for name, digest in content(tmp_path / "here.session").items()
        if name.endswith(".parquet") or name == "session.json"
    }
    assert len(tables) > 5
    assert tables.items() <= content(tmp_path / "both.session").items()
    with session_here(there) as copy:
        assert tables.items() <= content(copy).items()
    # Files lie there under their own names.
    assert f"{there}/cameras/drone1/poses.parquet" in matching(f"{there}/cameras/drone1/*")
    assert "unchanged" in succeeds("ingest", manifest, "-o", there)
    assert "drone1" in succeeds("info", there)
    assert "drone1" in succeeds("info", manifest)
    refused("reconstruct", there, "--scheduler", "tcp://somewhere:1", code="bad-option")
    assert not list((cache / "sessions").glob("*/*.session"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    succeeds("export", there, "--to", "tum")
    assert list(Path("there.export").glob("*.tum"))


def test_sources_by_url_are_fetched_when_they_change(store: str, tmp_path: Path) -> None:
    put(f"{store}/logs/one.csv", b"1")
    put(f"{store}/logs/deep/two.csv", b"2")
    assert located(tmp_path, f"{store}/logs/one.csv").read_bytes() == b"1"
    assert (located(tmp_path, f"{store}/logs") / "deep" / "two.csv").read_bytes() == b"2"
    put(f"{store}/logs/one.csv", b"other")
    assert fetched(f"{store}/logs/one.csv").read_bytes() == b"1"
    assert fetched(f"{store}/logs/one.csv", fresh=True).read_bytes() == b"other"
    inside = fetched(f"{store}/logs/one.csv").parent
    assert source_url(inside, "deep/two.csv") == f"{store}/logs/deep/two.csv"
    assert source_url(tmp_path, "deep/two.csv") is None


def test_a_session_is_uploaded_once_when_it_is_done(store: str, tmp_path: Path) -> None:
    url, there = f"{store}/x.session", tmp_path / "store" / "x.session"
    with session_here(url, create=True) as copy:
        written(copy, a="1", gone="1")
        with pytest.raises(BusyError), session_here(url, create=True):
            pass
        assert not there.exists()
    with session_here(url) as copy:
        written(copy, a="2", b="1")
        (copy / "gone").unlink()
        (copy / ".partial").mkdir()
    assert texts(there) == {"session.json": "{}", "a": "2", "b": "1"}
    before = (there / "a").stat().st_mtime_ns
    with session_here(url):
        pass
    assert (there / "a").stat().st_mtime_ns == before
    with refusing("not-a-session", f"{store}/none.session"), session_here(f"{store}/none.session"):
        pass


def test_after_an_error_the_same_command_continues(
    store: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, there = f"{store}/x.session", tmp_path / "store" / "x.session"
    with session_here(url, create=True) as copy:
        written(copy, a="1")
    with pytest.raises(RuntimeError), session_here(url) as copy:  # noqa: PT012
        written(copy, a="2")
        raise RuntimeError
    assert texts(there)["a"] == "1"
    from fsspec.implementations.local import LocalFileSystem  # type: ignore[import-untyped]

    def broken(*_: object, **__: object) -> None:
        raise ConnectionError

    with monkeypatch.context() as patch:
        patch.setattr(LocalFileSystem, "put", broken)
        with refusing("store-unreachable", url), session_here(url) as copy:
            assert texts(copy)["a"] == "2"
    with session_here(url):
        pass
    assert texts(there)["a"] == "2"


@pytest.mark.parametrize(
    ("url", "code"),
    [
        (f"HTTPS://me:{SECRET}@host/x", "url-with-secret"),
        (f"https://host/{'?key' * 9999}/?a=1&token={SECRET}", "url-with-secret"),  # in no time
        (f"zip://inner.csv::https://me:{SECRET}@host/x.zip", "url-refused"),
        ("reference://x", "url-refused"),
    ],
)
def test_a_url_of_another_kind_or_with_a_secret_is_refused(url: str, code: str) -> None:
    for place in (url, Path(url)):
        with refusing(code):
            url_of(place)


def test_nothing_is_fetched_from_private_addresses_nor_by_redirection(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with served() as port:
        for host in ("127.0.0.1", "localhost", "0.0.0.0"):  # noqa: S104
            with refusing("url-refused"):
                fetched(f"http://{host}:{port}/secret")
        with refusing("store-unreachable"):  # what was not asked for may exist
            fetched("http://127.1/secret")
        assert not Server.asked
        monkeypatch.setattr(urls, "is_public", PUBLIC.__eq__)
        assert fetched(f"http://{PUBLIC}:{port}/line").read_bytes() == FIRST_LINE.encode()
        Server.target = f"http://127.0.0.2:{port}/secret"
        with refusing("url-refused"):
            fetched(f"http://{PUBLIC}:{port}/away")
        assert {*Server.asked} == {PUBLIC}
    monkeypatch.undo()
    for address in ("10.0.0.1", "192.168.1.1", "169.254.169.254", "fe80::1", "::1", "::ffff:127.0.0.1"):
        assert not urls.is_public(address)
    assert urls.is_public("93.184.216.34")


def test_what_is_no_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert url_of("C:/flights/flight.yaml") is None
    assert url_of("a/b.yaml") is None
    assert url_of(Path("s3://bucket/x/flight.yaml")) == "s3://bucket/x/flight.yaml"
    assert url_of("file:///x/y") == url_of(Path("file:///x/y")) == "file:///x/y"
    (tmp_path / "s3:").mkdir()
    assert url_of(Path("s3:")) is None
    assert mocap("export", "x.session", "-o", "s3://bucket/out").returncode == 2
