"""Section 9: what the calibration was made of, enough to make it again."""

from __future__ import annotations

from gtsam_rwhec.report.page.blocks import Block, CopyText, Section, Table
from gtsam_rwhec.report.page.shown_result import ShownResult


def inputs_section(shown: ShownResult) -> Section:
    """Files with checksums, versions, options and the rig file."""
    title = "Inputs and versions"
    inputs = None if shown.evidence is None else shown.evidence.inputs
    if inputs is None:
        return Section("inputs", title, missing="the result has no record of its inputs beside it.")
    blocks: list[Block] = [
        Table(
            "Files",
            ("file", "bytes", "SHA-256"),
            tuple(
                (file.name, shown.evident("inputs", "files", i, "bytes", spec=".0f"), file.sha256)
                for i, file in enumerate(inputs.files)
            ),
        ),
        Table("Versions", ("package", "version"), tuple(inputs.versions.items())),
    ]
    if inputs.rig_file is not None:
        blocks.append(CopyText("rig", "The rig file", inputs.rig_file))
    return Section("inputs", title, tuple(blocks))
