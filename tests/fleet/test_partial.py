"""Files of partial results: read back bit for bit, refused where they are damaged, and enough for a refinement."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fleets import write_fleet

import gtsam_rwhec as rw
from gtsam_rwhec import fleet
from gtsam_rwhec.fleet.container import packed, unpacked
from gtsam_rwhec.fleet.map_log import partial_file
from gtsam_rwhec.fleet.measured_problem import measured_problem
from gtsam_rwhec.fleet.merging import read_leaf
from gtsam_rwhec.fleet.pair_moments import PairMoments
from gtsam_rwhec.fleet.partial import KeptLog, KeptPair, in_single, read_kept, read_partial
from gtsam_rwhec.problem.measurements import Pair


def test_arrays_come_back() -> None:
    arrays = {"b": np.arange(6.0).reshape(2, 3), "a": np.array([3, 1], dtype=np.int64), "none": np.zeros((0, 4))}
    content = packed("partial", {"x": [1, "y"]}, arrays)
    assert content == packed("partial", {"x": [1, "y"]}, dict(reversed(arrays.items())))
    facts, found = unpacked(content, "partial", "file")
    assert facts == {"x": [1, "y"]}
    assert {name: (a.dtype, a.tolist()) for name, a in found.items()} == {
        name: (a.dtype, a.tolist()) for name, a in arrays.items()
    }


def test_damaged_and_other_files_are_refused() -> None:
    content = packed("partial", {}, {"a": np.arange(100.0)})
    for spoiled in (content[:-5], content[:-1] + bytes([content[-1] ^ 1]), content[:40]):
        with pytest.raises(rw.errors.FileFormatError, match=r"^k\.partial .*run (the fleet )?again"):
            unpacked(spoiled, "partial", "k.partial")
    with pytest.raises(rw.errors.FileFormatError, match=r"is no merged"):
        unpacked(content, "merged", "k.partial")
    with pytest.raises(rw.errors.ResultVersionError, match=r"is of format 9"):
        unpacked(content.replace(b" partial 1 ", b" partial 9 "), "partial", "k.partial")
    with pytest.raises(rw.errors.FileFormatError, match="no partial result of this version"):
        read_partial(content, "k.partial")


def test_measurements_come_back_bit_for_bit() -> None:
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (7, 1, 1))
    T[:, :3] = rng.normal(size=(7, 3, 4))
    root = rng.normal(size=(5, 6, 6))
    pixels = rng.uniform(0.0, 640.0, (5, 4, 2)).astype(np.float32).astype(float)
    pixels[0, 2] = np.nan
    stamps = 1_793_498_400_000_000_000 + np.array([0, 1, 5, 5, 9])
    one = KeptPair(stamps, T[:5], T[1:6], in_single(root @ root.transpose(0, 2, 1)), pixels)
    other = KeptPair(stamps[:2], T[:2], T[5:], None, None)
    kept = KeptLog({Pair("tag", "cam"): one, Pair("tag", "b"): other}, (stamps[:2], T[:2]))
    found = read_kept(kept.packed(), "file")
    for pair, before in kept.pairs.items():
        after = found.pairs[pair]
        for name in ("stamps_ns", "A", "B", "covariances", "pixels"):
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert found.path is not None
    np.testing.assert_array_equal(found.path[1], T[:2])


def test_kept_measurements_have_the_moments(tmp_path: Path) -> None:
    """What a refinement reads is what the moments were made of, with corners."""
    made = write_fleet(tmp_path, 1, 1, images=8, tags=2)
    output = str(tmp_path / "out")
    (row,) = fleet.run(fleet.read_manifest(made.manifest), output).rows
    (key, _) = row.receipts
    of = read_leaf(output, fleet.Receipt(key, partial_file(key), ""), "robot_000", at_site=True)
    rigs = {"robot_000": rw.rig.read_rig(made.rig)}
    found = measured_problem(of, rigs, output, at_site=True).problem
    again, names = PairMoments.of(found).about(of.moments.gauge), of.moments.pairs
    assert again.pairs == names
    assert {pair.sensor for pair in names} == {"robot_000/cam_0"}
    size = of.moments.magnitude
    assert (abs(again.translation - of.moments.translation) <= 1e-12 * size[:, :, None] * size[:, None]).all()
    assert found.cameras.keys() == {"robot_000/cam_0"}
    assert found.boards.keys() == {"tag_0", "tag_1"}
    for pair in names:
        pixels = found.measurements(*pair).pixels
        assert pixels is not None
        assert pixels.shape == (8, 4, 2)
        assert np.isfinite(pixels).all()


@pytest.mark.slow
def test_clocks_of_several_logs_are_estimated_as_one(tmp_path: Path) -> None:
    """Rotations tell each log another offset; the poses of all tell one, with its deviation."""
    made = write_fleet(tmp_path, 1, 3, images=20, tags=2)
    rig = Path(made.rig)
    rig.write_text(rig.read_text(encoding="utf-8").replace("tags, ", "tags, time_offset: estimate, "), encoding="utf-8")
    manifest, output = fleet.read_manifest(made.manifest), str(tmp_path / "out")
    (row,) = fleet.run(manifest, output).rows
    assert rw.Ground.COVARIANCE_DOUBTED in row.grounds
    assert "time offsets are those that rotations alone tell" in row.reason
    (row,) = fleet.run(manifest, output, fleet.FleetOptions(refine=True)).rows
    assert rw.Ground.COVARIANCE_DOUBTED not in row.grounds
    log = rw.results.read_result(tmp_path / "out" / str(row.result)).log
    assert log is not None
    (offset,) = log.time_offsets
    assert offset.sigma_s is not None
    assert abs(offset.offset_s) < 5.0 * offset.sigma_s < 0.005


@pytest.mark.slow
def test_a_refinement_has_the_measurements_and_corners(tmp_path: Path) -> None:
    made = write_fleet(tmp_path, 1, 2, images=12, tags=2)
    run = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "out"), fleet.FleetOptions(refine=True))
    (row,) = run.rows
    assert row.failure is None, row.failure
    assert row.basis is rw.Basis.MEASUREMENTS
    assert row.verdict is not rw.Verdict.DO_NOT_USE
    written = rw.read_refined(tmp_path / "out" / str(row.result))
    assert written.reprojection is not None, "it is from corners"
    assert abs(written.Y["cam_0"].translation() - made.truth["robot_000"]["cam_0"][:3, 3]).max() < 0.002
