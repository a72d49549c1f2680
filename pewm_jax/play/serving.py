"""Where the page is served: its address, who can reach it, and the browser."""

from __future__ import annotations

import contextlib
import io
import os
import socket
import sys
import webbrowser
from collections.abc import Callable

from pewm_jax.config import ConfigError, UserError
from pewm_jax.play import visitors
from pewm_jax.play.extra import viser
from pewm_jax.play.settings import LOOPBACK, Serve


def open_in_browser(url: str) -> bool:
    """Open a page where there is a desktop; tells whether one was asked."""
    desktop = sys.platform == "darwin" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    return desktop and webbrowser.open(url)


def warning(serve: Serve) -> str:
    """Return what a page means that others can reach; empty if only this machine can."""
    if serve.host in LOOPBACK:
        return ""
    return (
        f"Anyone who reaches this machine at {serve.host} can drive, and load and save worlds: "
        "there is no password."
    )


def here(host: str) -> str:
    """Return what this machine calls a host in an address."""
    if host in ("0.0.0.0", "::"):  # noqa: S104 - it is not served on here
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


def server(serve: Serve, say: Callable[[str], None] = lambda _: None) -> viser.ViserServer:
    """Begin to serve, without viser's own message, and to no page of another site.

    Args:
        serve: address, port and names.
        say: told who was refused, and why.

    Raises:
        ConfigError: the host is no address of this machine; viser would wait for it forever.
        UserError: a viser whose visitors cannot be asked where they come from.
    """
    try:
        kind, *_, address = socket.getaddrinfo(serve.host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(kind) as probe:
            probe.bind(address)
    except OSError as error:
        raise ConfigError(
            f"--host {serve.host} is no address that this machine can serve on ({error}); take "
            "127.0.0.1, or 0.0.0.0 to be reached by others."
        ) from None
    asked = visitors.asked(serve.host, serve.names, say)
    with contextlib.redirect_stdout(io.StringIO()), asked as asking:
        begun = viser.ViserServer(host=serve.host, port=serve.port, verbose=False)
        if not asking:
            begun.stop()
            raise UserError(
                f"viser {viser.__version__} serves in a way in which pages of other sites could "
                "drive here: pip install 'viser==1.1.1'."
            )
    return begun
