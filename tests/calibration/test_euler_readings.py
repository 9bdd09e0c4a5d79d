"""Euler angles of another order or about other axes are named; of good rotations no convention is tried."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.euler_readings import CONVENTIONS, readings_of_euler_angles, words_of
from gtsam_rwhec.calibration.misreadings import misreadings
from gtsam_rwhec.calibration.other_readings import Mistake
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import Motion, Noise, general

pytestmark = pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
NOISE = Noise(0.002, 0.5 / np.radians(0.2) ** 2)


def good(seed: int) -> rw.Problem:
    motion = Motion(max_angle_rad=np.radians(40.0), extent_m=0.3)
    return general(1, 1, seed=seed, noise=NOISE, number_of_measurements=25, motion=motion).problem


def misread(T: Array, meant: str, read: str) -> Array:
    """Poses whose rotations were written by one convention and read by another one, as SciPy names them."""
    rotations = Rotation.from_matrix(T[:, :3, :3])
    numbers = rotations.as_rotvec() if meant == "rotvec" else rotations.as_euler(meant)
    found = T.copy()
    found[:, :3, :3] = (
        Rotation.from_rotvec(numbers) if read == "rotvec" else Rotation.from_euler(read, numbers)
    ).as_matrix()
    return found


@pytest.mark.parametrize(
    ("side", "meant", "read", "words"),
    [
        ("A", "xyz", "XYZ", "Euler angles Rz(c) Ry(b) Rx(a), and were read as Euler angles Rx(a) Ry(b) Rz(c)"),
        ("A", "XYZ", "ZYX", "Euler angles Rx(a) Ry(b) Rz(c), and were read as Euler angles Rz(a) Ry(b) Rx(c)"),
        ("B", "xyz", "rotvec", "Euler angles Rz(c) Ry(b) Rx(a), and were read as rotation vectors (a, b, c)"),
    ],
)
def test_another_convention_is_named(side: str, meant: str, read: str, words: str) -> None:
    problem = good(1)
    raw = problem.measurements(*problem.pairs[0])
    A, B = (misread(T, meant, read) if of == side else T for of, T in (("A", raw.A), ("B", raw.B)))
    wrong = rw.Problem()
    wrong.add("tag", "cam", A, B)
    found = misreadings(wrong, rw.solve(wrong))
    assert [one.mistake for one in found] == [Mistake.EULER_AXES]
    assert f"the rotations of {side} are {words}" in str(found[0])
    assert found[0].translation_mm[1] < 6.0


def test_no_convention_fits_good_rotations_better() -> None:
    problem = good(2)
    raw = problem.measurements(*problem.pairs[0])
    assert readings_of_euler_angles({problem.pairs[0]: (raw.A, raw.B)}) == []


def test_of_few_rows_nothing_is_told() -> None:
    problem = good(3)
    raw = problem.measurements(*problem.pairs[0])
    wrong = misread(raw.A, "xyz", "XYZ")
    assert readings_of_euler_angles({problem.pairs[0]: (wrong[:6], raw.B[:6])}) == []


def test_each_convention_is_its_product() -> None:
    """The words are those of SciPy's rotations."""
    numbers = np.array([0.3, -0.2, 0.5])
    for convention in CONVENTIONS[1:]:
        R = np.eye(3)
        for part in words_of(convention).removeprefix("Euler angles ").split():
            axis, number = part[1].upper(), "abc".index(part[3])
            R = R @ Rotation.from_euler(axis, numbers[number]).as_matrix()
        np.testing.assert_allclose(R, Rotation.from_euler(convention, numbers).as_matrix(), atol=1e-12)
