"""Names that mean harm, in folders and logs: no text of a stranger steers the terminal, fills it, or ends a comment."""

from __future__ import annotations

import ast
import json
import os
import shutil
import xml.dom.minidom
from dataclasses import replace
from pathlib import Path

import pytest
import synthetic_logs as made
import yaml
from given_commands import given
from places import DEMO

import gtsam_rwhec as rw
from gtsam_rwhec.rig import RigFrames
from gtsam_rwhec.rig.exported_files import export_all
from gtsam_rwhec.runs.output_folder import LIST_FILE
from gtsam_rwhec.runs.run_log import SEEN_SHEET

#: Clears the screen, changes its title, moves up a line, and looks like rich's markup; C1 codes; text backwards.
STEERING = "\x1b[2J\x1b]0;owned\x07\x1b[1A[bold red]x[/bold red][/]\x9b31m\u202eevil"
LINES = "x\nError: nothing is wrong\r\n"
LONG = "y" * 60_000
#: All of it.
HOSTILE = STEERING + LINES + LONG
#: Files' names have at most 255 bytes, and neither slashes nor null characters.
FILE_NAMES = ((STEERING + LINES).replace("/", "|"), ".. [red] -rf")


def run(*arguments: object, status: int) -> str:
    """Run the command; what it prints can neither steer a terminal nor fill it."""
    done = given(*arguments)
    text = done.stdout + done.stderr
    assert done.exit_code == status, text[:3000]
    unprintable = {sign for sign in text if not sign.isprintable()} - {"\n"}
    assert unprintable == set()
    assert "\nError: nothing is wrong" not in text
    assert len(text) < 20_000
    assert max(map(len, text.splitlines())) < 3_000
    return text


def folder_of(tmp_path: Path, name: str) -> Path:
    """The demo's measurements, with a name in place of a target's number and of a camera's number."""
    folder = tmp_path / "csv"
    folder.mkdir()
    for path in DEMO.iterdir():
        shutil.copy(path, folder / path.name.replace("tag_0", f"tag_{name}").replace("cam_1", f"cam_{name[:20]}"))
    return folder


@pytest.mark.parametrize("name", FILE_NAMES, ids=["steering", "markup"])
def test_names_of_a_folder_of_csv_files(name: str, tmp_path: Path) -> None:
    folder = folder_of(tmp_path, name)
    (folder / f"{name}.txt").touch()
    weights = ("--sigma", 0.005, "--kappa", 6565, "--noise", "given", "--verbose", "-o", tmp_path / "result.json")
    text = run("calibrate", folder, *weights, status=0)
    assert (r"tag_\x1b[2J\x1b]0;owned\x07\x1b[1A[bold red]x" if name == FILE_NAMES[0] else "tag_.. [red] -rf") in text
    assert f"tag_{name}" in rw.read_refined(tmp_path / "result.json").X


def test_values_of_csv_files(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, FILE_NAMES[0])
    next(iter(folder.glob("*_B.csv"))).write_text(f"1,0,0,0,{LONG[:5000]},\x1b[31m,0\n", encoding="utf-8")
    text = run("calibrate", folder, status=2)
    assert "ty is '\\x1b[31m'" in text
    assert "[... 5002 characters ...]" in text


def test_a_folder_of_a_thousand_other_files(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(DEMO, tmp_path / "csv"))
    for number in range(1_000):
        (folder / f"{number}\x1b[31m{'x' * 200}").touch()
    text = run("calibrate", folder, status=0)
    assert "1000 entries not read" in text
    assert "and 980 more" in text


def test_file_names_that_are_no_text(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, "0")
    for path in list(folder.glob("tag_0_*")):
        path.rename(os.fsdecode(os.fsencode(path).replace(b"tag_0", b"tag_\xff")))
    assert r"tag_\udcff" in run("calibrate", folder, "-o", tmp_path / "result.json", status=2)


