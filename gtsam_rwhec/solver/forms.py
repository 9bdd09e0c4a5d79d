"""A part's quadratic forms: full, with and without its translation residuals, and reduced."""

from __future__ import annotations

from dataclasses import dataclass

from gtsam_rwhec.solver.full_form import FullForm, full_forms
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.reduced_form import ReducedForm, reduce


@dataclass(frozen=True)
class Forms:
    """The full form, the form of the rotation residuals alone, and the reduced form."""

    full: FullForm
    rotation: FullForm
    reduced: ReducedForm

    @staticmethod
    def of(part: Part) -> Forms:
        """Build them from the part's moments."""
        full, rotation = full_forms(part)
        return Forms(full, rotation, reduce(full))
