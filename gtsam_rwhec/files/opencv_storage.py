"""Files of OpenCV's FileStorage in YAML, XML or JSON, as the same tree with the lines of its values.

OpenCV's own reader is not used: it gives no line numbers and accepts nearly any content. A file that OpenCV did not
write is read as YAML, of which JSON is a part.
"""

from __future__ import annotations

import re
from typing import Any, NoReturn
from xml.parsers import expat

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.yaml_lines import DEEPEST, MOST_VALUES, OPENCV_MATRIX, KeyPath, YamlFile, parse_yaml, scalar

#: The root of an XML file that OpenCV wrote.
_ROOT = "opencv_storage"
#: An item of a list has this name in XML.
_ITEM = "_"
#: OpenCV's files have these tags in YAML.
_TAGS = (OPENCV_MATRIX, "tag:yaml.org,2002:opencv-nd-matrix")


def parse_storage(text: str, where: str, most_values: int = MOST_VALUES) -> YamlFile:
    """Parse a file in YAML, JSON, or OpenCV's XML; OpenCV's matrices are mappings with rows, cols, dt and data.

    Raises
    ------
    FileFormatError
        As `parse_yaml`; or the XML is not OpenCV's. The message has the line.
    """
    bare = text.lstrip()
    if bare.startswith("<"):
        return _Xml(where, most_values).parsed(text)
    if bare.startswith(("{", "[")):  # JSON: tabs are blanks, which YAML does not have
        text = text.replace("\t", " ")
    # OpenCV begins with "%YAML:1.0", which is not valid YAML.
    return parse_yaml(re.sub(r"\A%YAML:", "%YAML ", text), where, tags=_TAGS, most_values=most_values)


class _Xml:
    """Reads the elements of one file in their order. Declarations of types and entities are refused."""

    def __init__(self, where: str, most_values: int) -> None:
        self.where, self.most_values = where, most_values
        self.lines: dict[KeyPath, int] = {}
        #: For each open element: its path, whether it is a matrix, its text, and what is in it.
        self.open: list[tuple[KeyPath, bool, list[str], dict[str, Any] | list[Any] | None]] = []
        self.root: Any = None
        self.count = 0
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._begin
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text
        self.parser.StartDoctypeDeclHandler = self._declared

    def parsed(self, text: str) -> YamlFile:
        try:
            self.parser.Parse(text.encode(), True)
        except expat.ExpatError as error:
            raise FileFormatError(f"{self.where}, line {error.lineno}: not XML: {error}") from error
        except ValueError as error:  # an encoding that its declaration does not name
            raise FileFormatError(f"{self.where}: not XML: {error}") from error
        if not isinstance(self.root, dict):
            self._refuse(f"<{_ROOT}> is empty")
        return YamlFile(self.where, self.root, self.lines)

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        self.count += 1
        if self.count > self.most_values or len(self.open) > DEEPEST:
            self._refuse(
                f"more than {self.most_values} values, or nested more deeply than {DEEPEST}; is it the right file?"
            )
        line = self.parser.CurrentLineNumber
        if not self.open:
            if name != _ROOT:
                self._refuse(f"<{name}> in place of <{_ROOT}>, with which OpenCV's files begin")
            path: KeyPath = ()
        else:
            above, is_matrix, texts, inside = self.open[-1]
            if inside is None:
                inside = [] if name == _ITEM else {}
                self.open[-1] = above, is_matrix, texts, inside
            if isinstance(inside, list) != (name == _ITEM) or (isinstance(inside, dict) and name in inside):
                self._refuse(f"<{name}> is there twice, or between items of a list")
            path = (*above, len(inside) if isinstance(inside, list) else name)
        self.lines.setdefault(path, line)
        self.open.append((path, attributes.get("type_id", "").startswith("opencv-"), [], None))

    def _text(self, text: str) -> None:
        if self.open:
            self.open[-1][2].append(text)

    def _end(self, _: str) -> None:
        path, _is_matrix, texts, inside = self.open.pop()
        value: Any = tuple(inside) if isinstance(inside, list) else inside
        in_matrix = bool(self.open) and self.open[-1][1]
        if inside is None:
            value = self._value("".join(texts).strip(), in_matrix and path[-1] == "data")
        if not self.open:
            self.root = value
            return
        above = self.open[-1][3]
        if isinstance(above, list):
            above.append(value)
        elif above is not None:
            above[str(path[-1])] = value

    def _value(self, text: str, is_list: bool) -> Any:
        """A string, a number, or numbers that blanks part, as OpenCV writes lists."""
        if text.startswith('"') and text.endswith('"') and len(text) > 1 and not is_list:
            return text[1:-1]
        words = text.split()
        self.count += len(words)
        if self.count > self.most_values:
            self._refuse(f"more than {self.most_values} values; is it the right file?")
        values = tuple(scalar(word) for word in words)
        are_numbers = all(isinstance(value, (int, float)) for value in values)
        if is_list or (len(values) > 1 and are_numbers):
            return values
        return values[0] if len(values) == 1 else text or None

    def _declared(self, *_: Any) -> None:
        self._refuse("a DOCTYPE, which OpenCV's files do not have")

    def _refuse(self, words: str) -> NoReturn:
        raise FileFormatError(f"{self.where}, line {self.parser.CurrentLineNumber}: {words}.")