@pytest.mark.parametrize(
    "arguments",
    [
        [HOSTILE],
        ["calibrate", DEMO, f"--{HOSTILE}"],
        ["calibrate", DEMO, "--scale", HOSTILE],
        ["calibrate", DEMO, "--targets", HOSTILE],
        ["convert", HOSTILE[:200], "-o", "log.mcap"],
        ["detect", "log.mcap", "--rig", HOSTILE[:200], "-o", HOSTILE[:100]],
    ],
    ids=range(6),
)
def test_arguments(arguments: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A shell writes the names of files into a command line, so they may come from strangers too."""
    monkeypatch.chdir(tmp_path)
    run(*arguments, status=2)


def hostile_log(path: Path) -> Path:
    """A good log with messages of strangers in it: topics, schemas, frames, families and ids."""
    messages = made.recording(2.0)
    first = next(m for m in messages if m.topic == "/cam_0/tags")
    for name in (STEERING, LINES, LONG, "../../../tmp/owned", "a" * 200 + "'\"`$(id)", "--", "]]>-->"):
        messages += [
            replace(first, topic=f"/{name}", schema=name[:1000], data=b"{}"),
            made.transform(made.BEGIN_NS, name, f"{name}_child", made.hand(0.0)),
            made.transform(made.BEGIN_NS, "hand", f"{name}_of_hand", made.hand(0.0)),
            made.detections(f"/{name}/tags", first.stamp_ns, name, []),
        ]
        stranger = made.tag(7, made.pose((0, 0, 0), (0, 0, 1)), family=name) | {"id": name}
        messages.append(made.detections("/cam_0/tags", first.stamp_ns + 1, name, [stranger]))
    return made.write(path, sorted(messages, key=lambda message: message.logged_ns))


def test_names_of_a_log(tmp_path: Path) -> None:
    log = hostile_log(tmp_path / "raw.mcap")
    run("init", log, "-o", tmp_path / "first.yaml", status=0)
    text = (tmp_path / "first.yaml").read_text(encoding="utf-8")
    assert all(sign.isprintable() or sign == "\n" for sign in text)
    assert set(yaml.safe_load(text)) <= {"carriers", "sensors", "targets", "sizes", "noise", "cleaning"}

    rig = tmp_path / "rig.yaml"
    rig.write_text(made.rig_text(), encoding="utf-8")
    out = tmp_path / "out"
    run("calibrate", log, "--rig", rig, "-o", out, status=0)
    assert {path.name for path in out.iterdir()} == {*rw.runs.OUTPUTS, LIST_FILE} - {SEEN_SHEET, "camera_info"}
    rig.write_text(made.rig_text(cam_0="detections: /nowhere"), encoding="utf-8")
    assert "characters ...]" in run("calibrate", log, "--rig", rig, "-o", out, "--force", status=2)
    rig.write_text(made.rig_text(poses="{tf: [base, arm]}"), encoding="utf-8")
    run("calibrate", log, "--rig", rig, "-o", out, "--force", status=2)


@pytest.mark.parametrize("part", ["cam_0:", "sensors: hand", "family: tag36h11", "/cam_0/tags"])
def test_names_in_a_rig_file(part: str, tmp_path: Path) -> None:
    log = made.write(tmp_path / "raw.mcap", made.recording(1.0))
    key, colon, _ = part.partition(": ")
    quoted = json.dumps(HOSTILE)  # YAML reads JSON's text, escapes too
    new = f"{quoted}:" if part.endswith(":") else f"{key}{colon}{quoted}" if colon else quoted
    (tmp_path / "rig.yaml").write_text(made.RIG.replace(part, new, 1), encoding="utf-8")
    text = run("calibrate", log, "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "out", status=2)
    assert "line " in text


#: What a crafted log could say of itself: it goes into the comments of the exported files.
WARNING = "x\nimport os\nos.system('id')\n--->\n<evil/>\n<!---\n---\nkey: value"


def test_warnings_cannot_end_a_comment(tmp_path: Path) -> None:
    frames = RigFrames("hand", "base", {"cam": made.Y["cam_0"]}, {"tag": made.X["tag_0"]}, warnings=(WARNING, LONG))
    export_all(frames, tmp_path)
    launch = ast.parse((tmp_path / "static_tf.launch.py").read_text(encoding="utf-8"))
    plain = tmp_path / "plain"
    plain.mkdir()
    export_all(replace(frames, warnings=()), plain)
    assert ast.dump(launch) == ast.dump(ast.parse((plain / "static_tf.launch.py").read_text(encoding="utf-8")))
    for name in ("tf.yaml", "camchain.yaml"):
        texts = [yaml.safe_load((folder / name).read_text(encoding="utf-8")) for folder in (tmp_path, plain)]
        assert texts[0] == texts[1]
    urdf = xml.dom.minidom.parse(str(tmp_path / "rig.urdf.xacro"))
    assert urdf.getElementsByTagName("evil") == []
    assert len(urdf.getElementsByTagName("link")) == 1
