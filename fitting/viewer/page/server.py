"""Opens the page: an address, a title, light from above."""

import contextlib
import io
import socket

import viser

ANY_PORT = 0


def open_server(host: str, port: int, title: str) -> viser.ViserServer:
    """A page without anything on it; the next free port is taken where this one is in use.

    Args:
        host: the address on which to listen.
        port: 0 for any that is free.
        title: of the page.

    Raises:
        ValueError: there is no such address here.
    """
    try:
        with socket.create_server((host, ANY_PORT)):
            pass
    except (OSError, UnicodeError) as error:
        raise ValueError(f"--host {host}: no address of this machine: {error}") from None
    with _silenced():
        server = viser.ViserServer(host, port, title, verbose=False)
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
