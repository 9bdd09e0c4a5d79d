"""Result files: the same solution comes back, and damaged files are refused with the place of the damage."""

from __future__ import annotations

import dataclasses
import json
import math
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from places import DEMO, GOLDEN
from pydantic import BaseModel
from strategies import changed_trees, damaged

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError, ResultVersionError
from gtsam_rwhec.results.result_file import encoded, parse_result, read_solution, write_solution
from gtsam_rwhec.results.schema import FORMAT_VERSION, ResultFile
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver.certificate import Cause

NOISE = Noise(sigma_m=0.005, kappa=6000.0)


@pytest.fixture(scope="module")
def demo_solution() -> rw.Solution:
    """The demo's calibration."""
    return rw.solve(rw.read_csv(DEMO, sigma=0.005, kappa=6565.0))


@pytest.fixture
def written(demo_solution: rw.Solution, tmp_path: Path) -> Path:
    """The demo's calibration in a file."""
    write_solution(demo_solution, tmp_path / "result.json")
    return tmp_path / "result.json"


def assert_same(first: rw.Solution, second: rw.Solution) -> None:
    """Every number is the same double, every name and word the same, in the same order."""
    for one, other in ((first.X, second.X), (first.Y, second.Y)):
        assert list(one) == list(other)
        for name in one:
            np.testing.assert_array_equal(one[name].matrix(), other[name].matrix())
    for field in dataclasses.fields(first):
        if field.name not in ("X", "Y"):
            assert getattr(first, field.name) == getattr(second, field.name), field.name
    assert list(first.residuals) == list(second.residuals)


def test_the_same_solution_comes_back(demo_solution: rw.Solution, written: Path) -> None:
    back = rw.read_solution(written)
    assert_same(demo_solution, back)
    assert isinstance(back.certificate.status, rw.Status)
    assert back.certificate.is_certified


def test_reading_and_writing_again_gives_the_same_bytes(written: Path, tmp_path: Path) -> None:
    write_solution(read_solution(written), tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == written.read_bytes()


def test_the_real_dataset(utias_folder: Path, tmp_path: Path) -> None:
    solution = rw.solve(rw.read_csv(utias_folder, scale="shared", sigma=1.0, kappa=1.0))
    write_solution(solution, tmp_path / "utias.json")
    assert_same(solution, read_solution(tmp_path / "utias.json"))


@pytest.mark.parametrize(
    "arguments",
    [
        {"scale": "per_target", "known_sizes": ["target0"]},
        {"scale": "shared"},
        {"graph": [(0, 0), (1, 1), (2, 1)]},
        {"odometry": 20, "odometry_noise": NOISE},
    ],
)
def test_every_kind_of_problem(arguments: dict[str, Any], tmp_path: Path) -> None:
    solution = rw.solve(general(3, 2, seed=5, noise=NOISE, **arguments).problem)
    write_solution(solution, tmp_path / "result.json")
    assert_same(solution, read_solution(tmp_path / "result.json"))


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.NotUniqueWarning")
def test_a_solution_with_free_directions(tmp_path: Path) -> None:
    solution = rw.solve(general(2, 2, seed=5, motion="planar", noise=NOISE).problem)
    write_solution(solution, tmp_path / "result.json")
    back = read_solution(tmp_path / "result.json")
    assert_same(solution, back)
    assert back.certificate.status is rw.Status.CERTIFIED_NOT_UNIQUE
    assert back.identifiability.free_directions
    raw = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    directions = raw["certified"]["identifiability"]["free_directions"]
    assert [row["sentence"] for row in directions] == [str(d) for d in back.identifiability.free_directions]
    assert all(row["kind"] and row["reason"] and set(row["frames"]) <= {*back.X, *back.Y} for row in directions)
    assert raw["certified"]["certificate"]["cause"] == back.certificate.cause


def test_infinities_are_null_and_come_back(demo_solution: rw.Solution, tmp_path: Path) -> None:
    certificate = dataclasses.replace(
        demo_solution.certificate,
        status=rw.Status.FAILED,
        cause=Cause.NO_BOUND,
        lower_bound=-math.inf,
        float_bound=-math.inf,
        min_eigenvalue=-math.inf,
    )
    identifiability = dataclasses.replace(demo_solution.identifiability, weakest=math.inf)
    parts = tuple(dataclasses.replace(part, certificate=certificate) for part in demo_solution.parts)
    solution = dataclasses.replace(demo_solution, certificate=certificate, identifiability=identifiability, parts=parts)
    write_solution(solution, tmp_path / "result.json")
    raw = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert raw["certified"]["certificate"]["lower_bound"] is None
    assert raw["certified"]["identifiability"]["weakest"] is None
    assert_same(solution, read_solution(tmp_path / "result.json"))


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_what_null_would_not_bring_back_is_not_written(demo_solution: rw.Solution, written: Path, wrong: float) -> None:
    before = written.read_bytes()
    certificate = dataclasses.replace(demo_solution.certificate, lower_bound=wrong)
    with pytest.raises(FileFormatError, match=r"was not written.*\.certificate\.lower_bound: must be finite, or -inf"):
        write_solution(dataclasses.replace(demo_solution, certificate=certificate), written)
    assert written.read_bytes() == before


def test_awkward_numbers_come_back(demo_solution: rw.Solution, tmp_path: Path) -> None:
    numbers = np.array([5e-324, -0.0, 0.1 + 0.2])
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(1e-300, np.nextafter(1.0, 2.0), -3.0), numbers)
    known = dataclasses.replace(demo_solution.identifiability, weakest=1.7976931348623157e308)
    solution = dataclasses.replace(demo_solution, X=demo_solution.X | {"tag_0": pose}, identifiability=known)
    write_solution(solution, tmp_path / "result.json")
    back = read_solution(tmp_path / "result.json")
    assert back.X["tag_0"].matrix().tobytes() == pose.matrix().tobytes()
    assert back.identifiability.weakest == known.weakest


