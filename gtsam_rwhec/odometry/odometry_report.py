"""The report of a calibration of odometries, as people read it: verdict, what to do, poses, what is free, the proof."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import gtsam
import numpy as np

from gtsam_rwhec.files.terminal_text import shown_path
from gtsam_rwhec.odometry.odometry_result import OdometryResult, SensorRecord, is_odometry_result, read_odometry_result
from gtsam_rwhec.report.calibration_report import pose_cells
from gtsam_rwhec.report.html_page import write_page
from gtsam_rwhec.report.report_blocks import (
    TONES,
    Block,
    Folded,
    Listing,
    Number,
    Page,
    Paragraph,
    Section,
    Table,
    Words,
)
from gtsam_rwhec.report.terminal_report import (
    STYLES,
    print_blocks,
    print_list,
    print_sections,
    print_sentence,
    report_console,
)
from gtsam_rwhec.report.verdict_section import DEVIATION_HEADINGS, POSE_HEADINGS

#: A free direction moves a coordinate by more than this share of its largest twist; less is the tilt of the axes.
FREE_SHARE = 0.1
LEGEND = (
    "x, y, z: metres. roll, pitch, yaw: degrees, with R = Rz(yaw) Ry(pitch) Rx(roll). ±: one standard deviation along "
    "and about the sensor's own axes; free: not determined."
)


def print_odometry(result: OdometryResult, *, verbose: bool = False, page: Path | None = None) -> None:
    """Print the report of a calibration of odometries: what matters, or all that its page says."""
    console = report_console()
    print_sentence(console, str(result.judgement), STYLES[result.verdict])
    sections = odometry_page(result).sections[1:]
    if verbose:
        print_sections(console, sections)
    else:
        print_sentence(console, f"{result.certificate.sentence}.")
        print_list(console, [f"{words[:1].upper()}{words[1:]}." for words in result.remarks])
        print_blocks(console, next(one.blocks for one in sections if one.name == "poses"))
    more = [*([] if page is None else [shown_path(page)]), *([] if verbose else ["--verbose"])]
    if more:
        print_sentence(console, f"{'The page' if verbose else 'Everything else'}: {', or '.join(more)}.")


def pose_table(result: OdometryResult) -> Table:
    """Poses in the frame of the reference, with their standard deviations."""
    rows: dict[str, tuple[Words, ...]] = {
        one.sensor: (*_pose(result, one), *_deviations(one)) for one in result.sensors
    }
    title = f"Sensors in the frame of {result.reference}"
    return Table.of(title, "sensor", (*POSE_HEADINGS, *DEVIATION_HEADINGS), rows, LEGEND)


def _pose(result: OdometryResult, one: SensorRecord) -> tuple[str, ...]:
    """The pose, with "free" in the place of a coordinate that a free direction moves, and of angles that one turns."""
    T = np.array(one.T_parent_child)
    cells = list(pose_cells(gtsam.Pose3(T)))
    for direction in result.free_directions:
        twist = np.array(direction.frames.get(one.sensor, np.zeros(6)))
        shift = np.abs(T[:3, :3] @ twist[3:])
        largest = max((float(np.linalg.norm(other)) for other in direction.frames.values()), default=0.0)
        turned = float(np.linalg.norm(twist[:3])) > FREE_SHARE * largest
        for i in range(3):
            cells[i] = "free" if shift[i] > FREE_SHARE * largest else cells[i]
            cells[3 + i] = "free" if turned else cells[3 + i]
    return tuple(cells)


def _deviations(one: SensorRecord) -> tuple[str, ...]:
    """Standard deviations in mm, then in degrees."""
    millimetres = ("free" if x is None else f"{x:.2f}" for x in one.standard_deviations_mm)
    degrees = ("free" if x is None else f"{x:.3f}" for x in one.standard_deviations_deg)
    return (*millimetres, *degrees)


def scales_and_clocks(result: OdometryResult) -> list[str]:
    """Scales and time offsets, in a sentence each."""
    said = []
    for one in result.sensors:
        if one.scale is not None:
            sigma = "not determined" if one.scale_sigma is None else f"± {one.scale_sigma:.2g}"
            said.append(f"scale of {one.sensor}: {one.scale:.5g} {sigma} (measured length / true length).")
        if one.time_offset_sigma_s is not None:
            said.append(
                f"clock of {one.sensor}: its stamp t is t {1e3 * one.time_offset_s:+.2f} ms of {result.reference}, ± "
                f"{1e3 * one.time_offset_sigma_s:.2g} ms."
            )
    return said


def given_in_words(result: OdometryResult) -> list[str]:
    """Each given number, what it moves, and whether the motions agree to it."""
    said = []
    for one in result.given:
        moved = [(size, name) for name, size in one.moved_mm_per_sigma.items()]
        turned = max(one.turned_deg_per_sigma.values(), default=0.0)
        most, name = max(moved, default=(0.0, ""))
        effect = "moves no pose" if not name else f"moves {name} by {most:.2g} mm"
        effect += f" and turns a sensor by {turned:.2g}°" if turned > 1e-4 else ""
        agreement = f"the motions are {one.off_by_sigmas:.1f} standard deviations away"
        if one.off_by_sigmas == 0.0:
            agreement = "the motions do not measure it"
        said.append(
            f"{one.what} = {one.value:g} ± {one.sigma:.2g} {one.unit}: an error of one standard deviation {effect}; "
            f"{agreement}."
        )
    return said


#: Before the name of a field in a result file.
OF = "result.json#"


def write_odometry_page(result: OdometryResult | str | Path, path: str | Path) -> None:
    """Write the page of a calibration of odometries, which needs no network; `result` or its file."""
    record = result if isinstance(result, OdometryResult) else read_odometry_result(_file(result))
    write_page(odometry_page(record), path)


def is_page_of_odometries(result: str | Path) -> bool:
    """Whether a result file, or that of an output folder, is of a calibration of odometries."""
    file = _file(result)
    try:
        with file.open("rb") as stream:
            return is_odometry_result(stream.read(1000))
    except OSError:
        return False  # who reads it says why


def _file(result: str | Path) -> Path:
    path = Path(result)
    return path / "result.json" if path.is_dir() else path


def odometry_page(result: OdometryResult) -> Page:
    """The page's sections: verdict, poses, what is free, what was given, noise, the proof."""
    tone = TONES[result.verdict]
    free = result.not_determined or tuple(one.sentence for one in result.free_directions)
    others = tuple(f"{one.why}: its cost is {one.cost_above:.2g} above the answer's." for one in result.other_answers)
    said = (*result.findings, *result.remarks)
    determined = "The motions, with what was given, determine every pose and scale."
    open_ = (Listing((*free, *others)),) if free or others else (Paragraph(determined, "good"),)
    proof: list[Block] = [Paragraph(f"{result.certificate.sentence}.")]
    if result.free_directions:
        records = Listing(tuple(one.sentence for one in result.free_directions))
        proof.append(Folded("Free directions as records", (records,)))
    sections = (
        Section("verdict", "Verdict", (Paragraph(str(result.judgement), tone), *_listed(said))),
        Section(
            "poses",
            f"Poses in the frame of {result.reference}",
            (pose_table(result), *_listed(scales_and_clocks(result))),
        ),
        Section("determines", "What the motions determine", open_),
        Section(
            "given", "What was given", _listed(given_in_words(result)), "" if result.given else "nothing was given."
        ),
        Section("noise", "Noise and windows", tuple(_noise(result))),
        Section("proof", "The proof", tuple(proof)),
    )
    return Page("Calibration of odometries", tone, sections, f"Written by {result.written_by}.")


