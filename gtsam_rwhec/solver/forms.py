"""A part's quadratic forms: full, with and without its translation residuals, and reduced."""

from __future__ import annotations

from dataclasses import dataclass

from gtsam_rwhec.solver.full_form import FullForm, add_priors, assemble, edge_slots, forms_of_edges
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
        slots = edge_slots(part)
        translation, rotation = forms_of_edges(part)
        full = assemble(part, slots, translation + rotation)
        rotation_form = assemble(part, slots, rotation)
        add_priors(full, part)
        add_priors(rotation_form, part)
        return Forms(full, rotation_form, reduce(full))
