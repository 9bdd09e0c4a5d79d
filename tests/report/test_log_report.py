"""The report says how many measurements were removed, for which reason."""

from __future__ import annotations

from pathlib import Path

import gtsam_rwhec as rw
from gtsam_rwhec.report.log_report import log_sentences
from gtsam_rwhec.results.log_history import TrackCount
from gtsam_rwhec.results.removed_measurements import RemovalReason

GOLDEN = Path(__file__).parents[1] / "golden"


def test_a_count_has_no_unit() -> None:
    """ "rotation off the pair's consensus (rad): 2" read as an angle of 2 rad."""
    log = rw.results.read_result(GOLDEN / "result_log.json").log
    assert log is not None
    track = TrackCount(target="tag", sensor="cam", used=5, removed={RemovalReason.ROTATION_OFF: 2})
    cleaning = log.cleaning.model_copy(update={"tracks": (track,)})
    sentences = log_sentences(log.model_copy(update={"cleaning": cleaning}))
    assert "Removed in cleaning: rotation off the pair's consensus: 2 (2 of tag-cam)." in sentences
