"""Hashes of all files that a manifest names, and the check of the files' own checksums."""

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path

from pipelines.formats.logs.mcap_log import OTHER_CHECKSUM, CheckedHash, stated_checksum
from pipelines.formats.maps.ros_map import FORMAT as ROS_MAP
from pipelines.session.errors import DataError
from pipelines.session.manifest import Manifest
from pipelines.session.progress import Progress
from pipelines.session.storage import file_stamp, hash_of, refuse_special, sha256_of
from pipelines.session.urls import fetched, located, named, source_url

_HASHERS = 4


def hash_sources(
    flight: Manifest, base: Path, progress: Progress, meanwhile: Iterator[object]
) -> tuple[dict[str, str], dict[str, dict[str, int]]]:
    """Compute the sha256 of every file that is read, and the damage, both by the manifest's path.

    Steps of `meanwhile` run until all is hashed.
    """
    unique = flight.files
    for path in unique:  # before anything waits for one of them
        refuse_special(located(base, path))
    progress.start("Hashing sources", len(unique))
    hashes, damage = {}, {}
    with ThreadPoolExecutor(_HASHERS) as pool:  # hashing releases the GIL, so long logs run in parallel
        hashing = {path: pool.submit(_hash_of, located(base, path)) for path in unique}
        try:
            while not all(digest.done() for digest in hashing.values()) and next(meanwhile, None):
                pass
            for path, digest in hashing.items():
                hashes[path], differing = digest.result()
                if differing:
                    damage[path] = {OTHER_CHECKSUM: differing}
                progress.advance()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return hashes, damage


def fetch_sources(flight: Manifest, base: Path, progress: Progress) -> None:
    """Fetch the files that a manifest states by URL, where the copies in the cache are not as in the store.

    Raises:
        DataError: a store cannot be read, or holds no such file.
    """
    urls = [url for path in flight.files if (url := source_url(base, path))]
    if urls:
        progress.start("Fetching sources", len(urls))
    for url in urls:
        fetched(url, fresh=True)
        progress.advance()


def source_stamps(flight: Manifest, base: Path) -> dict[str, str]:
    """Return the stamp of every file that is read, by the manifest's path.

    Raises:
        DataError: one of them is missing or cannot be read.
    """
    stamps = {
        path: [file_stamp(file) for file in _source_files(located(base, path))] for path in flight.files
    }
    return {path: own[0] if len(own) == 1 else hash_of(own) for path, own in stamps.items()}


def refuse_written(flight: Manifest, base: Path, stamps: Mapping[str, str]) -> None:
    """Refuse sources that changed since they had these stamps, so that the hash fits what was read.

    Raises:
        DataError: a source changed, or is missing.
    """
    for path, stamp in source_stamps(flight, base).items():
        if stamp != stamps[path]:
            raise DataError(
                named(base, path),
                "was written to while it was being read",
                "run `mocap ingest` again when it is complete",
                code="changed",
            )


def _hash_of(path: Path) -> tuple[str, int]:
    """Compute the sha256 of a source, and count its files that differ from their own checksum.

    A floor plan's YAML is hashed together with the picture that it names.
    """
    hashes: list[CheckedHash] = []

    def hash_for(file: Path) -> CheckedHash:
        hashes.append(CheckedHash(stated_checksum(file)))
        return hashes[-1]

    digests = [sha256_of(file, hash_for) for file in _source_files(path)]
    digest = digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()
    return digest, sum(each.differs for each in hashes)


def _source_files(path: Path) -> list[Path]:
    """Return a source and the files that it refers to: a floor plan is a YAML and a picture."""
    if path.suffix.lower() in {".yaml", ".yml"} and ROS_MAP.recognises(path):
        return [path, *ROS_MAP.pictures(path)]
    return [path]
