"""YAML files with the line of every value, for error messages. The files are not trusted.

A file is one document of mappings, lists and scalars, as people write it by hand. Refused are aliases (a small file
could grow without limit), tags (they can stand for any object), keys given twice, and keys that are not text. A scalar
without quotes is a number, true, false or null as in YAML 1.2: ``1e-3`` is a number, ``no`` and ``12:30`` are text.
PyYAML parses the file. Its constructor is not used: it reads ``1e-3`` as text, ``no`` as false, and of two equal keys
the last.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn, TypeAlias
from xml.parsers import expat

import yaml

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.whole_files import read_whole

KeyPath: TypeAlias = tuple[str | int, ...]

#: A file of more bytes than this is not read.
MOST_BYTES = 1_000_000
#: A file has at most this many keys, values and items: a second's work. OpenCV's files with all image points fit.
MOST_VALUES = 60_000
#: At most this many mappings and lists may be inside one another.
DEEPEST = 20
#: OpenCV's files have this tag; `parse_yaml` can ignore it.
OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"

_WORDS = {
    "": None, "~": None, "null": None, "Null": None, "NULL": None,
    "true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False,
}  # fmt: skip
#: Longer integers become floats: Python does not convert thousands of digits.
_INTEGER = re.compile(r"[-+]?[0-9]{1,18}")
_NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"([-+]?)\.(inf|nan)", re.IGNORECASE)
_PLAIN_KEY = re.compile(r"[A-Za-z0-9_/.-]+")


@dataclass(frozen=True)
class YamlFile:
    """The contents of a YAML file, with their lines."""

    where: str  #: The file's name, for messages
    data: Any  #: Mappings are dicts with keys of text, lists are tuples, scalars are str, int, float, bool or None
    #: For each value the line of its key, or of the value itself in a list, from 1 on
    lines: Mapping[KeyPath, int]

    def line(self, path: KeyPath) -> int:
        """The line of a value, or of the mapping or list that should contain it."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 1)

    def place(self, path: KeyPath) -> str:
        """``FILE, line N: a.b[0]``."""
        return ": ".join(filter(None, (f"{self.where}, line {self.line(path)}", dotted(path))))

    def fault(self, path: KeyPath, words: str) -> str:
        """``FILE, line N: a.b[0]: words``."""
        return f"{self.place(path)}: {words}"

    def sections(self, key: str) -> dict[str, YamlFile]:
        """The values of a top-level mapping, each as a file of its own that keeps its lines in this file."""
        lines: dict[str, dict[KeyPath, int]] = {name: {} for name in self.data[key]}
        for path, line in self.lines.items():
            if len(path) > 1 and path[0] == key:
                lines[str(path[1])][path[2:]] = line
        return {name: YamlFile(self.where, value, lines[name]) for name, value in self.data[key].items()}


def read_yaml(path: str | Path) -> YamlFile:
    """Read a file, with the errors of `read_text` and `parse_yaml`."""
    return parse_yaml(read_text(path), str(path))


def read_text(path: str | Path) -> str:
    """The text of a small file; `FileFormatError` if it cannot be read, is larger than `MOST_BYTES` or is not UTF-8."""
    content = read_whole(path, MOST_BYTES, "YAML was")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is not a text file in UTF-8 (byte {error.start}); YAML was expected.") from error


def parse_yaml(text: str, where: str, *, tags: Collection[str] = (), most_values: int = MOST_VALUES) -> YamlFile:
    """Parse one document; `tags` are ignored, and more than `most_values` keys and values are refused.

    Raises
    ------
    FileFormatError
        The text is not YAML of the kind that the module describes. The message has the line.
    """
    reader = _Reader(where, frozenset(tags), _events(text, where), most_values)
    return YamlFile(where, reader.document(), reader.lines)


def dotted(path: KeyPath) -> str:
    """A key path as ``sensors.cam_left.D[2]``, with quotes around keys that are not plain."""
    text = ""
    for key in path:
        if isinstance(key, int):
            text += f"[{key}]"
        else:
            text += ("." if text else "") + (key if _PLAIN_KEY.fullmatch(key) else shown(key))
    return text


def suggestion(key: str, known: Collection[str]) -> str:
    """The message about an unknown key: the nearest known key, or all known keys."""
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.65)
    return f"unknown key; did you mean {near[0]}?" if near else f"unknown key; known keys are {', '.join(known)}"


