"""Where the window is served and who may look: its socket, and beyond this machine a token.

The token is that of the environment variable `TOKEN_VARIABLE`, or made for the run and told once on the terminal. It stands
behind the # of the address: browsers do not send that part, so that it is in no log.
"""

import contextlib
import errno
import ipaddress
import os
import secrets
import socket
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

from nav.errors import HilError

DEFAULT = "127.0.0.1:8765"
"""Address of `hil run`."""
TOKEN_VARIABLE = "HIL_DASHBOARD_TOKEN"
SHORTEST_TOKEN = 16
_TRIES = 20
"""Ports above the default one that are tried where it is in use."""
_SEND_BUFFER = 1 << 14
"""Bytes on their way to one browser, in the kernel: what a slow one still gets is not old."""
_PACKAGES = ("starlette", "uvicorn", "websockets")


@dataclass(frozen=True, slots=True)
class Window:
    """A bound socket and what guards it; picklable to a spawned process.

    Attributes
    ----------
    socket : socket
        Bound, not yet listening.
    host : str
        As the user may type it.
    token : str
        What a browser must know; empty: nothing, the address is of this machine alone.
    told : bool
        The user knows the token already.
    """

    socket: socket.socket
    host: str
    token: str = ""
    told: bool = True

    @property
    def port(self) -> int:
        """The bound port."""
        return int(self.socket.getsockname()[1])

    @property
    def url(self) -> str:
        """What to open in a browser; with the token where the user does not know it yet."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/" + ("" if self.told else f"#token={self.token}")


def open_window(address: str | None, say: Callable[[str], None]) -> Window | None:
    """Bind the window's socket.

    Parameters
    ----------
    address : str or None
        HOST:PORT, port 0 for any; None: `DEFAULT`, or the next free port above it.
    say : callable
        Gets one line: where the window is, or why there is none.

    Returns
    -------
    Window or None
        None where nobody asked for it by name and its packages are not installed or no port is to be had.

    Raises
    ------
    HilError
        The address is malformed, in use or not of this machine; a package is missing; the token is too short.
    """
    if lacking := [name for name in _PACKAGES if find_spec(name) is None]:
        mend = f"no window without {', '.join(lacking)}: pip install 'dtg-hil[dashboard]'"
        if address is not None:
            raise HilError(f"--dashboard {address}: {mend}")
        say(mend)
        return None
    host, port = _parts(address or DEFAULT)
    wanted = os.environ.get(TOKEN_VARIABLE, "")
    if wanted and len(wanted) < SHORTEST_TOKEN:
        raise HilError(f"{TOKEN_VARIABLE}: at least {SHORTEST_TOKEN} characters, as `openssl rand -hex 16` makes them")
    try:
        bound = _bind(address, host, port)
    except HilError as error:
        if address is not None:
            raise
        say(f"no window: {error}")
        return None
    local = ipaddress.ip_address(bound.getsockname()[0].partition("%")[0])
    shown = socket.gethostname() if local.is_unspecified else host
    token = wanted or ("" if local.is_loopback else secrets.token_urlsafe(24))
    window = Window(bound, shown, token, told=bool(wanted) or not token)
    also = f", port {port} is in use" if port not in (0, window.port) else ""
    say(f"window: {window.url}" + (f" (token: {TOKEN_VARIABLE})" if wanted else "") + also)
    return window


def _parts(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isdecimal() or int(port) > 0xFFFF:
        raise HilError(f"--dashboard {address}: expected HOST:PORT, as {DEFAULT}")
    return host, int(port)


def _bind(address: str | None, host: str, port: int) -> socket.socket:
    try:
        family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise HilError(f"--dashboard {address}: host {host!r} is not known ({error.strerror})") from error
    ports = range(port, port + 1 if address is not None else port + _TRIES)
    for tried in ports:
        bound = socket.socket(family, socket.SOCK_STREAM)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        with contextlib.suppress(OSError):
            bound.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        try:
            bound.bind((place[0], tried, *place[2:]))
            bound.listen()  # now, so that the port is ours: two sockets may bind, one may listen
        except OSError as error:
            bound.close()
            if error.errno != errno.EADDRINUSE:
                raise HilError(f"--dashboard {host}:{port}: {error.strerror}; choose another address") from error
        else:
            return bound
    raise HilError(
        f"the window's port {port} is in use on {host}: end the other run, choose one with --dashboard {host}:PORT, "
        "or run with --no-dashboard"
    )