def test_the_file_explains_itself(demo_solution: rw.Solution, written: Path) -> None:
    raw = json.loads(written.read_text(encoding="utf-8"))
    assert raw["format"] == "gtsam-rwhec result"
    assert raw["format_version"] == FORMAT_VERSION
    assert (raw["verdict"], raw["verdict_grounds"]) == ("use", [])
    assert raw["verdict_reason"] == "the measurements determine every pose, and no other poses fit them better"
    assert not any(pose["contradicted"] for pose in (*raw["sensors"], *raw["targets"]))
    assert not {"sensors", "targets", "scale", "cost"} & raw["certified"].keys()  # each fact is there once
    assert raw["written_by"] == f"gtsam-rwhec {rw.__version__}"
    assert "p_parent = T_parent_child p_child" in raw["conventions"]["pose"]
    pose = raw["sensors"][0]
    assert (pose["parent"], pose["child"]) == ("sensorcarrier", "cam_0")
    rotation = gtsam.Rot3.Quaternion(*pose["quaternion_wxyz"])
    assert demo_solution.Y["cam_0"].rotation().equals(rotation, 1e-12)
    np.testing.assert_array_equal(demo_solution.Y["cam_0"].translation(), pose["translation_m"])


def test_every_field_of_the_files_own_classes_is_described() -> None:
    seen: set[type] = set()

    def look(kind: Any) -> None:
        for inner in typing.get_args(kind):
            look(inner)
        if isinstance(kind, type) and issubclass(kind, BaseModel) and kind not in seen:
            seen.add(kind)
            for name, field in kind.model_fields.items():
                assert field.description, f"{kind.__name__}.{name}"
                look(field.annotation)

    look(ResultFile)
    assert {cls.__name__ for cls in seen} > {"ResultFile", "LogFields", "SizeFields"}


