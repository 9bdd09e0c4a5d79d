"""What is said after a take: a pose at which boards appear inside the image, and whether it is enough."""

from __future__ import annotations

import numpy as np
from synthetic_logs import rig

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.capture import Accuracy, StoppingRule
from gtsam_rwhec.capture.live_answer import next_pose, stop_decision

CAMERA = Camera.of(640, 480, "plumb_bob", [[500, 0, 320], [0, 500, 240], [0, 0, 1]], [], "")


def test_before_anything_is_known_boards_are_brought_to_outlines_inside_the_image() -> None:
    described = rig()
    proposal, outlook = next_pose(None, described, dict.fromkeys(described.sensors, CAMERA), Accuracy(0.0005, 0.8))
    assert proposal is not None
    assert proposal.words.startswith("Bring the board where the outline is")
    for name, outlines in proposal.outlines.items():
        assert name in described.sensors
        for outline in outlines:
            assert (np.array(outline) > 0.0).all()
            assert (np.array(outline) < (640.0, 480.0)).all()
    decision = stop_decision(StoppingRule(Accuracy(0.0005, 0.8)), None, 1, outlook)
    assert decision is not None
    assert not decision.is_enough
    assert decision.words == outlook
    assert "The cell is known roughly" in outlook


def test_without_a_camera_nothing_is_proposed() -> None:
    assert next_pose(None, rig(), {}, None) == (None, "")
    assert stop_decision(None, None, 1, "") is None


def test_the_rule_and_the_planner_speak_of_one_calibration() -> None:
    simulation = rw.simulate.general(1, 1, seed=3, noise=rw.simulate.Noise(0.001, 1e5), number_of_measurements=25)
    calibration = rw.calibrate(simulation.problem)
    proposal, outlook = next_pose(calibration, rig(), {}, Accuracy(1.0, 0.8))
    assert proposal is not None
    assert proposal.words.startswith("Move ")
    decision = stop_decision(StoppingRule(Accuracy(1.0, 0.8)), calibration, 25, outlook)
    assert decision is not None
    assert decision.is_enough
    assert decision.words.startswith("Stop: ")


def test_the_pose_is_of_the_carrier_that_moves() -> None:
    simulation = rw.simulate.general(1, 1, seed=3, noise=rw.simulate.Noise(0.001, 1e5), number_of_measurements=25)
    calibration = rw.calibrate(simulation.problem)
    in_hand, beside = rig(), rig(poses="{tf: [hand, base]}")
    assert (in_hand.carriers.sensors, in_hand.carriers.targets) == ("hand", "base")
    frames = [next_pose(calibration, described, {}, None)[0] for described in (in_hand, beside)]
    assert [one.frame for one in frames if one is not None] == ["base", "hand"]
