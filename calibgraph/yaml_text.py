"""YAML as text: mappings in and out, and what no file of ours may hold refused in one line."""

import re
from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import BaseModel

from calibgraph.errors import FileError

MAX_YAML_VALUES = 500_000  # a value takes some 350 bytes while it is read
MAX_YAML_DEPTH = 200  # of brackets: the parser in C ends the process at some ten thousand


def parse_yaml(text: str, path: Path | str) -> dict[str, Any]:
    """The mapping in the text of a YAML file.

    Raises:
        FileError: if it is not YAML, not a mapping, or too deep or large when written out.
    """
    documents = parse_yaml_documents(text, path)
    if len(documents) != 1:
        raise FileError(path, f"holds {len(documents)} YAML documents, expected a single one")
    return documents[0]


def parse_yaml_documents(text: str, path: Path | str) -> list[dict[str, Any]]:
    """The mappings in the text of a YAML file, between lines ``---``; without empty ones."""
    separators = sum(map(text.count, _SEPARATORS))
    if separators > MAX_YAML_VALUES:
        why = f"holds some {separators} values, expected up to {MAX_YAML_VALUES}; is it a table?"
        raise FileError(path, why)
    if _bracket_depth(text) > MAX_YAML_DEPTH:
        raise FileError(path, _TOO_DEEP)
    if pairs := _DECIMAL_COMMAS.search(text):
        raise FileError(
            path, f"{pairs[0]} looks like decimal commas; write points, 1.5 for 1,5, or a space "
            "after each comma if these are whole numbers"
        )  # fmt: skip
    try:
        documents = list(yaml.load_all(text, Loader=_Loader))
        documents = [each for each in documents if each is not None] or documents[:1]
        expanded = sum(_expanded_size(each, {}) for each in documents)
    except (yaml.YAMLError, ValueError, IndexError) as error:
        why = str(error).replace('in "<unicode string>", ', "")
        why += "" if text.endswith("\n") else f"; {_CUT_OFF}"
        raise FileError(path, f"is not valid YAML: {why}") from error
    except RecursionError:
        raise FileError(path, _TOO_DEEP) from None
    if not text.strip():
        raise FileError(path, "is empty; if the disk was full, write or copy it again")
    for content in documents or [None]:
        if not isinstance(content, dict):
            raise FileError(
                path, f"holds {describe_value(content)}, expected a mapping of keys to values"
            )
    if expanded > MAX_YAML_VALUES:
        raise FileError(
            path, f"its aliases stand for over {MAX_YAML_VALUES} values; write them out"
        )
    return documents


_SEPARATORS = (",", "\n", ": ", "- ", "? ", "[", "{")
"""One of these is before every value but the first."""

_DECIMAL_COMMAS = re.compile(r"\[ *[-+]?[0-9]+,[0-9]+(?:, +[-+]?[0-9]+,[0-9]+)+ *\]")
"""A list of pairs, each without a space: PyYAML would read twice as many whole numbers."""

_CUT_OFF = "it ends within a line: if it was cut off, write or copy it again"
_TOO_DEEP = "is nested too deeply; expected a mapping of keys to values"


def _bracket_depth(text: str) -> int:
    """Depth to which brackets are nested; those in quotes count too."""
    data = np.frombuffer(text.encode(), np.uint8)
    opened = np.isin(data, np.frombuffer(b"[{", np.uint8)).astype(np.int8)
    closed = np.isin(data, np.frombuffer(b"]}", np.uint8)).astype(np.int8)
    return int(np.cumsum(opened - closed, dtype=np.int32).max(initial=0))


def _expanded_size(value: Any, sizes: dict[int, int]) -> int:
    """Number of values when every alias is written out; each is visited once."""
    if not isinstance(value, (dict, list)):
        return 1
    if id(value) not in sizes:
        children = value.values() if isinstance(value, dict) else value
        sizes[id(value)] = 1 + sum(_expanded_size(child, sizes) for child in children)
    return sizes[id(value)]


