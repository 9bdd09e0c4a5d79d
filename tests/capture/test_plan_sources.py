"""Plans from a calibration, from poses, from a rough rig; what cannot be reached is said, with its reason."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from places import REPOSITORY
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.capture import Arm, Reason
from gtsam_rwhec.capture.plan_candidates import seen_at
from gtsam_rwhec.capture.plan_sources import cell_of
from gtsam_rwhec.errors import FileFormatError, FrameError, OptionError, RwhecError

sys.path.insert(0, str(REPOSITORY / "benchmarks"))
from planned_cells import TrueCell, cell
from planned_poses import GANTRY


def measured(true: TrueCell, count: int) -> rw.Problem:
    problem = rw.Problem(sensor_carrier="hand", target_carrier="base")
    for i, A in enumerate(true.random_poses(count, 60.0)):
        true.take(problem, A, i)
    return problem


def test_a_calibration_predicts_with_its_own_covariance_and_noise() -> None:
    true = cell("hand", 2)
    problem = measured(true, 9)
    with warnings.catch_warnings(action="ignore"):
        calibration = rw.calibrate(problem, rw.CalibrateOptions(observations="poses"))
    plan = rw.plan(calibration, replace(true.options, present=None, candidates=60, wanted=rw.Accuracy(1e-6, 0.8)))
    now = calibration.uncertainty_at([0.0, 0.0, 0.8], "cam_0").radius_mm
    assert plan.outlook.now_mm == pytest.approx(now, rel=1e-3)
    assert plan.poses[0].deviation_mm < now
    assert (plan.poses[0].parent, plan.poses[0].child) == ("base", "hand")
    assert plan.outlook.reason in (Reason.TOO_MANY, Reason.CONSTANT)
    assert not plan.is_rough


def test_a_floor_of_constant_errors_is_the_reason_why_an_accuracy_is_never_reached() -> None:
    from gtsam_rwhec.results.changed_frames import constant_covariance

    true = cell("hand", 2)
    problem = measured(true, 9)
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="given", carrier_noise=true.noise))
    constant = ((1e-3,) * 3 + (1e-3,) * 3, (1e-3,) * 3 + (1e-3,) * 3)
    floor = constant_covariance(refined, constant)
    assert np.linalg.matrix_rank(floor) == 12
    with warnings.catch_warnings(action="ignore"):
        calibration = rw.calibrate(problem, rw.CalibrateOptions(observations="poses"))
    assert calibration.refined is not None
    model = calibration.noise.model
    assert model is not None
    finite = calibration.refined.joint.finite + constant_covariance(calibration.refined, constant)
    worse = replace(
        calibration,
        refined=replace(calibration.refined, joint=replace(calibration.refined.joint, finite=finite)),
        noise=replace(calibration.noise, model=replace(model, constant_deviations=constant)),
    )
    plan = rw.plan(worse, replace(true.options, present=None, candidates=60, wanted=rw.Accuracy(8e-4, 0.8)))
    assert plan.outlook.reason is Reason.CONSTANT
    assert plan.outlook.needed is None
    assert plan.outlook.least_mm > 0.8
    assert "constant errors" in str(plan)


def test_poses_without_corners_are_planned_where_the_sensor_saw_its_targets() -> None:
    simulation = rw.simulate.general(
        1, 1, seed=3, number_of_measurements=12, noise=rw.simulate.Noise(sigma_m=1e-3, kappa=1e5)
    )
    plan = rw.plan(simulation.problem, rw.PlanOptions(candidates=50, poses=4, tilt_deg=90.0, turn_deg=180.0))
    assert len(plan.poses) == 4
    assert plan.poses[-1].deviation_mm < plan.outlook.now_mm


def test_nothing_but_a_camera_and_a_board() -> None:
    true = cell("hand", 0)
    camera, board = true.cameras["cam_0"], true.boards["board_0"]
    plan = rw.plan(cameras={"cam": camera}, boards={"board": board}, options=rw.PlanOptions(candidates=80, poses=4))
    assert plan.is_rough
    assert "pictures" in str(plan)
    B = np.array([one.T_sensor_target[rw.Pair("board", "cam")] for one in plan.poses])
    turns = np.degrees([np.linalg.norm(se3.so3_logmap((B[0].T @ one)[None, :3, :3])) for one in B[1:3]])
    assert (turns >= 30.0).all()
    with pytest.raises(OptionError, match="nothing to plan with"):
        rw.plan(cameras={"cam": camera})
    with pytest.raises(FrameError, match="none that sees"):
        rw.plan(
            cameras={"cam": camera},
            boards={"board": board},
            options=rw.PlanOptions(wanted=rw.Accuracy(sensors=("other",))),
        )
    with pytest.raises(FrameError, match="guess"):
        rw.plan(cameras={"cam": camera}, boards={"board": board}, options=rw.PlanOptions(guesses={"other": np.eye(4)}))
    with pytest.raises(OptionError, match="give a Problem"):
        rw.plan("result.json")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options",
    [
        {"poses": 0}, {"candidates": 10**6}, {"wanted": 0.5}, {"tilt_deg": 100.0}, {"turn_deg": 190.0},
        {"border": 0.6}, {"near_m": 1.0, "far_m": 0.5}, {"box_m": ((0, 0, 0), (1, 1, -1))},
        {"moves": "both"},
    ],
)  # fmt: skip
def test_options_that_mean_nothing_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        rw.PlanOptions(**options)  # type: ignore[arg-type]


def test_what_is_never_reached_is_said_at_once() -> None:
    true = cell("hand", 4)
    kit = {"cameras": true.cameras, "boards": true.boards}
    far = tuple((se3.inverse(true.present)[:3, 3] + 3.0).tolist())
    for given, reason in (
        ({"box_m": (far, tuple(x + 0.1 for x in far))}, Reason.NOT_WITHIN),
        ({"wanted": rw.Accuracy(1e-7, 0.8)}, Reason.TOO_MANY),
    ):
        plan = rw.plan(None, replace(true.options, candidates=50, **given), **kit)
        assert plan.outlook.reason is reason
        assert not plan.outlook.can_be_reached
        assert str(plan.outlook)
    blind = replace(true.options, candidates=50, spacing_px=2000.0)
    plan = rw.plan(measured(true, 4), replace(blind, present=None), **kit)
    assert plan.outlook.reason is Reason.NOT_SEEN
    assert plan.poses == ()


def test_an_arm_that_turns_about_one_axis_leaves_a_direction_free(tmp_path: Path) -> None:
    file = tmp_path / "gantry.urdf"
    file.write_text(GANTRY)
    arm = Arm.read(file, "l0", "l4")
    assert arm.names == ("j0", "j1", "j2", "j3")
    true = cell("hand", 6)
    options = replace(true.options, arm=arm, present=np.eye(4), box_m=None, candidates=60)
    plan = rw.plan(None, options, cameras=true.cameras, boards=true.boards)
    assert plan.outlook.reason is Reason.FREE
    assert "second axis" in str(plan)
    for pose in plan.poses[1:]:
        T, _ = arm.hand(pose.joints[None])
        assert np.abs(T[0] - pose.T_parent_child).max() < 1e-3


def test_an_arm_by_its_urdf(tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    axes = ["0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0"]
    joints = "".join(
        f"<link name='l{i + 1}'/><joint name='j{i}' type='revolute'><origin xyz='0.{i} 0 0.1' rpy='0 0 0.{i}'/>"
        f"<parent link='l{i}'/><child link='l{i + 1}'/><axis xyz='{axis}'/>"
        "<limit lower='-2' upper='2' effort='1' velocity='1'/></joint>"
        for i, axis in enumerate(axes)
    )
    file.write_text(f"<robot name='arm'><link name='l0'/>{joints}</robot>")
    arm = Arm.read(file, "l0", "l6", [0.1, 0.4, -0.6, 0.2, 0.7, 0.3])
    rng = np.random.default_rng(0)
    q = arm.present + rng.uniform(-0.5, 0.5, (20, 6))
    T, J = arm.hand(q)
    step = 1e-6
    for k in range(6):
        moved, _ = arm.hand(q + step * np.eye(6)[k])
        assert np.abs(se3.logmap(se3.inverse(T) @ moved) / step - J[:, :, k]).max() < 1e-5
    can, found = arm.reached(T)
    assert can.mean() > 0.9
    assert np.abs(se3.logmap(se3.inverse(arm.hand(found[can])[0]) @ T[can])).max() < 1e-4
    assert (np.abs(found) <= 2.0).all()
    far = T.copy()
    far[:, :3, 3] += 10.0
    assert not arm.reached(far)[0].any()
    for wrong in (("l0", "elsewhere"), ("l6", "l0")):
        with pytest.raises(FileFormatError, match="no chain"):
            Arm.read(file, *wrong)
    with pytest.raises(FileFormatError, match="joint values"):
        Arm.read(file, "l0", "l6", [0.0])
    for content in ("", "rubbish", "<robot/>", "<robot name='a'><joint/></robot>"):
        file.write_text(content)
        with pytest.raises(RwhecError):
            Arm.read(file, "l0", "l6")
    with pytest.raises(FileFormatError, match="no such file"):
        Arm.read(tmp_path / "none.urdf", "l0", "l6")


def test_margins_count_what_the_frames_leave_open() -> None:
    true = cell("hand", 7)
    guesses = {**true.guesses, **true.X}
    known = cell_of(None, replace(true.options, guesses=guesses), None, true.cameras, true.boards)
    A = true.present[None]
    pair = known.pairs[0]
    narrow = seen_at(known, true.options, A, 1e-6 * known.covariance)[pair][0]
    wide = seen_at(known, true.options, A, known.covariance)[pair][0]
    assert narrow == pytest.approx(1e3 * wide, rel=0.1)
    behind = A @ se3.pose(np.eye(3), [0.0, 0.0, 50.0])
    assert seen_at(known, true.options, behind, known.covariance)[pair][0] == -1.0
