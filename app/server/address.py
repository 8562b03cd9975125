"""The address on which the server listens, and the links to it."""

import errno
import os
import socket
import sys
from typing import Final

from app.server.access import Access
from app.server.bridge import BUFFER_BYTES
from app.slam.errors import HemislamError

UNREAD_S: Final = 120
"""The system closes a connection whose peer accepts no data for this long (Linux)."""


def listen(host: str, port: int) -> socket.socket:
    """A listening socket. Accepted connections inherit its options.

    Raises:
        HemislamError: the port is in use, or the address does not belong to this machine.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except OSError:
        raise HemislamError(f"{host} is not an address of this machine; choose another one by --host.") from None
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)  # named, or asyncio keeps Nagle
    if os.name == "posix":  # on Windows it would let two servers share the port
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNREAD_S * 1000)
    try:
        listener.bind(address)
        listener.listen(128)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise HemislamError(f"Port {port} is in use by another program; choose another one by --port.") from None
        raise HemislamError(
            f"The address {host}:{port} cannot be used ({error.strerror}); choose another one by --host and --port."
        ) from None
    return listener


def links(host: str, access: Access, token: str | None = None) -> list[str]:
    """The addresses to open: first for this computer, then for others.

    Args:
        token: to put into the links; None: the owner's, if there is one.
    """
    names = ["localhost", _own_address()] if host in ("0.0.0.0", "::", "") else [host]
    token = token or access.token
    query = f"?token={token}" if token else ""
    scheme = "https" if access.secure else "http"
    return [f"{scheme}://{f'[{name}]' if ':' in name else name}:{access.port}/{query}" for name in names]


def _own_address() -> str:
    """This computer's address on the network of its default route; its name if there is none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing: it only chooses the route
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()


def has_display() -> bool:
    """Whether a browser can be opened here."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
