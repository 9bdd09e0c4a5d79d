"""Manifests: what they say, and every fault with its line."""

from __future__ import annotations

from pathlib import Path

import pytest

import gtsam_rwhec as rw
from gtsam_rwhec import fleet
from gtsam_rwhec.fleet.manifest import joined

GOOD = """\
rig: rigs/arm.yaml
robots:
  a: {logs: "a/*.mcap"}
  b:
    rig: /rigs/b.yaml
    logs: [b/1.mcap, {log: "s3://logs/b/2.mcap", rig: new.yaml}]
  c: c.mcap
sites:
  hall: [c, a]
"""


def test_what_it_says() -> None:
    found = fleet.parse_manifest(GOOD, "s3://fleet/night/manifest.yaml")
    a, b, c = found.robots
    folder = "s3://fleet/night"
    assert [(log.url, log.rig) for log in a.logs] == [(f"{folder}/a/*.mcap", f"{folder}/rigs/arm.yaml")]
    assert a.logs[0].is_pattern
    assert not c.logs[0].is_pattern
    assert [(log.url, log.rig) for log in b.logs] == [
        (f"{folder}/b/1.mcap", "/rigs/b.yaml"),
        ("s3://logs/b/2.mcap", f"{folder}/new.yaml"),
    ]
    assert [robot.site for robot in found.robots] == ["hall", None, "hall"]
    assert {site: [robot.name for robot in robots] for site, robots in found.sites.items()} == {"hall": ["a", "c"]}
    assert c.logs[0].place == "s3://fleet/night/manifest.yaml, line 7: robots.c"


@pytest.mark.parametrize(
    ("base", "url", "expected"),
    [
        ("fleet.yaml", "a.mcap", "a.mcap"),
        ("/m/fleet.yaml", "a/*.mcap", "/m/a/*.mcap"),
        ("/m/n/fleet.yaml", "../a.mcap", "/m/a.mcap"),
        ("s3://bucket/fleet.yaml", "a.mcap", "s3://bucket/a.mcap"),
        ("s3://bucket/n/fleet.yaml", "https://x/a.mcap", "https://x/a.mcap"),
        ("../fleet.yaml", "a.mcap", "../a.mcap"),
    ],
)
def test_relative_paths_start_from_its_folder(base: str, url: str, expected: str) -> None:
    assert joined(base, url) == expected


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("rig: rigs/arm.yaml\n", "", 2, "robots.a: it has no rig file"),
        ("robots:", "robot:", 2, "did you mean robots?"),
        ('{logs: "a/*.mcap"}', "{log: x.mcap}", 3, "did you mean logs?"),
        ('{logs: "a/*.mcap"}', "{logs: []}", 3, "an empty list"),
        ('{logs: "a/*.mcap"}', "{logs: 12}", 3, "12; give a path or a URL"),
        ("  a:", "  a/b:", 3, "not a name"),
        ("[c, a]", "[c, d]", 9, "'d' is no robot of this manifest"),
        ("[c, a]", "[c, a]\n  yard: [a]", 10, "a is at hall already"),
        ("  hall:", "  b:", 9, "a robot has this name"),
        ("  c: c.mcap", "  a: c.mcap", 7, "is there twice"),
    ],
)
def test_every_fault_has_its_line(old: str, new: str, line: int, words: str) -> None:
    assert GOOD.count(old) == 1
    with pytest.raises(rw.errors.ManifestError) as caught:
        fleet.parse_manifest(GOOD.replace(old, new), "fleet.yaml")
    assert any(
        said.startswith(f"fleet.yaml, line {line}: ") and words in said for said in str(caught.value).split("\n")
    )


def test_a_manifest_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(rw.errors.ManifestError, match=r"none\.yaml cannot be read"):
        fleet.read_manifest(str(tmp_path / "none.yaml"))


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("logs/*.mcap", True),
        ("s3://logs/night_?.mcap", True),
        ("https://host/a.mcap?X-Amz-Signature=abc&part[0]=*", False),
        ("https://host/*.mcap?token=abc", True),
    ],
)
def test_a_signed_url_is_no_pattern(url: str, expected: bool) -> None:
    assert fleet.is_pattern(url) is expected
