"""OpenCV's FileStorage: what cv2 writes in YAML, XML and JSON is one tree; what it does not write is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.yaml_lines import parse_storage


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
