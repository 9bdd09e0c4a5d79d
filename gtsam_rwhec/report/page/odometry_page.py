"""The report of a calibration of odometries as one HTML page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.odometry.odometry_file import OdometryResult, is_odometry_result, read_odometry_result
from gtsam_rwhec.report.odometry_report import (
    LEGEND,
    given_in_words,
    pose_table,
    proof_in_words,
    removed_in_words,
    scales_and_clocks,
)
from gtsam_rwhec.report.page.blocks import Block, Folded, Listing, Number, Page, Paragraph, Section, Table
from gtsam_rwhec.report.page.html import write_page

TONES = {Verdict.USE: "good", Verdict.CARE: "care", Verdict.DO_NOT_USE: "bad"}
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
    determined = "The motions, with what was given, determine every pose and scale."
    open_ = (Listing((*free, *others)),) if free or others else (Paragraph(determined, "good"),)
    given: tuple[Block, ...] = (Listing(tuple(given_in_words(result))),)
    sections = (
        Section("verdict", "Verdict", (Paragraph(str(result.judgement), tone), *_findings(result))),  # type: ignore[arg-type]
        Section("poses", f"Poses in the frame of {result.reference}", tuple(_poses(result))),
        Section("determines", "What the motions determine", open_),
        Section("given", "What was given", given if result.given else (), "" if result.given else "nothing was given."),
        Section("noise", "Noise and windows", tuple(_noise(result))),
        Section("proof", "The proof", tuple(_proof(result))),
    )
    return Page("Calibration of odometries", tone, sections, f"Written by {result.written_by}.")  # type: ignore[arg-type]


def _findings(result: OdometryResult) -> Iterator[Block]:
    if result.findings or result.remarks:
        yield Listing((*result.findings, *result.remarks))


def _poses(result: OdometryResult) -> Iterator[Block]:
    table = pose_table(result)
    yield Table(table.title, ("sensor", *table.headings), tuple((n, *cells) for n, cells in table.rows.items()), LEGEND)
    said = scales_and_clocks(result)
    if said:
        yield Listing(tuple(said))


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
    removed = removed_in_words(result)
    yield Listing(tuple(removed)) if removed else Paragraph("No pose is left out, and no window as an outlier.")


def _proof(result: OdometryResult) -> Iterator[Block]:
    yield Paragraph(proof_in_words(result)[0])
    if result.free_directions:
        yield Folded("Free directions as records", (Listing(tuple(one.sentence for one in result.free_directions)),))
