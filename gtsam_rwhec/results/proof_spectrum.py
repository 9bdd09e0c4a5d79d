"""The gap of the certificate, and the spectrum of the matrix Z that proves it, part by part.

Z = Q' - Lambda is the matrix of the dual certificate (RWHEC paper, Theorem 6; design facts 3 and 4): Q' is the cost of
the rotations x = [vec R, h] with translations and scales eliminated, Lambda the multipliers of their constraints. Z x =
0 at a critical point, and J(y) - J(x) = y'Z y for every y: Z >= 0 proves that no answer costs less. The solver proves
it without eigenvalues, for all variables and with rounding enclosed; the spectrum is what a person can look at.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.file_record import FileRecord, Row
from gtsam_rwhec.solver.answers import given_answer, given_poses
from gtsam_rwhec.solver.certificate import Certificate, Multipliers
from gtsam_rwhec.solver.descent import homogeneous
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Part, parts_of
from gtsam_rwhec.solver.rotations import CONSTRAINTS, kkt_multipliers
from gtsam_rwhec.solver.small_dual import improve, scatter
from gtsam_rwhec.solver.solution import Solution

#: Larger matrices are not decomposed.
MOST_ROWS = 1000
#: The cost at hand is that of the certificate if the two differ by at most this share of it.
SAME_COST = 1e-6


class ProvenPart(FileRecord):
    """One unconnected part of a calibration."""

    names: tuple[str, ...]  #: Its frames
    gap: float | None  #: Cost less lower bound, at least 0; null: there is no bound
    relative_gap: float | None  #: The gap over the cost; null: there is no bound
    rows: int = 0  #: Rows of Z: nine for each free frame, and one
    eigenvalues: Row | None = None  #: Of Z, ascending; null: not computed
    rounding: float | None = None  #: What rounding may change in an eigenvalue, about
    why_not: str = ""  #: Why there are no eigenvalues


class Proof(FileRecord):
    """The proof of a calibration."""

    gap: float | None  #: Of all parts together; null: there is no bound
    relative_gap: float | None  #: The gap over the cost; null: there is no bound
    parts: tuple[ProvenPart, ...]


def proof_of(solution: Solution, problem: Problem) -> Proof:
    """The gaps of a solution, and the spectra of its parts.

    ``problem`` has the measurements of the answer; where its cost is another one, spectra are left out and say so.
    """
    by_names = {frozenset(part.names): part for part in parts_of(problem)}
    parts = []
    for solved in solution.parts:
        gap, relative = _gaps(solved.certificate)
        part = by_names.get(frozenset(solved.names))
        found = {"why_not": OTHER} if part is None else _spectrum(part, solution, solved.certificate)
        parts.append(ProvenPart(names=solved.names, gap=gap, relative_gap=relative).model_copy(update=found))
    gap, relative = _gaps(solution.certificate)
    return Proof(gap=gap, relative_gap=relative, parts=tuple(parts))


OTHER = "the proof is of other measurements than these, or of other weights, as the search for outliers finds them"


def _gaps(certificate: Certificate) -> tuple[float | None, float | None]:
    is_known = np.isfinite(certificate.gap) and np.isfinite(certificate.relative_gap)
    return (certificate.gap, certificate.relative_gap) if is_known else (None, None)


@np.errstate(all="ignore")
def _spectrum(part: Part, solution: Solution, certificate: Certificate) -> dict[str, object]:
    """The eigenvalues of Z at the solution, or why there are none."""
    rows = 9 * len(part.free) + 1
    if rows > MOST_ROWS:
        return {"rows": rows, "why_not": f"the matrix has {rows} rows, more than {MOST_ROWS}"}
    if rows == 1:
        return {"rows": rows, "why_not": "every frame of it is fixed"}
    if certificate.path.multipliers is Multipliers.RELAXATION:
        return {"rows": rows, "why_not": "the multipliers of the relaxation were not kept"}
    form = PartForm.of(part)
    given = given_answer(part, solution.X, solution.Y, solution.scale)
    evaluation = form.evaluated(given, given_poses(part, solution.X, solution.Y)[:, :3, 3])
    if not abs(evaluation.cost - certificate.cost) <= SAME_COST * certificate.cost + certificate.tolerance:
        return {"rows": rows, "why_not": OTHER}
    R = evaluation.point.rotations
    x, Q = homogeneous(R), form.reduced.Q
    multipliers = kkt_multipliers(R, (Q @ x)[:-1].reshape(-1, 9))
    if certificate.path.multipliers is Multipliers.ALL_CONSTRAINTS:
        multipliers, _ = improve(Q, R, multipliers)
    Z = Q - scatter(np.einsum("nk,kpq->npq", multipliers, CONSTRAINTS))
    Z = 0.5 * (Z + Z.T)
    Z[-1, -1] -= float(x @ Z @ x)  # the multiplier of h^2 = 1
    values = np.linalg.eigvalsh(Z)
    if not np.isfinite(values).all():
        return {"rows": rows, "why_not": "its entries overflow"}
    rounding = rows * np.finfo(np.float64).eps * float(np.abs(np.diagonal(Q)).max())
    return {"rows": rows, "eigenvalues": tuple(values.tolist()), "rounding": max(rounding, 0.0)}
