"""The last sections: what was chosen and why, what became of a log's measurements, and what all was made of."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.report.report_blocks import Block, CopyText, Folded, Listing, Paragraph, Section, Table, Words, worded
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.log_history import LogFields, TrackCount
from gtsam_rwhec.results.schema import SENSOR_CARRIER, TARGET_CARRIER
from gtsam_rwhec.rig.exported_files import copied_texts
from gtsam_rwhec.rig.rig_frames import RigFrames

TITLE = "What was chosen, and why"
NOISE_LEGEND = (
    "Noise of B along and about each axis, of the median measurement, before any fit. Residuals are weighted: far and "
    "oblique measurements are noisier and count less, so the residuals' root mean square can be far smaller."
)
LOG_LEGEND = (
    "seen: detections in the images. usable: detections that were not rejected. cleaned: measurements after the "
    "cleaning. used: measurements in the answer."
)
#: Unit of the compared value at the end of a reason: counts have no unit.
_UNIT = re.compile(r" \((?:s|rad|m|rad/s|m/s|m moved|share that agrees)\)$")


def choices_section(shown: ShownResult) -> Section:
    """Choices with their evidence, noise, and the cost of the refinement."""
    result = shown.result
    made = None if result is None else result.calibration
    if made is None and (result is None or result.refined is None):
        return Section("choices", TITLE, missing="nothing was chosen: this is a solution as the problem states it.")
    blocks: list[Block] = []
    if made is not None:
        blocks.append(Listing(tuple(map(str, made.choices))))
        if made.notes:
            blocks.append(Listing(made.notes, "care"))
        if made.cannot_tell:
            facts = "; ".join(words.removeprefix("data cannot tell: ") for words in made.cannot_tell)
            blocks.append(Paragraph(f"Not checked, as no residual shows it: {facts}.", "note"))
        blocks += [Paragraph(words) for words in (made.outliers, made.noise) if words]
    return Section("choices", TITLE, (*blocks, *_refinement(shown)))


def _refinement(shown: ShownResult) -> Iterator[Block]:
    """The noise of each pair, outliers where no choice says them, and what the refinement cost."""
    refined = None if shown.result is None else shown.result.refined
    if refined is None:
        return
    at = ("refined", "noise")
    rows: tuple[tuple[Words, ...], ...] = tuple(
        (
            f"{row['target']}, {row['sensor']}",
            shown.number(*at, i, "rotation_rad", times=float(np.degrees(1.0)), spec=".3g"),
            shown.number(*at, i, "translation_m", times=1e3, spec=".3g"),
            *(shown.number(*at, i, "degrees_of_freedom", k, spec=".0f") for k in range(2)),
        )
        for i, row in enumerate(shown.tree["refined"]["noise"])
    )
    source = "estimated from the residuals" if refined.noise_source == "estimated" else "as given"
    headings = ("pair", "±°", "±mm", "d.o.f. (°)", "d.o.f. (mm)")
    yield Table(f"Noise of B, {source}", headings, rows, f"{NOISE_LEGEND} d.o.f.: degrees of freedom; free: exact.")
    if shown.result is not None and shown.result.calibration is None and refined.inlier_counts:
        counts = {pair: (number - kept, number) for pair, (kept, number) in refined.inlier_counts.items()}
        total = sum(number for _, number in counts.values())
        out = [f"{pair} {left} of {number}" for pair, (left, number) in counts.items() if left]
        left_out = sum(left for left, _ in counts.values())
        said = f"{left_out} of {total} measurements left out: {', '.join(out)}" if out else f"none of {total}"
        yield Paragraph(f"Outliers: {said}.")
    moved = max(refined.moved.items(), key=lambda item: item[1].translation_mm)
    start = "" if refined.reprojection is not None else "from {initial_cost} "
    words = (
        f"Cost of the refinement: {start}to {{cost}} after {{iterations}} steps "
        f"({shown.tree['refined']['residual']} residual, robust loss: {shown.tree['refined']['robust']}). Do not "
        "compare it with the certified cost, which has other weights. It moved the poses by up to "
        f"{moved[1].translation_mm:.2f} mm ({{frame}})."
    )
    specs = {"initial_cost": ".6g", "cost": ".6g", "iterations": ".0f"}
    numbers = {field: shown.number("refined", field, spec=spec) for field, spec in specs.items()}
    yield Paragraph(worded(words, frame=moved[0], **numbers))


def log_blocks(log: LogFields) -> Iterator[Block]:
    """Numbers of images, what every stage used of each pair, why others were removed, and sizes that were found."""
    images = ", ".join(f"{count} of {sensor}" for sensor, count in log.detection.images.items())
    yield Paragraph(f"Images in {', '.join(log.detection.sources)}: {images}.")
    cleaned = {track.pair: track.used for track in log.cleaning.tracks}
    used = {count.pair: count.used for count in log.outliers}
    rows: dict[str, tuple[Words, ...]] = {
        str(track.pair): tuple(map(str, (track.seen, track.used, cleaned.get(track.pair, 0), used.get(track.pair, 0))))
        for track in log.detection.tracks
    }
    yield Table.of("Measurements by stage", "pair", ("seen", "usable", "cleaned", "used"), rows, LOG_LEGEND)
    rejected = {why for track in log.detection.tracks for why in track.removed}  # the cleaning counts these again
    for stage, reasons in (
        ("Rejected in detection", _by_reason(log.detection.tracks, set())),
        ("Removed in cleaning", _by_reason(log.cleaning.tracks, rejected)),
    ):
        if reasons:
            yield Paragraph(f"{stage}: {'; '.join(reasons)}.")
    for size in log.sizes:
        if size.is_free and size.sigma is not None:
            found_mm, sigma_mm = (1e3 * size.stated_m * x for x in (1.0 / size.scale, size.sigma / size.scale**2))
            yield Paragraph(
                f"Size of {size.target}: stated {1e3 * size.stated_m:.3f} mm, found {found_mm:.3f} ± {sigma_mm:.3f} mm."
            )


def _by_reason(tracks: Iterable[TrackCount], told_before: set[str]) -> list[str]:
    """Each reason with its counts, except the reasons of an earlier stage."""
    reasons: dict[str, dict[str, int]] = {}
    for track in tracks:
        for why, count in track.removed.items():
            if why not in told_before:
                reasons.setdefault(why, {})[str(track.pair)] = count
    return [
        f"{_UNIT.sub('', why)}: {sum(counts.values())} "
        f"({', '.join(f'{count} of {pair}' for pair, count in counts.items())})"
        for why, counts in sorted(reasons.items())
    ]


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

    Raises
    ------
    FrameError
        A name cannot be the name of a frame in other programs' files.
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
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = row["rotation_matrix"], row["translation_m"]
    return T


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
