"""Who may talk to the page: the page itself, and no page of another site.

A browser lets any page open a websocket to any address, this machine's included, and tells the
server only which page asks (``Origin``) and by which name the server was asked for (``Host``). A
page of another site has another origin. A page whose own name was made to point at this machine
("DNS rebinding") has the same origin, but a name that is not ours. See RFC 6455, section 10.2.
"""

from __future__ import annotations

import contextlib
import http
import ipaddress
import re
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any
from urllib.parse import SplitResult, urlsplit

import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

PORTS = {"http": 80, "https": 443}
"""Ports that an address leaves out."""
PLAIN = re.compile(r"[a-z0-9._:-]{1,253}")
"""Hosts that are shown as they are: what a stranger sends must not reach the terminal otherwise."""
MOST_TOLD = 20
"""Reasons that are told; a page that tries many names must not fill the terminal."""


def objection(origin: str | None, host: str | None, here: str, names: Sequence[str] = ()) -> str:
    """Return why a request is refused, in one sentence; empty if it is welcome.

    Args:
        origin: its header ``Origin``; None where no page of a browser asks.
        host: its header ``Host``: what the server was called, with a port or without.
        here: the host that is served on; localhost, this machine's name and addresses in digits
            are known, too.
        names: what the page may be called beside, and that pages which a proxy shows have for host.
    """
    called = _parts(f"//{host or ''}")
    if called is None:
        return f"{host!r} is no name of this page."
    known = {"localhost", *(name.lower() for name in (here, *names, *_own_names()))}
    name = called.hostname
    if not (name in known or _in_digits(name)):
        return f"{name!r} is not known as a name of this page: --names {name} lets it in."
    return "" if origin is None else _objection_to_page(origin, called, names)


def _objection_to_page(origin: str, called: SplitResult, names: Sequence[str]) -> str:
    """Return why a page may not drive a server that is rightly called so; empty if it may."""
    asking = _parts(origin)
    if asking is None or asking.scheme not in PORTS:
        return f"A page without an address of its own ({origin!r}) may not drive here."
    usual = PORTS[asking.scheme]
    same = (asking.hostname, asking.port or usual) == (called.hostname, called.port or usual)
    if same or asking.hostname in {name.lower() for name in names}:
        return ""  # the latter is a proxy that calls the server by another name than its own
    return (
        f"A page of {asking.hostname!r} may not drive here: it is another site. If a proxy shows "
        f"this page there, --names {asking.hostname} lets it in."
    )


@contextlib.contextmanager
def asked(here: str, names: Sequence[str], say: Callable[[str], None]) -> Iterator[list[Any]]:
    """While the block runs, servers of websockets that begin ask who comes, and refuse with 403.

    viser begins its server by itself and offers no place for such a question, so the function by
    which it does is replaced for as long.

    Args:
        here: the host that is served on.
        names: what the page may be called beside, as for ``objection``.
        say: told each reason once.

    Yields:
        A list that holds an entry for each server that asks.
    """
    home, plain = websockets.asyncio.server, websockets.asyncio.server.serve
    servers, told = [], set()

    def serve(*args: Any, process_request: Any = None, **rest: Any) -> Any:
        def process(connection: Any, request: Request) -> Any:
            headers = request.headers
            try:
                reason = objection(headers.get("Origin"), headers.get("Host"), here, names)
            except LookupError:  # a header twice
                reason = "A request with two hosts or two origins is refused."
            if not reason:
                return None if process_request is None else process_request(connection, request)
            if reason not in told and len(told) < MOST_TOLD:
                told.add(reason)
                say(f"refused: {reason}")
            return _forbidden(reason)

        servers.append(process)
        return plain(*args, process_request=process, **rest)

    home.serve = serve  # type: ignore[assignment]
    try:
        yield servers
    finally:
        home.serve = plain  # type: ignore[assignment]


def _forbidden(reason: str) -> Response:
    body = f"{reason}\n".encode()
    headers = Headers([("Content-Type", "text/plain; charset=utf-8")])
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    status = http.HTTPStatus.FORBIDDEN
    return Response(status.value, status.phrase, headers, body)


def _parts(address: str) -> SplitResult | None:
    """Split an address; None if it has no host, an odd one, or a port that is none."""
    try:
        parts = urlsplit(address)
        _ = parts.port  # read now, as a port that is none is found only then
    except ValueError:
        return None
    return parts if PLAIN.fullmatch(parts.hostname or "") else None


def _in_digits(host: str | None) -> bool:
    """Tell whether a host is an address in digits, which nobody can make point elsewhere."""
    try:
        ipaddress.ip_address(host or "")
    except ValueError:
        return False
    return True


def _own_names() -> tuple[str, ...]:
    """Return what this machine calls itself, plain and as its neighbours find it."""
    name = socket.gethostname().lower()
    return (name, f"{name}.local")
