"""A log on this machine's disk: one that is there already, or a copy of one in a store."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.fleet.stores import local_path, read_bytes, size_of


def local_copy_of_topics(url: str, topics: tuple[str, ...], folder: Path) -> tuple[Path, int]:
    """The path of a log that has at least some topics, and how many bytes of the store it took."""
    path = local_path(url)
    if path is not None:
        return path, size_of(url)
    content = read_bytes(url)
    copy = folder / "log.mcap"
    copy.write_bytes(content)
    return copy, len(content)
