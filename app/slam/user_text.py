"""Read text that users wrote, YAML and tables of numbers. What is wrong becomes one sentence with source and line."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from app.slam.arrays import F64
from app.slam.errors import HemislamError

TextRows = list[tuple[int, list[str]]]
"""The number and the words of each line that is not empty; `#` begins a comment."""


class _TwiceError(yaml.MarkedYAMLError):
    """A name appears twice in one section."""


class _Loader(yaml.SafeLoader):
    """Refuses a key that appears twice; YAML forbids it, and otherwise the first value would be lost."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in names:
                    raise _TwiceError(problem=key.value, problem_mark=key.start_mark)
                names.add(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(text: str, source: str, hint: str) -> Any:
    """The value of a YAML text; None if it is empty.

    Args:
        source: file or other origin of the text. hint: how to write it, for the error message.

    Raises:
        HemislamError: the text is not valid YAML, or a name appears twice in one section of it.
    """
    try:
        return yaml.load(text, _Loader)
    except RecursionError:
        raise HemislamError(f"{source} is nested too deeply; {hint}.") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        twice = f", where `{error.problem}` stands a second time" if isinstance(error, _TwiceError) else ""
        raise HemislamError(f"{source} is not valid YAML{line}{twice}; {hint}.") from None


def read_assignments(texts: Iterable[str], option: str, example: str) -> dict[str, Any]:
    """Values by dotted parameter name from texts `section.name=value`; each value is YAML.

    Args:
        option, example: the command-line option and how to write it, for the error message.

    Raises:
        HemislamError: a text has no value, or its value is not valid YAML.
    """
    values = {}
    for text in texts:
        path, equals, value = text.partition("=")
        if not equals:
            raise HemislamError(f"`{option}` needs a value for `{text}`; write it as `{example}`.")
        values[path.strip()] = read_yaml(value, f"The value of `{text}`", f"write it as `{example}`")
    return values


def read_numbers(texts: Iterable[str], names: Sequence[str], least: float = -math.inf) -> dict[str, float]:
    """Finite numbers by name from texts `name=value`. Raises HemislamError: a name or value is invalid."""
    values = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            values[name] = float(value)
        except ValueError:
            values[name] = math.nan
        if name not in names or not (math.isfinite(values[name]) and values[name] >= least):
            raise HemislamError(f"`{text}` is not NAME=VALUE with a NAME of {', '.join(sorted(names))}.")
    return values


def read_text(path: Path, hint: str, *, errors: str = "strict") -> str:
    """A file in UTF-8.

    Args:
        hint: what to do where it is no text, for the error message. errors: as `bytes.decode` has it.

    Raises:
        HemislamError: the file cannot be read or is not text.
    """
    try:
        return path.read_text(encoding="utf-8-sig", errors=errors)
    except UnicodeDecodeError:
        raise HemislamError(f"{path} is not a text file; {hint}.") from None
    except OSError as error:
        raise HemislamError(f"{path} cannot be read: {error.strerror}; check the path.") from None


def read_rows(path: Path, layout: str) -> TextRows:
    """The rows of a file. `layout`: what its lines should be, for the error message. Raises as `read_text`."""
    lines = read_text(path, layout).splitlines()
    rows = [(number, line.partition("#")[0].split()) for number, line in enumerate(lines, 1)]
    return [(number, words) for number, words in rows if words]


def as_numbers(path: Path, rows: TextRows, columns: int, layout: str) -> F64:
    """(n, columns) numbers of the rows.

    Raises:
        HemislamError: a row has another number of columns, or holds a word that is not a finite number.
    """
    table = np.empty((len(rows), columns))
    for index, (number, words) in enumerate(rows):
        if len(words) != columns:
            raise HemislamError(f"{path}, line {number} has {len(words)} columns, not {columns}; {layout}.")
        try:
            table[index] = [float(word) for word in words]
        except ValueError:
            raise HemislamError(f"{path}, line {number} holds a word that is not a number; {layout}.") from None
        if not np.isfinite(table[index]).all():
            raise HemislamError(f"{path}, line {number} holds NaN or infinity; remove the line.")
    return table
