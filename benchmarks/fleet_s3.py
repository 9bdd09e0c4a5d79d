"""Bytes that a log of an s3 store costs, against the chunks of the topics that its rig needs.

    python benchmarks/fleet_s3.py [--logs 5] [--seconds 120]

The store is moto's server on this machine, and counts the bytes of objects as they leave it. A log has transforms and
detections in bursts, and images of 200 kB at 10 Hz, which no rig asks for, in chunks of 300 kB as recorders write them.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from bars import Row, run_script
from mixed_log import TOPICS, write_mixed_log
from s3_server import BUCKET, s3_server

from gtsam_rwhec.fleet import stores
from gtsam_rwhec.fleet.topic_copy import Needed, local_copy_of_topics, needed_of
from gtsam_rwhec.logs import open_log


def rows(logs: int, seconds: int) -> list[Row]:
    """The table's rows."""
    whole = chunks = sent = asked = 0
    with tempfile.TemporaryDirectory() as temporary, s3_server() as server:
        for seed in range(logs):
            path, folder = Path(temporary) / "log.mcap", Path(temporary) / str(seed)
            folder.mkdir()
            whole += write_mixed_log(path, seconds, seed=seed)
            needed = needed_of(str(path), path.stat().st_size, TOPICS)
            assert isinstance(needed, Needed)
            chunks += needed.chunk_bytes
            url = f"s3://{BUCKET}/{seed}.mcap"
            stores.write_once(url, path.read_bytes())
            before = server.sent, server.asked
            with stores.counted_bytes() as count:
                copy = local_copy_of_topics(url, TOPICS, folder)
            assert count.count == server.sent - before[0]
            sent, asked = sent + count.count, asked + server.asked - before[1]
            with open_log(copy) as log:
                counts = {topic.name: topic.count for topic in log.topics()}
            assert counts["/tf"] == counts["/detections"] == 200 * (seconds // 10)
            copy.unlink()
    return [
        Row("bytes read over the needed topics' chunks", f"{sent / chunks:.3f}x", "<= 1.2x", sent <= 1.2 * chunks),
        Row("  bytes read, of the logs' bytes", f"{sent:,} of {whole:,} ({sent / whole:.1%})"),
        Row("  requests a log", f"{asked / logs:.1f}"),
    ]


if __name__ == "__main__":
    run_script("fleets: bytes from s3", rows, logs=5, seconds=120)
