"""The sections of a report, in the order of the page: one module each."""

from __future__ import annotations

from gtsam_rwhec.report.page.blocks import Section
from gtsam_rwhec.report.page.sections.contribution import contribution_section
from gtsam_rwhec.report.page.sections.determines import determines_section
from gtsam_rwhec.report.page.sections.inputs import inputs_section
from gtsam_rwhec.report.page.sections.proof import proof_section
from gtsam_rwhec.report.page.sections.residuals import residuals_section
from gtsam_rwhec.report.page.sections.scene import scene_section
from gtsam_rwhec.report.page.sections.seen import seen_section
from gtsam_rwhec.report.page.sections.uncertainty import uncertainty_section
from gtsam_rwhec.report.page.sections.verdict import verdict_section
from gtsam_rwhec.report.page.shown_result import ShownResult

#: The functions that make them.
SECTIONS = (
    verdict_section,
    scene_section,
    seen_section,
    determines_section,
    proof_section,
    residuals_section,
    uncertainty_section,
    contribution_section,
    inputs_section,
)


def sections_of(shown: ShownResult) -> tuple[Section, ...]:
    """All sections of a result."""
    return tuple(section(shown) for section in SECTIONS)
