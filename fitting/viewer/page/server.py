"""Opens the page: an address, a title, light from above."""

import contextlib
import functools
import io
import re
import socket
from collections.abc import Iterator

import viser
from websockets.asyncio import server as asyncio_server

ANY_PORT = 0
OWN = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Origins of pages that this machine serves."""


def open_server(
    host: str, port: int, title: str, *, own_pages_only: bool = True
) -> viser.ViserServer:
    """A page without anything on it; the next free port is taken where this one is in use.

    Args:
        host: the address on which to listen.
        port: 0 for any that is free.
        title: of the page.
        own_pages_only: whether pages that other machines serve cannot connect to it.

    Raises:
        ValueError: there is no such address here.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host, ANY_PORT), family=family):
            pass
    except (OSError, UnicodeError) as error:
        raise ValueError(f"--host {host}: no address of this machine: {error}") from None
    with _silenced(), _origins(OWN if own_pages_only else None):
        server = viser.ViserServer(host, port, title, verbose=False)
    server.request_share_url = lambda *_, **__: None  # no client opens a tunnel to this machine
    server.gui.configure_theme(
        control_width="large",
        show_logo=False,
        show_share_button=False,
        brand_color=(0, 114, 178),
    )
    server.gui.main_panel.dock_right()
    server.scene.set_up_direction("+y")
    server.scene.configure_default_lights(cast_shadow=False)  # slow without a graphics card
    return server


@contextlib.contextmanager
def _origins(wanted: re.Pattern[str] | None) -> Iterator[None]:
    """Servers made meanwhile take no connection from pages of other origins, if some are wanted.

    Browsers let any page connect to a server on this machine; viser does not ask which one it is.
    """
    serve = asyncio_server.serve
    if wanted is not None:
        asyncio_server.serve = functools.partial(serve, origins=[wanted, None])
    try:
        yield
    finally:
        asyncio_server.serve = serve


def address(server: viser.ViserServer) -> str:
    """What to open in a browser."""
    host = server.get_host()
    shown = "localhost" if host in ("0.0.0.0", "::") else host
    return f"http://{f'[{shown}]' if ':' in shown else shown}:{server.get_port()}"


def stop(server: viser.ViserServer) -> None:
    """Closes the page."""
    with _silenced():
        server.stop()


def _silenced() -> contextlib.redirect_stdout[io.StringIO]:
    """Without what viser prints of itself."""
    return contextlib.redirect_stdout(io.StringIO())
