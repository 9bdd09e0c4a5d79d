"""The spectrum of Z: one zero at a proven answer, more where directions are free, and none of other measurements."""

from __future__ import annotations

import numpy as np
import pytest
from refinement_problems import rig

import gtsam_rwhec as rw
from gtsam_rwhec.results.proof_spectrum import proof_of


def test_a_proven_answer_has_one_zero_and_no_negative_eigenvalue() -> None:
    problem = rig().problem
    solution = rw.solve(problem)
    proof = proof_of(solution, problem)
    (part,) = proof.parts
    assert part.rows == 9 * 4 + 1
    assert part.eigenvalues is not None
    assert part.rounding is not None
    assert len(part.eigenvalues) == part.rows
    assert abs(part.eigenvalues[0]) <= part.rounding
    assert part.eigenvalues[1] > 1e6 * part.rounding
    assert proof.gap == solution.certificate.gap


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_turns_about_one_axis_leave_more_zeros() -> None:
    angles = np.linspace(-1.0, 1.0, 12)
    A = np.tile(np.eye(4), (len(angles), 1, 1))
    A[:, :3, :3] = [[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in angles]
    A[:, 2, 3] = np.random.default_rng(0).uniform(-1.0, 1.0, len(angles))
    planar = rw.Problem()
    planar.add("board", "cam", A, A, 0.001, 1e4)
    (part,) = proof_of(rw.solve(planar), planar).parts
    assert part.eigenvalues is not None
    assert part.rounding is not None
    assert sum(abs(value) <= 100.0 * part.rounding for value in part.eigenvalues) > 1


def test_of_other_measurements_there_is_no_spectrum() -> None:
    solution = rw.solve(rig().problem)
    (part,) = proof_of(solution, rig(seed=1).problem).parts
    assert part.eigenvalues is None
    assert part.why_not.startswith("the proof is of other measurements than these, or of other weights")
    assert part.gap == solution.certificate.gap
