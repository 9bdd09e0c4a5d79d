"""The commands that pages show: each names a command that is there, with options that it has."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer
from places import REPOSITORY

from gtsam_rwhec.cli.app import app

PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md")), REPOSITORY / "factors" / "README.md"]
BLOCK = re.compile(r"^```(?:bash|console|sh)\n(.*?)^```", re.MULTILINE | re.DOTALL)

INLINE = re.compile(r"`(gtsam-rwhec [a-z][^`]*)`")
COMMAND = typer.main.get_command(app)


def shown_commands(text: str) -> list[list[str]]:
    """The words of each `gtsam-rwhec` command in a page's blocks and lines, without comments."""
    found = []
    for block in (*BLOCK.findall(text), *(inline.replace("\n", " ") for inline in INLINE.findall(text))):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"&&|\|\|?|;", line.split(" #")[0].removeprefix("$ ")):
                words = shlex.split(part, comments=True)
                if words and words[0].rpartition("/")[2] == "gtsam-rwhec":
                    found.append(words[1:])
    return found


def wrong(words: list[str]) -> str:
    """What is wrong with a command; empty where nothing is."""
    command = COMMAND
    while words and hasattr(command, "commands"):
        if words[0].startswith("-"):
            break
        if words[0] not in command.commands:
            return f"there is no command {words[0]}"
        command, words = command.commands[words[0]], words[1:]
    options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    options |= {"--help"}
    for word in words:
        name = word.partition("=")[0]
        if re.fullmatch(r"--?[a-z][a-z-]*", name) and name not in options:
            return f"{command.name} has no option {name}"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_each_command_of_a_page_is_there(page: Path) -> None:
    commands = shown_commands(page.read_text(encoding="utf-8"))
    assert [(words, why) for words in commands if (why := wrong(words))] == []


def test_commands_are_found_and_wrong_ones_told() -> None:
    assert sum(len(shown_commands(page.read_text(encoding="utf-8"))) for page in PAGES) > 20
    text = "```bash\ngtsam-rwhec calibrate a.mcap --rig r.yaml -o out  # words\ngtsam-rwhec nothing\n```\n"
    assert shown_commands(text) == [["calibrate", "a.mcap", "--rig", "r.yaml", "-o", "out"], ["nothing"]]
    assert wrong(["calibrate", "a.mcap", "--no-such"]) == "calibrate has no option --no-such"
    assert wrong(["nothing"]) == "there is no command nothing"
    assert wrong(["fetch", "utias", "folder"]) == ""
