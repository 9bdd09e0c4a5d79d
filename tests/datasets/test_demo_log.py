"""The example's CSV files: made by the script beside them, and good enough to calibrate from."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from places import DATA

import gtsam_rwhec as rw


@pytest.fixture(scope="module")
def make_demo() -> ModuleType:
    """The script ``data/make_demo.py``."""
    specification = importlib.util.spec_from_file_location("make_demo", DATA / "make_demo.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_the_script_makes_the_same_files_again(make_demo: ModuleType, tmp_path: Path) -> None:
    make_demo.write(tmp_path)
    names = sorted(path.name for path in (DATA / "demo").iterdir())
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    for name in names:
        stored, made = (np.loadtxt(folder / name, delimiter=",", ndmin=2) for folder in (DATA / "demo", tmp_path))
        np.testing.assert_allclose(made, stored, rtol=0.0, atol=2e-9)


def test_the_calibration_is_certified_and_near_the_truth(make_demo: ModuleType) -> None:
    problem = rw.read_csv(DATA / "demo", sigma=make_demo.SIGMA_M, kappa=1.0 / (2.0 * make_demo.SIGMA_RAD**2))
    solution = rw.solve(problem)
    assert solution.certificate.is_certified
    for answer, truth in ((solution.X, make_demo.true_targets()), (solution.Y, make_demo.true_sensors())):
        assert set(answer) == set(truth)
        for name in truth:
            error = truth[name].between(answer[name])
            assert np.linalg.norm(error.translation()) < 0.01
            assert np.degrees(np.linalg.norm(error.rotation().xyz())) < 0.7
    # Half a chi-square with 6 x 133 - 6 x 7 degrees of freedom: mean 378, standard deviation 19.4.
    assert abs(solution.cost - 378.0) < 4 * 19.4
