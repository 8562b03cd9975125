"""Read YAML that a user wrote: what is wrong becomes one sentence that names the source and the line."""

from collections.abc import Iterable
from typing import Any

import yaml

from app.slam.errors import HemislamError


def read_yaml(text: str, source: str, hint: str) -> Any:
    """The value of a YAML text; None if it is empty.

    Args:
        source: file or other origin of the text. hint: how to write it, for the error message.

    Raises:
        HemislamError: the text is not valid YAML.
    """
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        raise HemislamError(f"{source} is not valid YAML{line}; {hint}.") from None


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
