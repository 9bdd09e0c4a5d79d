"""Names in rig files and logs never lead out of the folder of the results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic_logs as made
from bad_logs import RECORDED, WRITTEN
from synthetic_logs import BEGIN_NS

from gtsam_rwhec.errors import RigError
from gtsam_rwhec.logs import LogWriter
from gtsam_rwhec.runs.output_folder import LIST_FILE
from gtsam_rwhec.runs.run_log import DETECTION_METADATA, RIG_METADATA
from gtsam_rwhec.runs.whole_runs import calibrate_log

pytestmark = pytest.mark.usefixtures("without_figures")

TAG = f"{{type: tag, family: tag36h11, id: 0, size_m: {made.SIZE_M}}}"
ELSEWHERE = "../../x"


@pytest.mark.parametrize(
    ("pieces", "words"),
    [
        ({"tag_0": f"{TAG}\n  {ELSEWHERE}: {TAG}"}, "line 13: targets.../../x: '../../x' cannot be a frame's name"),
        ({"cam_1": f"detections: /a\n  {ELSEWHERE}: {{detections: /b}}"}, "line 11: sensors.../../x: '../../x' cannot"),
        ({"cam_1": f"detections: /a\n    frame: {ELSEWHERE}"}, "line 11: sensors.cam_1.frame: '../../x' cannot"),
        ({"poses": f"{{tf: [{ELSEWHERE}, hand]}}"}, "line 4: carriers.poses.tf[0]: '../../x' cannot"),
    ],
)
def test_a_rig_files_names_are_no_paths(pieces: dict[str, str], words: str) -> None:
    with pytest.raises(RigError) as caught:
        made.rig(**pieces)
    assert words in str(caught.value)


def test_the_names_in_an_embedded_rig_file_are_no_paths(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "detected.mcap") as out:
        out.metadata(RIG_METADATA, {"yaml": made.rig_text().replace("tag_0:", f"{ELSEWHERE}:")})
        out.metadata(DETECTION_METADATA, {"json": "{}"})
    with pytest.raises(RigError, match=r"detected\.mcap, metadata gtsam_rwhec\.rig, line 12.*'\.\./\.\./x' cannot"):
        calibrate_log(tmp_path / "detected.mcap", None, tmp_path / "a" / "b" / "out")
    assert {path.name for path in tmp_path.rglob("*")} <= {"detected.mcap", "a", "b", "out"}


def test_a_logs_names_are_no_paths(tmp_path: Path) -> None:
    messages = [replace(m, topic=f"/{ELSEWHERE}/tags") if m.topic == "/cam_0/tags" else m for m in RECORDED]
    stranger = made.tag(7, np.eye(4), family=ELSEWHERE) | {"id": ELSEWHERE}
    messages.append(made.detections(f"/{ELSEWHERE}/tags", BEGIN_NS + 4 * 10**9, ELSEWHERE, [stranger]))
    messages.append(made.transform(BEGIN_NS, ELSEWHERE, "base", np.eye(4), "/tf_static"))
    messages.append(replace(made.camera_info("cam_0"), topic=ELSEWHERE))
    log = made.write(tmp_path / "raw.mcap", messages)
    out = tmp_path / "a" / "b" / "out"
    calibrated = calibrate_log(log, made.rig(cam_0=f"detections: /{ELSEWHERE}/tags"), out)
    assert calibrated.log.detection.strangers == {f"{ELSEWHERE} {ELSEWHERE}": 1}
    assert [path for path in tmp_path.rglob("*") if path.is_file() and out not in path.parents] == [log]
    assert {path.name for path in out.iterdir()} == WRITTEN | {LIST_FILE}