def _listed(said: Sequence[str]) -> tuple[Block, ...]:
    return (Listing(tuple(said)),) if said else ()


def _noise(result: OdometryResult) -> Iterator[Block]:
    rows = tuple(
        (
            one.sensor,
            "found" if one.noise.was_found else "stated",
            Number(f"{OF}/tracks/{i}/noise/rotation_deg_per_sqrt_s", one.noise.rotation_deg_per_sqrt_s, spec=".2g"),
            Number(f"{OF}/tracks/{i}/noise/translation_mm_per_sqrt_s", one.noise.translation_mm_per_sqrt_s, spec=".3g"),
            Number(f"{OF}/tracks/{i}/residual_rotation", one.residual_rotation, spec=".2f"),
            Number(f"{OF}/tracks/{i}/residual_translation", one.residual_translation, spec=".2f"),
            Number(f"{OF}/tracks/{i}/windows", one.windows, spec=".0f"),
        )
        for i, one in enumerate(result.tracks)
    )
    headings = ("sensor", "noise", "° after 1 s", "mm after 1 s", "residuals, turn", "residuals, way", "windows")
    legend = "Residuals are root mean squares in standard deviations: 1 is expected."
    yield Table("How errors grow, and how well the motions agree", headings, rows, legend)
    yield Paragraph(f"{result.windows} windows of {result.window_s:.3g} s, all sensors at once.")
    removed = [
        f"not used of {one.sensor}: {', '.join(f'{why}: {count}' for why, count in one.removed.items())}."
        for one in result.tracks
        if one.removed
    ]
    yield Listing(tuple(removed)) if removed else Paragraph("No pose is left out, and no window as an outlier.")
