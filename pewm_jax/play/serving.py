"""Serve the page: its address, the browser, and protection against other sites.

A browser lets any page open a websocket to any address, including this machine's, and only tells
the server which page asks (``Origin``) and by which name the server was addressed (``Host``). A
page of another site has another origin. A page whose own name was redirected to this machine ("DNS
rebinding") has the same origin, but an unknown host name. See RFC 6455, section 10.2.
"""

from __future__ import annotations

import contextlib
import http
import io
import ipaddress
import os
import re
import socket
import sys
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from typing import Any
from urllib.parse import SplitResult, urlsplit

from pewm_jax.config import ConfigError, UserError
from pewm_jax.play.settings import LOOPBACK, Serve

try:
    import viser
    import viser.transforms
    import websockets.asyncio.server
    from websockets.http11 import Request
except ImportError:
    raise UserError(
        "the live viewer needs viser, which is not installed: pip install 'pewm-jax[play]'."
    ) from None


def open_in_browser(url: str) -> bool:
    """Open a page in the browser if there is a desktop; return whether this was attempted."""
    desktop = sys.platform == "darwin" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    return desktop and webbrowser.open(url)


def warning(serve: Serve) -> str:
    """Return a warning for a page that other machines can reach; empty if only this one can."""
    if serve.host in LOOPBACK:
        return ""
    return (
        f"Anyone who reaches this machine at {serve.host} can drive, and load and save worlds: "
        "there is no password."
    )


def here(host: str) -> str:
    """Return the form of a host in addresses on this machine."""
    if host in ("0.0.0.0", "::"):  # noqa: S104 - a comparison, nothing is served here
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


def server(serve: Serve, log: Callable[[str], None] = lambda _: None) -> viser.ViserServer:
    """Start the server, without viser's own message; reject pages of other sites.

    ``log`` receives the reasons for rejections.

    Raises:
        ConfigError: the host is not an address of this machine; viser would wait for it forever.
        UserError: the requests of this version of viser cannot be checked.
    """
    try:
        kind, *_, address = socket.getaddrinfo(serve.host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(kind) as probe:
            probe.bind(address)
    except OSError as error:
        raise ConfigError(
            f"--host {serve.host} is not an address that this machine can serve on ({error}); use "
            "127.0.0.1, or 0.0.0.0 to allow other machines."
        ) from None
    checked = refuse_other_sites(serve.host, serve.names, log)
    with contextlib.redirect_stdout(io.StringIO()), checked as servers:
        begun = viser.ViserServer(host=serve.host, port=serve.port, verbose=False)
        if not servers:
            begun.stop()
            raise UserError(
                f"viser {viser.__version__} does not support rejecting pages of other sites: "
                "pip install 'viser==1.1.1'."
            )
    return begun


PORTS = {"http": 80, "https": 443}
"""Default ports, which addresses omit."""
PLAIN = re.compile(r"[a-z0-9._:-]{1,253}")
"""Host names that are safe to print; other text that a client sends must not reach the terminal."""
MOST_REPORTED = 20
"""Largest number of rejections printed: a page that tries many names must not flood the
terminal."""


def rejection_reason(
    origin: str | None, host: str | None, here: str, names: Sequence[str] = ()
) -> str:
    """Return the reason why a request is rejected, as a sentence; empty if it is allowed.

    Args:
        origin: its header ``Origin``; None if the request does not come from a browser's page.
        host: its header ``Host``: the name of the server, with or without a port.
        here: the host served on; localhost, this machine's name and numeric addresses are always
            allowed.
        names: further allowed names of the page, such as that of a proxy.
    """
    called = _parts(f"//{host or ''}")
    if called is None:
        return f"{host!r} is not a name of this page."
    known = {"localhost", *(name.lower() for name in (here, *names, *_own_names()))}
    name = called.hostname
    if not (name in known or _in_digits(name)):
        return f"{name!r} is not a known name of this page: --names {name} allows it."
    return "" if origin is None else _page_rejection_reason(origin, called, names)


def _page_rejection_reason(origin: str, called: SplitResult, names: Sequence[str]) -> str:
    """Return why a page may not use a server addressed by a known name; empty if it may."""
    asking = _parts(origin)
    if asking is None or asking.scheme not in PORTS:
        return f"A page without its own address ({origin!r}) may not drive here."
    usual = PORTS[asking.scheme]
    same = (asking.hostname, asking.port or usual) == (called.hostname, called.port or usual)
    if same or asking.hostname in {name.lower() for name in names}:
        return ""  # the latter is a proxy that addresses the server by another name than its own
    return (
        f"A page of {asking.hostname!r} may not drive here: it is another site. If a proxy shows "
        f"this page there, --names {asking.hostname} allows it."
    )


@contextlib.contextmanager
def refuse_other_sites(
    here: str, names: Sequence[str], log: Callable[[str], None]
) -> Iterator[list[Any]]:
    """Make websocket servers started inside the block check requests and reject with 403.

    viser starts its server internally and has no hook for such a check, so the function that starts
    it is replaced inside the block. ``log`` receives each reason once.

    Yields:
        A list with an entry for each server that checks.
    """
    home, plain = websockets.asyncio.server, websockets.asyncio.server.serve
    servers, reported = [], set()

    def serve(*args: Any, process_request: Any = None, **rest: Any) -> Any:
        def process(connection: Any, request: Request) -> Any:
            headers = request.headers
            try:
                reason = rejection_reason(headers.get("Origin"), headers.get("Host"), here, names)
            except LookupError:  # a repeated header
                reason = "A request with two hosts or two origins is rejected."
            if not reason:
                return None if process_request is None else process_request(connection, request)
            if reason not in reported and len(reported) < MOST_REPORTED:
                reported.add(reason)
                log(f"refused: {reason}")
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")

        servers.append(process)
        return plain(*args, process_request=process, **rest)

    home.serve = serve  # type: ignore[assignment]
    try:
        yield servers
    finally:
        home.serve = plain  # type: ignore[assignment]


def _parts(address: str) -> SplitResult | None:
    """Split an address; return None if its host or port is missing or invalid."""
    try:
        parts = urlsplit(address)
        _ = parts.port  # raises if the port is invalid
    except ValueError:
        return None
    return parts if PLAIN.fullmatch(parts.hostname or "") else None


def _in_digits(host: str | None) -> bool:
    """Return whether a host is a numeric address, which DNS cannot redirect."""
    try:
        ipaddress.ip_address(host or "")
    except ValueError:
        return False
    return True


def _own_names() -> tuple[str, ...]:
    """Return this machine's host name, plain and in the local network."""
    name = socket.gethostname().lower()
    return (name, f"{name}.local")
