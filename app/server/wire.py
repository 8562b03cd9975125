"""Large values through a pipe without needless copies."""

import contextlib
import copyreg
import io
import pickle
import struct
from multiprocessing.connection import Connection
from typing import Any, TypeAlias

import numpy as np

Pipe: TypeAlias = "Connection[Any, Any]"  # one end; not subscriptable at run time before Python 3.13

LARGE = 16_384
"""Bytes from which on an array travels on its own, beside the pickle."""

PIPE_BYTES = 1 << 20


def widen(connection: Pipe) -> None:
    """Give a pipe a larger buffer where the system allows: each refill costs the reader a wait for its GIL."""
    with contextlib.suppress(ImportError, AttributeError, OSError):
        import fcntl

        fcntl.fcntl(connection.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)


def _reduced(array: np.ndarray) -> Any:
    """A small array comes out of the usual pickle as two views of bytes, which for a pose is four times its numbers."""
    return array.__reduce_ex__(5) if array.nbytes >= LARGE else array.__reduce__()


_TABLE = copyreg.dispatch_table | {np.ndarray: _reduced}

Parts: TypeAlias = list[bytes | memoryview]  # a value: its pickle, then the large arrays beside it


def pack(value: object) -> Parts:
    """A value as bytes. Its large arrays are not copied: they must not change as long as the parts are in use."""
    arrays: Parts = []

    def inline(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes >= LARGE:
            arrays.append(raw)
            return False
        return True

    body = io.BytesIO()
    pickler = pickle.Pickler(body, protocol=5, buffer_callback=inline)
    pickler.dispatch_table = _TABLE
    pickler.dump(value)
    return [body.getvalue(), *arrays]


def unpack(parts: Parts) -> Any:
    """The value. Its large arrays are views of the parts."""
    return pickle.loads(parts[0], buffers=parts[1:])


def send(connection: Pipe, value: object) -> None:
    """Write a value. Blocks until the other side has taken all but a pipe's buffer of it."""
    body, *arrays = pack(value)
    connection.send_bytes(struct.pack("<I", len(arrays)) + body)
    for array in arrays:
        connection.send_bytes(array)


def receive(connection: Pipe) -> Any:
    """Read a value; its large arrays are read-only. Raises EOFError once the other side has gone."""
    head = connection.recv_bytes()
    (count,) = struct.unpack_from("<I", head)
    arrays = [connection.recv_bytes() for _ in range(count)]
    return pickle.loads(memoryview(head)[4:], buffers=arrays)
