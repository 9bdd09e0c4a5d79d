"""YAML with lines: values of scalars, lines of values, and refusals."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.yaml_lines import (
    MOST_BYTES,
    MOST_VALUES,
    OPENCV_MATRIX,
    dotted,
    parse_storage,
    parse_yaml,
    read_yaml,
    shown,
)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1), ("-12", -12), ("010", 10), ("1e-3", 1e-3), ("1.", 1.0), (".5", 0.5), ("+2.5E+2", 250.0),
        ("9" * 5000, math.inf), ("1234567890123456789", 1234567890123456789.0), ("-.inf", -math.inf),
        ("true", True), ("False", False), ("yes", "yes"), ("no", "no"), ("12:30", "12:30"), ("1_000", "1_000"),
        ("0x10", "0x10"), ("2020-01-01", "2020-01-01"), ("null", None), ("~", None), ("", None), ("'1'", "1"),
        ('"true"', "true"), ("120 mm", "120 mm"), ("[1, a]", (1, "a")), ("{}", {}), ("- 1\n- - 2\n", None),
    ],
)  # fmt: skip
def test_scalars(text: str, value: object) -> None:
    if text.startswith("- "):
        text, value = "\n  " + text.replace("\n", "\n  "), (1, (2,))
    read = parse_yaml(f"a: {text}", "f").data["a"]
    assert read == value
    assert type(read) is type(value)


def test_not_a_number_is_read_and_left_to_be_refused() -> None:
    assert math.isnan(parse_yaml("a: .NaN", "f").data["a"])


def test_lines_are_those_of_keys_and_of_elements() -> None:
    text = "# first\na:\n  b:\n    1\n  c: [1,\n    {d: 2}]\ne:\n- x\n- y\n"
    file = parse_yaml(text, "f")
    assert file.data == {"a": {"b": 1, "c": (1, {"d": 2})}, "e": ("x", "y")}
    lines = {("a",): 2, ("a", "b"): 3, ("a", "c"): 5, ("a", "c", 1): 6, ("a", "c", 1, "d"): 6, ("e", 1): 9}
    assert {path: file.line(path) for path in lines} == lines
    assert file.line(("a", "z", "y")) == 2
    assert file.line(()) == 2
    assert file.fault(("a", "c", 1), "wrong") == "f, line 6: a.c[1]: wrong"
    assert file.fault((), "wrong") == "f, line 2: wrong"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "f is empty"),
        ("# only this\n", "f is empty"),
        ("a: 1\nb: &x 2\n", "line 2: the anchor &x"),
        ("a: 1\nb: *x\n", r"line 2: the alias \*x"),
        ("a: &x [*x]", "line 1: the anchor &x"),
        ("b: {<<: *x}", r"the alias \*x"),
        ("\na: !!python/object/apply:os.system [ls]", "line 2: the tag '!!python/object/apply:os.system'"),
        ("a: !!float 1", "the tag '!!float'"),
        ("a: !mine {b: 1}", "the tag '!mine'"),
        ("a: !!opencv-matrix {}", "the tag '!!opencv-matrix'"),
        ("a: 1\nb: 2\na: 3", "line 3: a is there twice, first in line 1"),
        ("x:\n  a: 1\n  a: 3", "line 3: x.a is there twice, first in line 2"),
        ("'1': 1\n1: 3", "line 2: 1 is there twice"),
        ("{[1]: 2}", "line 1: a key that is itself a list or a mapping"),
        ("? {a: 1}\n: 2", "line 1: a key that is itself"),
        ("a: 1\n---\nb: 1", "line 2: a second document"),
        ("a: [1, 2\nb: 3", "line 2: not YAML"),
        ("a:\n\tb: 3", "line 2: not YAML: .*indent with blanks, not tabs"),
        ("a: 1\n b: 2", "line 2: not YAML"),
        ("a: 1\nb: \x00", "line 2: a character that no YAML file has"),
        ('a: "\\UFFFFFFFF"', "not YAML"),
        ("a: " + "[" * 21 + "]" * 21, "line 1: more than 20"),
        ("[" * 200_000, "line 1: more than 20"),
        ("%YAML " + "1" * 5000 + ".0\n---\na: 1", "not YAML"),
    ],
)
def test_refused(text: str, words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        parse_yaml(text, "f")


def test_depth_that_is_read() -> None:
    assert parse_yaml("a: " + "[" * 19 + "]" * 19, "f").data


def test_a_tag_that_is_passed_over() -> None:
    assert parse_yaml("a: !!opencv-matrix {b: 1}", "f", tags=(OPENCV_MATRIX,)).data == {"a": {"b": 1}}


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    with pytest.raises(FileFormatError, match=r"a\.yaml cannot be read: No such file"):
        read_yaml(path)
    with pytest.raises(FileFormatError, match="cannot be read: it is a folder"):
        read_yaml(tmp_path)
    with pytest.raises(FileFormatError, match="is not a path"):
        read_yaml("a\0b")
    path.write_bytes(b"a: \xff\xfe")
    with pytest.raises(FileFormatError, match=r"a\.yaml is not a text file in UTF-8 \(byte 3\)"):
        read_yaml(path)
    path.write_bytes(b"#" * (MOST_BYTES + 1))
    with pytest.raises(FileFormatError, match="is larger than 1000000 bytes"):
        read_yaml(path)
    path.write_bytes(b"\xef\xbb\xbfa: 1")
    assert read_yaml(path).data == {"a": 1}


def test_paths_and_values_for_messages() -> None:
    assert dotted(("a", "b/c", 2, "d e", "")) == "a.b/c[2].'d e'.''"
    assert shown("\ud800") == r"'\ud800'"
    assert shown(None) == "empty"
    assert shown("x" * 100) == "'" + "x" * 59 + "..."
    assert (shown((1, 2)), shown((1,) * 99), shown({"a": 1}), shown(True)) == (
        "[1, 2]", "a list of 99", "a mapping of 1 keys", "true",
    )  # fmt: skip


@settings(deadline=None)
@given(st.text(st.sampled_from("ab:-[]{}?,&*!|>'\"%@#\\\n \tU01.xF~<=é\x00\x85\ufeff\ud800"), max_size=60))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        file = parse_yaml(text, "f")
    except FileFormatError:
        return
    assert all(1 <= line <= text.count("\n") + text.count("\x85") + 1 for line in file.lines.values())


@pytest.mark.parametrize("text", ["a: [" + "1," * MOST_VALUES + "]", "".join(f"k{i}: 1\n" for i in range(MOST_VALUES))])
def test_a_file_of_too_many_values_is_refused_before_all_are_read(text: str) -> None:
    with pytest.raises(FileFormatError, match=rf"f, line \d+: more than {MOST_VALUES} keys and values"):
        parse_yaml(text, "f")


def written(path: Path) -> str:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("error", 0.25)
    storage.write("name", "left camera")
    storage.write("K", np.arange(9.0).reshape(3, 3))
    storage.startWriteStruct("poses", cv2.FileNode_SEQ)
    for i in range(2):
        storage.write("", np.full((2, 1), i + 0.5))
    storage.endWriteStruct()
    storage.startWriteStruct("sizes", cv2.FileNode_SEQ)
    for i in range(3):
        storage.write("", i)
    storage.endWriteStruct()
    storage.startWriteStruct("inside", cv2.FileNode_MAP)
    storage.write("k1", -0.1)
    storage.endWriteStruct()
    storage.release()
    return path.read_text()


@pytest.mark.parametrize("ending", ["yaml", "xml", "json"])
def test_what_opencv_writes(tmp_path: Path, ending: str) -> None:
    file = parse_storage(written(tmp_path / f"a.{ending}"), "a")
    assert {key: file.data[key] for key in ("image_width", "error", "name", "sizes", "inside")} == {
        "image_width": 640, "error": 0.25, "name": "left camera", "sizes": (0, 1, 2), "inside": {"k1": -0.1},
    }  # fmt: skip
    assert file.data["K"]["data"] == tuple(range(9))
    assert (file.data["K"]["rows"], file.data["K"]["cols"]) == (3, 3)
    assert [pose["data"] for pose in file.data["poses"]] == [(0.5, 0.5), (1.5, 1.5)]
    assert file.line(("K", "data")) > file.line(("image_width",)) > 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<a/>", "line 1: <a> in place of <opencv_storage>"),
        ("<opencv_storage>\n<a>1</b>\n</opencv_storage>", "line 2: not XML: mismatched tag"),
        ("<opencv_storage>\n<a>1</a><a>2</a></opencv_storage>", "line 2: <a> is there twice"),
        ("<opencv_storage><_>1</_>\n<a>2</a></opencv_storage>", "line 2: <a> is there twice, or between items"),
        ("<opencv_storage/>", "<opencv_storage> is empty"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>', "a DOCTYPE"),
        ("<a>" * 3, "line 1: <a> in place of"),
        ("<opencv_storage>" * 40, "nested more deeply than 20"),
        ("<opencv_storage><a>" + "1 " * 60_001, "not XML"),
        ("<opencv_storage><a>" + "1 " * 60_001 + "</a></opencv_storage>", "more than 60000 values"),
        ("a: !!python/tuple [1]", "line 1: the tag '!!python/tuple'"),
    ],
)
def test_what_it_does_not_write(text: str, words: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        parse_storage(text, "a.xml")
    assert words in str(caught.value)


@settings(max_examples=100, deadline=None)
@given(
    st.text(alphabet="<>/_a1 \"'\n&;![]x.-", max_size=60).map(lambda text: f"<opencv_storage>{text}</opencv_storage>")
)
def test_any_xml_is_a_tree_or_an_error_of_ours(text: str) -> None:
    try:
        file = parse_storage(text, "any.xml")
    except FileFormatError as error:
        assert "any.xml" in str(error)  # noqa: PT017
    else:
        assert isinstance(file.data, dict)