def spoil(written: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Change the file's content."""
    raw = json.loads(written.read_text(encoding="utf-8"))
    change(raw)
    written.write_text(json.dumps(raw), encoding="utf-8")
    return written


@pytest.mark.parametrize(
    ("version", "remedy"), [(FORMAT_VERSION + 1, "install the gtsam-rwhec that wrote it"), (0, "Calibrate again")]
)
def test_another_version_says_what_to_do(written: Path, version: int, remedy: str) -> None:
    spoil(written, lambda raw: raw.update(format_version=version, written_by="gtsam-rwhec 9.9", new_field=1))
    with pytest.raises(ResultVersionError) as caught:
        read_solution(written)
    for words in (f"has version {version}", "written by gtsam-rwhec 9.9", f"reads version {FORMAT_VERSION}", remedy):
        assert words in str(caught.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda raw: raw["sensors"][1]["translation_m"].__setitem__(2, "x"),
            r"\$\.sensors\[1\]\.translation_m\[2\]:.*'x'",
        ),
        (lambda raw: raw["sensors"][1]["translation_m"].pop(), r"\$\.sensors\[1\]\.translation_m"),
        (lambda raw: raw["targets"][0].pop("child"), r"\$\.targets\[0\]\.child: Field required"),
        (lambda raw: raw["certified"].pop("certificate"), r"\$\.certified\.certificate: Field required"),
        (lambda raw: raw.update(extra=1), r"\$\.extra: Extra inputs are not permitted"),
        (lambda raw: raw["certified"]["certificate"].update(cost=None), r"\$\.certified\.certificate\.cost"),
        (lambda raw: raw["certified"]["certificate"].update(cost="8.28"), r"certificate\.cost: .*'8.28'"),
        (lambda raw: raw["certified"]["certificate"].update(status="surely"), r"certificate\.status:.*'surely'"),
        (lambda raw: raw.update(scale=-1.0), r"\$\.scale\.constrained.*greater than 0"),
        (lambda raw: raw.update(scale_mode="per_target"), r"scale_mode 'per_target' does not go with .* 1\.0"),
        (lambda raw: raw["targets"][0]["rotation_matrix"][0].__setitem__(0, 2.0), r"tag_0 is not a rotation"),
        (
            lambda raw: raw["targets"][0].update(rotation_matrix=[[1e200] * 3] * 3, quaternion_wxyz=[1e200] * 4),
            r"quaternion_wxyz of tag_0 is not a rotation",
        ),
        (
            lambda raw: raw["targets"][0].update(quaternion_wxyz=[1.0, 0.0, 0.0, 0.0]),
            r"\$\.targets\[0\]: rotation_matrix and quaternion_wxyz of tag_0 are different rotations",
        ),
        (lambda raw: raw["targets"][0].update(child="cam_0"), r"two poses have the same name: cam_0"),
        (lambda raw: raw["targets"][0].update(parent="moon"), r"in several frames: moon, targetcarrier"),
        (lambda raw: raw["certified"]["residuals"].pop(), r"residuals and identifiability\.pairs"),
        *[
            (lambda raw, name=name: raw.pop(name), rf"\$\.{name}: Field required")
            for name in ("sensors", "targets", "scale", "scale_mode")
        ],
        (lambda raw: raw.update(sensors="junk"), r"\$\.sensors: .*'junk'"),
        (lambda raw: raw.update(scale=True), r"\$\.scale\..*True"),
        (lambda raw: raw["certified"].update(sensors=raw["sensors"]), r"\$\.certified\.sensors: unknown field"),
        (lambda raw: raw.update(refined=3), r"\$\.refined: .*\(found 3\)"),
        (lambda raw: raw.update(refined=[]), r"\$\.refined: .*\(found \[\]\)"),
        (lambda raw: raw.update(refined="xx"), r"\$\.refined: .*\(found 'xx'\)"),
    ],
)
def test_a_damaged_field_is_named(written: Path, change: Callable[[dict[str, Any]], object], said: str) -> None:
    with pytest.raises(FileFormatError, match=said) as caught:
        read_solution(spoil(written, change))
    assert str(written) in str(caught.value)


def test_many_faults_are_counted(written: Path) -> None:
    with pytest.raises(FileFormatError, match=r"; and \d+ more\.$"):
        read_solution(spoil(written, lambda raw: [pose.pop("child") for pose in raw["targets"]]))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not a result of gtsam-rwhec: it is empty"),
        (b" \n", "not a result of gtsam-rwhec: it is empty"),
        (b'{"format": "gtsam-rwhec result",', r"not a result of gtsam-rwhec: \$: Invalid JSON.*line 1 column"),
        (b"[1, 2]", "not a result of gtsam-rwhec"),
        (b"{}", r"\$\.format: Field required"),
        (b'{"format": "other", "format_version": 1}', "another kind of file"),
        (b"\xff\xfe\x00", "not a result of gtsam-rwhec"),
    ],
)
def test_what_is_no_result_file(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "result.json").write_bytes(content)
    with pytest.raises(FileFormatError, match=said):
        read_solution(tmp_path / "result.json")


def test_a_path_that_cannot_be_used(demo_solution: rw.Solution, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="cannot be read: No such file"):
        read_solution(tmp_path / "nowhere.json")
    with pytest.raises(FileFormatError, match="cannot be written: No such file"):
        write_solution(demo_solution, tmp_path / "nowhere" / "result.json")


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_content_gives_a_result_or_an_error_of_ours(written: Path, data: st.DataObject) -> None:
    own = written.read_bytes()
    other = (GOLDEN / f"result_{data.draw(st.sampled_from(['log', 'corners', 'scales']))}.json").read_bytes()
    tree = json.loads(data.draw(st.sampled_from([own, own, other])))
    content = data.draw(damaged([own, other]) | changed_trees(tree).map(lambda t: json.dumps(t).encode()))
    try:
        result = parse_result(content, "any.json")
    except FileFormatError as error:
        assert str(error).startswith("any.json")  # noqa: PT017
        assert len(str(error)) < 5000  # noqa: PT017
    else:
        str(result.solution.certificate)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "\ud800"])
def test_what_json_does_not_have_is_not_written(value: object) -> None:
    """Most readers of JSON refuse NaN."""
    with pytest.raises(ValueError, match=r"line|surrogates"):
        encoded({"scale": value})
