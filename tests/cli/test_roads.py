"""What a subcommand passes over it refuses: every option, on every way that the subcommand can go."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import pytest
import typer
from places import CELL, DEMO
from typer.testing import CliRunner

from gtsam_rwhec.cli import calibrate, convert, options
from gtsam_rwhec.cli.app import app
from gtsam_rwhec.cli.roads import names
from gtsam_rwhec.logs.image_folder import Columns
from gtsam_rwhec.problem import ScaleMode
from gtsam_rwhec.refinement.options import NoiseSource, Robust
from gtsam_rwhec.solver import options as solver_options

COMMANDS: Mapping[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
LOG = ("calibrate", CELL / "robot_cell.mcap", "--rig", CELL / "rig.yaml", "-o", "out")
FOLDER = ("calibrate", DEMO)
BAG = ("convert", DEMO, "-o", "log.mcap")

# A value of each option that has no default, or whose values are few; the default is a value like any other.
VALUES = {
    "sigma": "0.01",
    "kappa": "1000",
    "initial": "earlier.json",
    "refine": "given",
    "carrier_noise_deg": "0.1",
    "carrier_noise_mm": "1",
    "images": None,
    "workers": "2",
}

ROADS = {
    "log": (LOG, calibrate.NEEDS, [calibrate.LogOptions]),
    "folder": (FOLDER, calibrate.NEEDS, [calibrate.FolderOptions]),
    "local": (
        (*FOLDER, "--method", "local", "--initial", "x.json"),
        calibrate.NEEDS,
        [calibrate.FolderOptions, calibrate.StartOptions],
    ),
    "refined": (
        (*FOLDER, "--refine", "given"),
        calibrate.NEEDS,
        [calibrate.FolderOptions, calibrate.RefinementOptions],
    ),
    "bag": (BAG, convert.NEEDS, [convert.BagOptions]),
}


def passed_over() -> list[tuple[str, str]]:
    """Each road with each option that it does not take, and that does not choose the road either."""
    choosing = {("folder", "rig"), ("local", "rig"), ("refined", "rig"), ("folder", "refine"), ("local", "refine"),
                ("bag", "poses")}  # fmt: skip
    return [
        (road, name)
        for road, (_, needs, taken) in ROADS.items()
        for name in sorted(frozenset[str]().union(*map(names, needs)) - frozenset[str]().union(*map(names, taken)))
        if (road, name) not in choosing
    ]


@pytest.mark.parametrize(("road", "name"), passed_over())
def test_an_option_that_would_be_passed_over_is_refused(
    road: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments, needs, _ = ROADS[road]
    (parameter,) = [p for p in COMMANDS[arguments[0]].params if p.name == name]
    option = max(parameter.opts, key=len)
    value = VALUES.get(name, parameter.default)
    given = [option] if value is None else [option, value]
    done = CliRunner().invoke(app, [str(argument) for argument in (*arguments, *given)])
    assert done.exit_code == 2
    said = " ".join(done.stderr.replace("│", " ").split())
    record = next(record for record in needs if name in names(record))
    assert f"{option}: {needs[record]}" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("command", "needs"), [("calibrate", calibrate.NEEDS), ("convert", convert.NEEDS)])
def test_every_option_is_one_of_a_road(command: str, needs: Mapping[type[Any], str]) -> None:
    parameters = {parameter.name for parameter in COMMANDS[command].params} - {"help"}
    assert parameters == frozenset[str]().union(*map(names, needs))


def test_choices_are_those_of_the_library() -> None:
    """The command writes them again, so that its help need not import the library."""
    assert set(get_args(options.Scale)) == set(get_args(ScaleMode))
    assert set(get_args(calibrate.Method)) == set(get_args(solver_options.Method))
    assert {*get_args(calibrate.Refine), "auto"} == set(get_args(NoiseSource))
    assert set(get_args(calibrate.Robust)) == set(get_args(Robust))
    assert set(get_args(convert.Columns)) == set(get_args(Columns))


def test_all_refused_options_are_named_at_once() -> None:
    arguments = (*FOLDER, "--images", "--workers", 2, "--robust", "gnc")
    done = CliRunner().invoke(app, list(map(str, arguments)))
    said = " ".join(done.stderr.replace("│", " ").split())
    assert "--images, --workers: only for a log." in said
    assert "--robust: only for a folder of CSV files, and without --refine it says nothing." in said