def shown(value: Any) -> str:
    """A value for a message, at most about 60 characters long."""
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return f"a mapping of {len(value)} keys"
    if isinstance(value, tuple) and len(repr(value)) > 60:
        return f"a list of {len(value)}"
    text = repr(list(value)) if isinstance(value, tuple) else repr(value)
    return text if len(text) <= 60 else text[:60] + "..."


def _events(text: str, where: str) -> Iterator[Any]:
    try:
        loader = yaml.SafeLoader(text)
        while loader.check_event():
            yield loader.get_event()  # type: ignore[no-untyped-call]
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = 1 if mark is None else mark.line + 1
        said = " ".join(part for part in (error.context, error.problem) if part)
        hint = "; indent with blanks, not tabs" if "'\\t'" in said else ""
        raise FileFormatError(f"{where}, line {line}: not YAML: {said}{hint}") from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise FileFormatError(
            f"{where}, line {line}: a character that no YAML file has ({error.character!r}); is it a text file?"
        ) from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # escapes and versions out of range
        raise FileFormatError(f"{where}: not YAML: {error}") from error


@dataclass
class _Reader:
    """Reads the events of one document in their order; `lines` are those of `YamlFile`."""

    where: str
    tags: frozenset[str]
    events: Iterator[Any]
    most_values: int
    lines: dict[KeyPath, int] = field(default_factory=dict)
    nodes: int = 0

    def document(self) -> Any:
        next(self.events)  # the stream begins
        if isinstance(next(self.events), yaml.StreamEndEvent):
            raise FileFormatError(f"{self.where} is empty; a YAML mapping was expected.")
        data = self._value(self._node(), (), 0)
        next(self.events)  # the document ends
        after = next(self.events)
        if isinstance(after, yaml.DocumentStartEvent):
            self._refuse(after, "a second document begins ('---'); keep one document")
        return data

    def _value(self, event: Any, path: KeyPath, depth: int) -> Any:
        """The value that begins with `event`, inside `depth` mappings and lists."""
        self.lines.setdefault(path, _line(event))  # in a mapping the key's line is there already
        if isinstance(event, yaml.ScalarEvent):
            return scalar(event.value) if event.style is None else event.value
        if depth == DEEPEST:
            self._refuse(event, f"more than {DEEPEST} mappings and lists inside one another; nest less deeply")
        if isinstance(event, yaml.SequenceStartEvent):
            items: list[Any] = []
            while not isinstance(event := self._node(), yaml.SequenceEndEvent):
                items.append(self._value(event, (*path, len(items)), depth + 1))
            return tuple(items)
        mapping: dict[str, Any] = {}
        while not isinstance(event := self._node(), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                self._refuse(event, "a key that is itself a list or a mapping; is there a {, [ or ? too many?")
            under = (*path, event.value)
            if event.value in mapping:
                self._refuse(event, f"{dotted(under)} is there twice, first in line {self.lines[under]}; keep one")
            self.lines[under] = _line(event)
            mapping[event.value] = self._value(self._node(), under, depth + 1)
        return mapping

    def _node(self) -> Any:
        """The next event: a node without alias, anchor and tag, or the end of a list or mapping."""
        event = next(self.events)
        self.nodes += 1
        if self.nodes > self.most_values:
            self._refuse(event, f"more than {self.most_values} keys and values; is it the right file?")
        if isinstance(event, yaml.AliasEvent):
            self._refuse(event, f"the alias *{event.anchor}: aliases are not read; write the value out")
        if isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent):
            if event.anchor is not None:
                self._refuse(event, f"the anchor &{event.anchor}: anchors are not read; write each value out")
            if event.tag is not None and event.tag not in self.tags:
                tag = event.tag.replace("tag:yaml.org,2002:", "!!")
                self._refuse(event, f"the tag {shown(tag)}: tags are not read; write a plain value")
        return event

    def _refuse(self, event: Any, words: str) -> NoReturn:
        raise FileFormatError(f"{self.where}, line {_line(event)}: {words}.")


def _line(event: Any) -> int:
    return int(event.start_mark.line) + 1


def scalar(text: str) -> str | int | float | bool | None:
    """Return the value of a scalar without quotes, as in YAML 1.2's core schema (without 0o and 0x)."""
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _NUMBER.fullmatch(text):
        return float(text)
    match = _NOT_FINITE.fullmatch(text)
    return float(match[1] + match[2]) if match else text


#: The root of an XML file that OpenCV wrote.
_ROOT = "opencv_storage"
#: An item of a list has this name in XML.
_ITEM = "_"
#: OpenCV's files have these tags in YAML.
_TAGS = (OPENCV_MATRIX, "tag:yaml.org,2002:opencv-nd-matrix")


