"""Section 5: bound, cost, gap, cause, spectrum of Z and path, each with what it means and what it does not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.advice import limits_of, time_sentence, weights_sentence
from gtsam_rwhec.report.figures import BLUE, GREY, INK, ORANGE, VERMILLION, SvgFigure, svg_figure
from gtsam_rwhec.report.report_blocks import (
    Block,
    Chart,
    Folded,
    Listing,
    Paragraph,
    Section,
    Table,
    Tone,
    Words,
    worded,
)
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.solver.certificate import Certificate, Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEADLINES: Mapping[Status, tuple[str, Tone]] = {
    Status.CERTIFIED: ("Proven: no other answer fits these measurements better, and they determine it.", "good"),
    Status.CERTIFIED_NOT_UNIQUE: ("Proven, but not unique: no answer fits better, and others fit as well.", "care"),
    Status.GAP: ("Not proven: a better answer may exist.", "bad"),
    Status.FAILED: ("Not proven: there is no bound on what a better answer could cost.", "bad"),
}
ABOUT = (
    "It says nothing of the measurements: of wrong ones it proves the best answer to wrong measurements. The verdict "
    "judges those, and the standard deviations say how far off a pose may be."
)
#: Which answer the proof is about, where the poses shown are of another fit.
OF_CERTIFIED = "This is about the certified answer, at which the refinement began. "
ABSENT = "Not shown: the spectrum of Z"


def proof_section(shown: ShownResult) -> Section:
    """The certificate, fact by fact, and the spectrum of Z."""
    title = "Proof"
    if shown.result is None:
        return Section("proof", title, missing="the calibration has no answer.")
    certificate = shown.result.solution.certificate
    words, tone = HEADLINES[certificate.status]
    blocks: list[Block] = [Paragraph(words + limits_of(certificate), tone)]
    sentence = shown.tree["certified"]["certificate"].get("sentence")
    if sentence:
        blocks.append(Paragraph(f"In the result's words: {sentence}."))
    blocks += [
        Listing(tuple(_facts(shown, certificate))),
        *_spectra(shown),
        *_parts(shown),
        Paragraph(("" if shown.result.refined is None else OF_CERTIFIED) + ABOUT, "note"),
    ]
    return Section("proof", title, tuple(blocks))


def _facts(shown: ShownResult, certificate: Certificate) -> Iterator[Words]:
    at = ("certified", "certificate")
    meaning = (
        "has no statistical meaning, for no noise was stated"
        if certificate.is_relative
        else "is of the inverse equation, and no chi-square"
        if certificate.objective.form == "inverse"
        else "is half a chi-square, if the stated noise is true"
    )
    yield worded(
        f"Cost of the answer: {{cost}}. It sums the squared residuals, weighted, and {meaning}. A small cost does not "
        "mean that poses are right.",
        cost=shown.number(*at, "cost", spec=".8g"),
    )
    if np.isfinite(certificate.lower_bound):
        region = "no answer" if certificate.region is None else f"no answer within {certificate.region.distance}"
        yield worded(
            f"Lower bound: {{bound}}. It means that {region} costs less, rounding counted. It does not mean that no "
            "answer costs as much.",
            bound=shown.number(*at, "lower_bound", spec=".8g"),
        )
    else:
        yield "Lower bound: none was found. It does not mean that the answer is bad, only that nothing is known."
    yield from _gap(shown)
    yield (
        f"Cause: {certificate.reason}. It says why the gap is closed, or why not; it does not say how well the motion "
        "determines the poses."
    )
    yield (
        f"Path: {certificate.path.words}. It says how the answer and its bound came about; the proof does not depend "
        "on it, for it compares cost and bound alone."
    )
    of_scales = " Refine the answer for the exact model of each target's scale."
    more = of_scales if certificate.objective.form == "inverse" else ""
    yield f"Objective: {certificate.objective}. Another objective has another optimum.{more}"
    assert shown.result is not None
    refined = shown.result.refined
    is_estimated = refined is not None and refined.noise_source == "estimated"
    yield weights_sentence(shown.result.solution, noise_is_estimated=is_estimated)
    yield time_sentence(certificate)
    eigenvalue = shown.number(*at, "min_eigenvalue", spec=".2g")
    if eigenvalue.value is not None:
        yield worded(
            "Smallest eigenvalue of Z, at least: {eigenvalue}. Zero up to rounding means that no direction lowers the "
            "cost; it does not say how fast the cost rises.",
            eigenvalue=eigenvalue,
        )


def _gap(shown: ShownResult) -> Iterator[Words]:
    """The gap, if the evidence has it."""
    proof = shown.evidence_tree.get("proof")
    if not proof or proof["gap"] is None:
        return
    numbers = {
        "gap": shown.evident("proof", "gap", spec=".2g"),
        "relative": shown.evident("proof", "relative_gap", spec=".1e"),
        "tolerance": shown.number("certified", "certificate", "tolerance", spec=".2g"),
    }
    yield worded(
        "Gap between the two: {gap} ({relative} of the cost; up to {tolerance} it counts as closed). A better answer "
        "could lower the cost by no more. It does not mean that the poses are known as precisely.",
        **numbers,
    )


def _spectra(shown: ShownResult) -> Iterator[Block]:
    """The spectrum of the largest part that has one."""
    parts = (shown.evidence_tree.get("proof") or {}).get("parts", ())
    if not parts:
        yield Paragraph(f"{ABSENT}, for the result has no evidence.json beside it with one.", "absent")
        return
    having = [part for part in parts if part["eigenvalues"] is not None]
    if not having:
        yield Paragraph(f"{ABSENT}, for {parts[0]['why_not']}.", "absent")
        return
    part = max(having, key=lambda each: each["rows"])
    values, rounding = np.array(part["eigenvalues"]), part["rounding"]
    yield Chart("spectrum", "Spectrum of Z", _says(part, values, rounding), spectrum_svg(values, rounding))


def _says(part: Mapping[str, Any], values: np.ndarray, rounding: float) -> str:
    zeros, negative = int((np.abs(values) <= rounding).sum()), int((values < -rounding).sum())
    if negative:
        found = f"{negative} below zero beyond rounding: with these multipliers nothing is proven."
    elif zeros == 1:
        found = (
            "one is zero, which belongs to the answer itself, and the others are positive: no other answer is as good."
        )
    else:
        found = f"{zeros} are zero up to rounding: beside the answer itself, directions cost nothing."
    return (
        f"The {part['rows']} eigenvalues of the certificate's matrix: {found} A small one beside the zero would be "
        "another rotation of the frames that fits nearly as well. Their size is in units of the cost and says nothing "
        "of metres or degrees."
    )


def _parts(shown: ShownResult) -> Iterator[Block]:
    """A table of unconnected parts, where there are several."""
    assert shown.result is not None
    parts = shown.result.solution.parts
    if len(parts) < 2:
        return
    rows: list[tuple[Words, ...]] = []
    for i, part in enumerate(parts):
        at = ("certified", "parts", i, "certificate")
        cost, bound = (shown.number(*at, field, spec=".8g") for field in ("cost", "lower_bound"))
        names, is_bound = ", ".join(part.names), np.isfinite(part.certificate.lower_bound)
        rows.append((names, str(part.certificate.status), cost, bound if is_bound else "none"))
    table = Table("Unconnected parts, each solved by itself", ("frames", "status", "cost", "lower bound"), tuple(rows))
    yield Folded(f"{len(parts)} unconnected parts", (table,))


def spectrum_svg(values: Array, rounding: float) -> SvgFigure:
    """The eigenvalues in order; those that are zero up to rounding, and negative ones, look different."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        place = np.arange(1, len(values) + 1)
        size = np.maximum(np.abs(values), 1e-30)
        level = max(rounding, 1e-30)
        kinds = (
            (values > rounding, "o", BLUE, "positive"),
            (np.abs(values) <= rounding, "D", ORANGE, "zero up to rounding"),
            (values < -rounding, "v", VERMILLION, "negative (its size)"),
        )
        low = 0.03 * level
        for which, marker, colour, words in kinds:
            if which.any():
                shown = np.maximum(size[which], 2.0 * low)
                axes.plot(place[which], shown, marker, color=colour, ms=4.5, ls="none", label=f"{words}: {which.sum()}")
        axes.axhspan(low, level, color=GREY, alpha=0.25, lw=0)
        axes.annotate(
            "rounding", (1.0, level), xycoords=("axes fraction", "data"), xytext=(-3, -3), textcoords="offset points",
            ha="right", va="top", color=INK, fontsize=9,
        )  # fmt: skip
        axes.set(yscale="log", xlabel="number, in order", ylabel="eigenvalue")
        axes.set_ylim(low, 5.0 * max(float(size.max()), level))
        # The style takes "$" as it is, so powers of ten are written out.
        axes.yaxis.set_major_formatter(lambda value, _: f"1e{round(float(np.log10(value)))}")
        axes.yaxis.set_minor_formatter(lambda value, _: "")
        axes.legend(loc="center right", fontsize=9)

    return svg_figure(draw, 3.0)
