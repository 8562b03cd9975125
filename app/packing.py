"""Values as bytes, without copies of their large arrays: for pipes, and for what is put aside on disk."""

import pickle
from typing import Any, Final, TypeAlias

LARGE: Final = 16_384
"""Bytes from which an array is kept beside the pickle instead of inside it."""

Parts: TypeAlias = list[bytes | memoryview]  # a pickle, then the large arrays in its order


def pack(value: object) -> Parts:
    """A value as bytes. Large arrays are shared, not copied: they must not change while the parts are in use."""
    arrays: Parts = []

    def inline(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes < LARGE:
            return True
        arrays.append(raw)
        return False

    return [pickle.dumps(value, protocol=5, buffer_callback=inline), *arrays]


def unpack(parts: Parts) -> Any:
    """The value. Its large arrays are views of the parts."""
    return pickle.loads(parts[0], buffers=parts[1:])