def parse_storage(text: str, where: str, most_values: int = MOST_VALUES) -> YamlFile:
    """Parse a file in YAML, JSON, or OpenCV's XML; OpenCV's matrices are mappings with rows, cols, dt and data.

    Raises `FileFormatError` as `parse_yaml`; or the XML is not OpenCV's. The message has the line.
    """
    bare = text.lstrip()
    if bare.startswith("<"):
        return _Xml(where, most_values).parsed(text)
    if bare.startswith(("{", "[")):  # JSON: tabs are blanks, which YAML does not have
        text = text.replace("\t", " ")
    # OpenCV begins with "%YAML:1.0", which is not valid YAML.
    return parse_yaml(re.sub(r"\A%YAML:", "%YAML ", text), where, tags=_TAGS, most_values=most_values)


@dataclass
class _Element:
    """An element of XML; the elements in it by their names, or by their numbers in a list."""

    name: str
    line: int
    is_matrix: bool
    texts: list[str] = field(default_factory=list)
    inside: dict[str | int, _Element] = field(default_factory=dict)


class _Xml:
    """Reads the elements of one file. Declarations of types and entities are refused."""

    def __init__(self, where: str, most_values: int) -> None:
        self.where, self.most_values = where, most_values
        self.lines: dict[KeyPath, int] = {}
        self.file = _Element("", 1, False)
        self.open = [self.file]
        self.count = 0
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._begin
        self.parser.EndElementHandler = lambda _: self.open.pop()
        self.parser.CharacterDataHandler = lambda text: self.open[-1].texts.append(text)
        self.parser.StartDoctypeDeclHandler = self._declared

    def parsed(self, text: str) -> YamlFile:
        try:
            self.parser.Parse(text.encode(), True)
        except expat.ExpatError as error:
            raise FileFormatError(f"{self.where}, line {error.lineno}: not XML: {error}") from error
        except ValueError as error:  # an encoding that its declaration does not name
            raise FileFormatError(f"{self.where}: not XML: {error}") from error
        data = self._value(self.file.inside[_ROOT], (), False)
        if not isinstance(data, dict):
            self._refuse(self.parser.CurrentLineNumber, f"<{_ROOT}> is empty")
        return YamlFile(self.where, data, self.lines)

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        line = self.parser.CurrentLineNumber
        self._take(line, 1)
        if len(self.open) > DEEPEST + 1:
            self._refuse(line, f"nested more deeply than {DEEPEST}; is it the right file?")
        above = self.open[-1]
        if above is self.file and name != _ROOT:
            self._refuse(line, f"<{name}> in place of <{_ROOT}>, with which OpenCV's files begin")
        key = len(above.inside) if name == _ITEM else name
        if key in above.inside or (above.inside and (0 in above.inside) != (name == _ITEM)):
            self._refuse(line, f"<{name}> is there twice, or between items of a list")
        above.inside[key] = _Element(name, line, attributes.get("type_id", "").startswith("opencv-"))
        self.open.append(above.inside[key])

    def _value(self, element: _Element, path: KeyPath, in_matrix: bool) -> Any:
        """A list, a mapping, a string, a number, or numbers separated by blanks, as OpenCV writes lists."""
        self.lines[path] = element.line
        values: dict[Any, Any] = {
            key: self._value(part, (*path, key), element.is_matrix) for key, part in element.inside.items()
        }
        if values:
            return tuple(values.values()) if 0 in values else values
        text, is_list = "".join(element.texts).strip(), in_matrix and element.name == "data"
        if text.startswith('"') and text.endswith('"') and len(text) > 1 and not is_list:
            return text[1:-1]
        words = text.split()
        self._take(element.line, len(words))
        scalars = tuple(scalar(word) for word in words)
        if is_list or (len(scalars) > 1 and all(isinstance(each, (int, float)) for each in scalars)):
            return scalars
        return scalars[0] if len(scalars) == 1 else text or None

    def _take(self, line: int, count: int) -> None:
        self.count += count
        if self.count > self.most_values:
            self._refuse(line, f"more than {self.most_values} values; is it the right file?")

    def _declared(self, *_: Any) -> None:
        self._refuse(self.parser.CurrentLineNumber, "a DOCTYPE, which OpenCV's files do not have")

    def _refuse(self, line: int, words: str) -> NoReturn:
        raise FileFormatError(f"{self.where}, line {line}: {words}.")
