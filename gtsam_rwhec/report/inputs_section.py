"""Section 9: what the calibration was made of, enough to make it again; and the poses as texts to copy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from rwhec_factors.se3 import pose

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.report.report_blocks import Block, CopyText, Folded, Paragraph, Section, Table
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.schema import SENSOR_CARRIER, TARGET_CARRIER
from gtsam_rwhec.rig.exported_files import copied_texts
from gtsam_rwhec.rig.rig_frames import RigFrames

#: The kind of each text, before the name of its file.
KINDS = {"static_tf.launch.py": "ROS 2 launch file", "rig.urdf.xacro": "URDF", "tf.yaml": "YAML", "poses.py": "Python"}
#: A table of more files is folded.
FEW_FILES = 12


def inputs_section(shown: ShownResult) -> Section:
    """The poses to copy; files with checksums, versions, options, seeds, the rig file and the command."""
    blocks = [*_copies(shown), *_inputs(shown)]
    return Section("inputs", "Inputs and versions", tuple(blocks))


def _copies(shown: ShownResult) -> Iterator[Block]:
    """The poses as texts of other programs."""
    if shown.result is None:
        yield Paragraph("There are no poses to copy: the calibration has no answer.", "note")
        return
    verdict = Verdict(shown.tree["verdict"])
    yield Paragraph("The poses, to copy")
    if verdict is not Verdict.USE:
        yield Paragraph("Each text has the verdict in its head.", "note")
    inputs = None if shown.evidence is None else shown.evidence.inputs
    texts = {} if inputs is None else inputs.copies
    if not texts:
        try:
            texts = copied_texts(frames_of_tree(shown.tree))
        except RwhecError as error:
            yield Paragraph(f"Not shown, because other programs cannot read them: {error}.", "absent")
            return
    for name, text in texts.items():
        if name in KINDS:
            yield CopyText(name.split(".")[0].replace("_", "-"), f"{KINDS[name]} ({name})", text)


def frames_of_tree(tree: Mapping[str, Any]) -> RigFrames:
    """The frames of a result's JSON under the carriers' names that it has, with the verdict as a warning.

    Raises `FrameError` if a name cannot be the name of a frame in other programs' files.
    """
    verdict = Verdict(tree["verdict"])
    warnings: tuple[str, ...] = () if verdict is Verdict.USE else (f"{verdict.words}: {tree['verdict_reason']}.",)
    wrong = [row["child"] for side in ("sensors", "targets") for row in tree[side] if row.get("contradicted")]
    if wrong:
        warnings += (f"Do not use these poses, which their own measurements contradict: {', '.join(wrong)}",)
    return RigFrames(
        sensor_carrier=tree["sensors"][0]["parent"] if tree["sensors"] else SENSOR_CARRIER,
        target_carrier=tree["targets"][0]["parent"] if tree["targets"] else TARGET_CARRIER,
        sensors={row["child"]: _matrix(row) for row in tree["sensors"]},
        targets={row["child"]: _matrix(row) for row in tree["targets"]},
        warnings=warnings,
    )


def _matrix(row: Mapping[str, Any]) -> np.ndarray:
    return pose(row["rotation_matrix"], row["translation_m"])


def _inputs(shown: ShownResult) -> Iterator[Block]:
    """What the evidence has of the inputs."""
    yield Paragraph(f"The result is {shown.name}, of format version {shown.tree['format_version']}.")
    inputs = None if shown.evidence is None else shown.evidence.inputs
    if inputs is None:
        yield Paragraph(
            "Not shown: files, versions and options, for the result has no evidence.json beside it.", "absent"
        )
        return
    if inputs.command:
        yield CopyText("command", "The command that makes it again", inputs.command)
    if inputs.rig_file is not None:
        yield CopyText("rig", "The rig file (rig.yaml)", inputs.rig_file)
    if inputs.files:
        table = Table(
            f"Files ({len(inputs.files)})",
            ("file", "bytes", "SHA-256"),
            tuple(
                (file.name, shown.evident("inputs", "files", i, "bytes", spec=".0f"), file.sha256)
                for i, file in enumerate(inputs.files)
            ),
        )
        yield table if len(inputs.files) <= FEW_FILES else Folded(table.caption, (table,))
    else:
        yield Paragraph("The measurements came from a program, not from files.")
    if inputs.options:
        yield Table("Options that are not the default", ("option", "value"), tuple(inputs.options.items()))
    else:
        yield Paragraph("All options of the calibration are the default.")
    if inputs.seeds:
        rows = tuple((what, shown.evident("inputs", "seeds", what, spec=".0f")) for what in inputs.seeds)
        yield Table("Seeds of random numbers", ("what draws them", "seed"), rows)
    yield Table("Versions", ("package", "version"), tuple(inputs.versions.items()))
