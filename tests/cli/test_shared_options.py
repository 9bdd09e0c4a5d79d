"""What a subcommand passes over it refuses: every option, on every way that the subcommand can go."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, get_args

import pytest
import typer
from places import CELL, DEMO
from typer.testing import CliRunner

from gtsam_rwhec.calibration.calibrate_options import RobustChoice
from gtsam_rwhec.cli import calibrate_command, convert_command, shared_options
from gtsam_rwhec.cli.app import app
from gtsam_rwhec.cli.shared_options import command_of
from gtsam_rwhec.fitting.fit_options import NoiseSource
from gtsam_rwhec.logs.image_folder import Columns
from gtsam_rwhec.problem import ScaleMode
from gtsam_rwhec.solver import solve_options as solver_options

COMMANDS: Mapping[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
LOG = ("calibrate", CELL / "robot_cell.mcap", "--rig", CELL / "rig.yaml", "-o", "out")
FOLDER = ("calibrate", DEMO)
BAG = ("convert", DEMO, "-o", "log.mcap")

# A value of each option that has no default, or whose values are few; the default is a value like any other.
VALUES = {
    "sigma": "0.01",
    "kappa": "1000",
    "initial": "earlier.json",
    "certified_only": None,
    "as_read": None,
    "repair": None,
    "carrier_noise_deg": "0.1",
    "carrier_noise_mm": "1",
    "arm_accuracy_deg": "0.05",
    "arm_accuracy_mm": "0.5",
    "images": None,
    "no_report_images": None,
    "anyway": None,
    "force": None,
    "workers": "2",
    "poses": "poses.csv",
}

# What is typed, what the way refuses, and what it takes.
ROADS = {
    "log": (LOG, calibrate_command.NOT_FOR_A_LOG, calibrate_command.OF_LOG),
    "folder": (FOLDER, calibrate_command.NOT_WITH_ALL, calibrate_command.OF_FOLDER | calibrate_command.OF_CHOICES),
    "certified": (
        (*FOLDER, "--certified-only"),
        calibrate_command.NOT_CERTIFIED_ONLY,
        calibrate_command.OF_FOLDER | calibrate_command.OF_SOLVE,
    ),
    "bag": (BAG, convert_command.NOT_FOR_A_BAG, {"source", "output", "poses", "rig"}),
    "described": ((*BAG, "--rig", "rig.yaml"), convert_command.NOT_WITH_A_RIG, {"source", "output", "rig"}),
}
# These choose the way, and so are never passed over.
CHOOSING = {"folder": {"rig"}, "certified": {"rig"}}


def names_of(refused: Mapping[str, Collection[str]]) -> set[str]:
    """The parameters that are refused, for whatever reason."""
    return set().union(*refused.values())


def passed_over() -> list[tuple[str, str]]:
    """Each way with each option that it does not take, and that does not choose the way either."""
    return [
        (road, name)
        for road, (_, refused, _) in ROADS.items()
        for name in sorted(names_of(refused) - CHOOSING.get(road, set()))
    ]


@pytest.mark.parametrize(("road", "name"), passed_over())
def test_an_option_that_would_be_passed_over_is_refused(
    road: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments, refused, _ = ROADS[road]
    (parameter,) = [p for p in COMMANDS[arguments[0]].params if p.name == name]
    option = max(parameter.opts, key=len)
    value = VALUES.get(name, parameter.default)
    given = [option] if value is None else [option, value]
    done = CliRunner().invoke(app, [str(argument) for argument in (*arguments, *given)])
    assert done.exit_code == 2
    (why,) = [why for why, names in refused.items() if name in names]
    assert f"{option}: {why}" in " ".join(done.stderr.replace("│", " ").split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("road", ROADS)
def test_every_option_is_either_taken_or_refused(road: str) -> None:
    arguments, refused, taken = ROADS[road]
    parameters = {parameter.name for parameter in COMMANDS[arguments[0]].params} - {"help"}
    assert parameters == names_of(refused) | taken
    assert not names_of(refused) & taken


def test_choices_are_those_of_the_library() -> None:
    """The command writes them again, so that its help need not import the library."""
    assert set(get_args(shared_options.Scale)) == set(get_args(ScaleMode))
    assert set(get_args(calibrate_command.Method)) == set(get_args(solver_options.Method))
    assert set(get_args(calibrate_command.Noise)) == set(get_args(NoiseSource))
    assert set(get_args(calibrate_command.Robust)) == set(get_args(RobustChoice))
    assert set(get_args(convert_command.Columns)) == set(get_args(Columns))


def test_all_refused_options_are_named_at_once() -> None:
    arguments = (*FOLDER, "--images", "--workers", 2, "--method", "sdp")
    done = CliRunner().invoke(app, list(map(str, arguments)))
    said = " ".join(done.stderr.replace("│", " ").split())
    assert "--images, --workers: only for a log." in said
    assert "--method: only with --certified-only." in said


def test_a_report_keeps_the_command_as_it_was_given() -> None:
    given = ["a folder", "--scale", "shared", "--sigma", "0.01", "--as-read", "-o", "out/result.json"]
    context = COMMANDS["calibrate"].make_context("calibrate", list(given))
    command = command_of(context)
    assert command.startswith("gtsam-rwhec calibrate 'a folder' ")
    again = COMMANDS["calibrate"].make_context("calibrate", shlex.split(command)[2:])
    assert again.params == context.params
    assert "--robust" not in command
