"""Tables of numbers in text files. What is wrong becomes one sentence that names the file and the line."""

from pathlib import Path

import numpy as np

from app.slam.errors import HemislamError
from app.slam.types import F64

Rows = list[tuple[int, list[str]]]
"""The number and the words of each line that is not empty; `#` begins a comment."""


def read_rows(path: Path, layout: str) -> Rows:
    """The rows of a file. `layout`: what its lines should be, for the error message.

    Raises:
        HemislamError: the file cannot be read or is not text.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise HemislamError(f"{path} is not a text file; {layout}.") from None
    except OSError as error:
        raise HemislamError(f"{path} cannot be read: {error.strerror}; check the path.") from None
    rows = [(number, line.partition("#")[0].split()) for number, line in enumerate(lines, 1)]
    return [(number, words) for number, words in rows if words]


def as_numbers(path: Path, rows: Rows, columns: int, layout: str) -> F64:
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