def yaml_text(content: dict[str, Any]) -> str:
    """A mapping as YAML, as :func:`write_yaml` writes it."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, width=200, allow_unicode=True))


def describe_value(value: object) -> str:
    """A value for a message, in a line."""
    try:
        text = repr(value)
    except ValueError:  # Python writes no number of thousands of digits
        text = f"a {type(value).__name__} of too many digits"
    return text if len(text) <= 60 else f"{text[:57]}..."  # noqa: PLR2004 - a line's worth


_FastLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_FastDumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class _Loader(_FastLoader):  # type: ignore[misc, valid-type]
    """YAML that refuses a key given twice: PyYAML would silently keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, value_node in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, (int, float)) and value_node.value == "" and node.flow_style:
                raise yaml.MarkedYAMLError(
                    problem=f"{key_node.value} after a comma has no value: is it a decimal comma? "
                    "write 1.5 for 1,5; found at",
                    problem_mark=key_node.start_mark,
                )
            if isinstance(key, (str, int)) and key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key!r} is given twice", problem_mark=key_node.start_mark
                )
            seen.add(key if isinstance(key, (str, int)) else id(key_node))
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Copy the values of merge keys (``<<``) into a mapping, and count them all."""
        super().flatten_mapping(node)
        self._flattened = getattr(self, "_flattened", 0) + len(node.value)
        if self._flattened > MAX_YAML_VALUES:
            raise yaml.MarkedYAMLError(
                problem=f"merge keys (<<) stand for over {MAX_YAML_VALUES} values",
                problem_mark=node.start_mark,
            )


def _construct_number(loader: Any, node: yaml.ScalarNode) -> Any:
    """A decimal number; ``10:40``, ``0x10``, ``010`` are texts: programs read them differently.

    ``1_000`` is refused: a text of it would be taken for a number where one is expected.
    """
    if "_" in node.value:
        raise yaml.MarkedYAMLError(
            problem=f"expected a decimal number, found {node.value}; a text needs quotes",
            problem_mark=node.start_mark,
        )
    if _NOT_DECIMAL.match(node.value):
        return loader.construct_yaml_str(node)
    if node.tag.endswith(":int"):
        return loader.construct_yaml_int(node)
    return loader.construct_yaml_float(node)


_NOT_DECIMAL = re.compile(r".*:|[-+]?0[0-9a-z]")

_Loader.add_constructor("tag:yaml.org,2002:int", _construct_number)
_Loader.add_constructor("tag:yaml.org,2002:float", _construct_number)
# OpenCV's matrices: mappings with the keys rows, cols, dt and data.
_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _Loader.construct_yaml_map)


class _Dumper(_FastDumper):  # type: ignore[misc, valid-type]
    """YAML with numpy values, and sequences of plain numbers on one line."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def _represent_sequence(dumper: yaml.SafeDumper, data: Any) -> yaml.Node:
    items = list(data)
    flow = all(isinstance(item, (int, float, str, np.number)) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flow)


def _represent_object(dumper: yaml.SafeDumper, data: Any) -> yaml.Node:
    """A mapping that is no dict, a dataclass or a pydantic model, by its fields."""
    if isinstance(data, Mapping):
        return dumper.represent_dict({**data})
    if is_dataclass(data):
        return dumper.represent_dict(vars(data))
    if isinstance(data, BaseModel):
        return dumper.represent_dict(data.model_dump())
    return dumper.represent_undefined(data)


_Dumper.add_multi_representer(object, _represent_object)
_Dumper.add_representer(list, _represent_sequence)
_Dumper.add_representer(tuple, _represent_sequence)
_Dumper.add_representer(np.ndarray, lambda dumper, data: _represent_sequence(dumper, data.tolist()))
_Dumper.add_multi_representer(np.floating, lambda dumper, data: dumper.represent_float(float(data)))
_Dumper.add_multi_representer(
    np.signedinteger, lambda dumper, data: dumper.represent_int(int(data))
)
