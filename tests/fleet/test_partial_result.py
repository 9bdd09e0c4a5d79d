"""What is kept of a log: bit for bit, the measurements and corners of its cleaned log; what is damaged is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fleets import write_fleet

import gtsam_rwhec as rw
from gtsam_rwhec import fleet
from gtsam_rwhec.fleet.partial_result import LogFacts, PairMeasurements, PartialResult, read_partial
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.log_history import CleaningReport, DetectionReport

FACTS = LogFacts(
    url="log.mcap", begin_ns=0, end_ns=9, about="sensorcarrier", cameras={},
    detection=DetectionReport(sources=("log.mcap",), images={}, undecoded={}, tracks=(), strangers={}, corner_px={}),
    cleaning=CleaningReport(tracks=(), time_offsets_s={}, coarse_sigma_s={}), poses={"cam": 5},
)  # fmt: skip


def kept() -> PartialResult:
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (7, 1, 1))
    T[:, :3] = rng.normal(size=(7, 3, 4))
    root = rng.normal(size=(5, 6, 6))
    single = (root @ root.transpose(0, 2, 1)).astype(np.float32).astype(float)
    pixels = rng.uniform(0.0, 640.0, (5, 4, 2)).astype(np.float32).astype(float)
    pixels[0, 2] = np.nan
    stamps = 1_793_498_400_000_000_000 + np.array([0, 1, 5, 5, 9])
    one = PairMeasurements(stamps, T[:5], T[1:6], 0.5 * (single + single.transpose(0, 2, 1)), pixels)
    other = PairMeasurements(stamps[:2], T[:2], T[5:], None, None)
    return PartialResult(FACTS, {Pair("tag", "cam"): one, Pair("tag", "b"): other}, (stamps[:2], T[:2]))


def test_measurements_come_back_bit_for_bit() -> None:
    before = kept()
    found = read_partial(before.packed(), "file")
    assert found.facts == FACTS
    assert found.packed() == before.packed() == kept().packed()
    for pair, one in before.pairs.items():
        for name in ("stamps_ns", "A", "B", "covariances", "pixels"):
            np.testing.assert_array_equal(getattr(found.pairs[pair], name), getattr(one, name))
    assert found.path is not None
    assert before.path is not None
    np.testing.assert_array_equal(found.path[1], before.path[1])


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    content = kept().packed()
    for spoiled in (content[:-5], content[:40], b""):
        with pytest.raises(rw.errors.FileFormatError, match=r"^k\.partial .*run again"):
            read_partial(spoiled, "k.partial")
    made = write_fleet(tmp_path, 1, 1, images=8, tags=1, corners=False)
    output = tmp_path / "out"
    assert fleet.run(fleet.read_manifest(made.manifest), str(output)).rows[0].failure is None
    (file,) = output.glob("partials/*.partial")
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    for answer in output.glob("answers/*"):
        answer.unlink()
    (row,) = fleet.run(fleet.read_manifest(made.manifest), str(output)).rows
    assert "its checksum is not that of its receipt" in str(row.failure)
