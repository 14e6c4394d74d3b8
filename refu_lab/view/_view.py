"""What `refu view` does: opens the inputs, serves the scene, plays until it is interrupted."""

from __future__ import annotations

import contextlib
import io
import os
import re
import socket
import sys
import webbrowser
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from refu_core import RefuError
from refu_core._device import one_thread
from refu_core.errors import printable
from refu_core.recordings import SUFFIXES
from refu_lab.commands.view import ViewOptions
from refu_lab.view._dressed import DressedFilm
from refu_lab.view._live import TOPICS, LiveFilm
from refu_lab.view._recorded import RecordedFilm, has_meshes

if TYPE_CHECKING:
    import viser

DEFAULT_PORT = 8080


@one_thread()
def view(
    options: ViewOptions,
    *,
    progress: bool = False,
    say: Callable[[str], None] = print,
    until: Callable[[], bool] = lambda: False,
) -> None:
    """Shows the inputs until it is interrupted (Ctrl-C), or until `until` returns true.

    Raises `RefuError` for inputs that can't be shown, for a port that is taken, and if viser isn't installed.
    """
    if find_spec("viser") is None:
        raise RefuError('the viewer needs viser: pip install "refu-ros[view]"')
    film = open_film(options, progress=progress)
    with contextlib.ExitStack() as opened:
        if not isinstance(film, DressedFilm):
            opened.callback(film.close)
        for note in film.notes:
            say(printable(f"warning: {note}"))
        server = _serve(options)
        opened.callback(_stop, server)
        try:
            _play(film, server, options, say, until)
        except KeyboardInterrupt:
            say("viewer closed")


def _play(
    film: DressedFilm | RecordedFilm | LiveFilm,
    server: viser.ViserServer,
    options: ViewOptions,
    say: Callable[[str], None],
    until: Callable[[], bool],
) -> None:
    from refu_lab.view._player import Player

    if isinstance(film, LiveFilm):
        say(f"{film.title}: waiting for garments")
        if not film.wait(until):
            return
    player = Player(server, film)
    host = "localhost" if options.host in ("0.0.0.0", "::") else options.host
    url = f"http://{host}:{server.get_port()}"
    what = "" if isinstance(film, LiveFilm) else f": {len(film.times)} frames"
    say(f"{film.title}{what} at {url} (Ctrl-C ends it)")
    has_display = sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if options.browser and has_display:  # without one, some browsers open in the terminal
        webbrowser.open(url)
    player.run(until=until)


def open_film(options: ViewOptions, *, progress: bool = False) -> DressedFilm | RecordedFilm | LiveFilm:
    """The film of the inputs: a bag of garments is shown as it is, motion is dressed. Raises `RefuError`."""
    if (options.live is None) == (not options.inputs):
        raise RefuError("wanted either recordings to look at or --live, for a node that runs")
    if options.live is not None:
        return LiveFilm(options.live or TOPICS)
    first = options.inputs[0]
    names_motion = options.dressing.topic is not None or options.dressing.input_type is not None
    if not (options.dress or names_motion or first.suffix.lower() in SUFFIXES) and has_meshes(first):
        if len(options.inputs) > 1:
            raise RefuError(f"{first}: has garments, and is shown alone; --dress dresses the motion of several")
        return RecordedFilm(first, progress=progress)
    return DressedFilm(options.inputs, options.dressing)


def _serve(options: ViewOptions) -> viser.ViserServer:
    """A server at the requested port, or at the first free one."""
    import viser

    # viser itself would take the next free port, and wait forever where there is none.
    if not _is_free(options.host, options.port or 0):
        where = options.host if options.port is None else f"{options.host}:{options.port}"
        raise RefuError(f"{where} can't be listened on: it is taken, or no address of this machine (--port, --host)")
    with contextlib.redirect_stdout(io.StringIO()), _own_pages_only(options.host):  # it prints a banner
        server = viser.ViserServer(host=options.host, port=options.port or DEFAULT_PORT, verbose=False)
    _hear_values_only(server)
    return server


def _hear_values_only(server: viser.ViserServer) -> None:
    """Has the server hear nothing of its clients but which values the panel's controls have.

    For whoever connects, viser would also put the scene on the web, take in files of any size as a control's value, and
    set whatever else belongs to a control.
    """
    from viser._messages import GuiUpdateMessage

    handlers = server._websock_server._incoming_handlers
    (update,) = handlers[GuiUpdateMessage]

    async def take(client: Any, message: Any) -> None:
        if message.updates.keys() == {"value"}:
            await update(client, message)

    handlers.clear()
    handlers[GuiUpdateMessage] = [take]


@contextlib.contextmanager
def _own_pages_only(host: str) -> Iterator[None]:
    """Lets servers that begin in the block serve no page of another site, if they listen on this machine alone.

    Browsers let any page of the web connect to a websocket on `localhost`, and viser serves whoever connects.
    """
    from websockets.asyncio import server

    serve, here = server.serve, re.compile(rf"https?://(localhost|127\.0\.0\.1|\[::1\]|{re.escape(host)})(:\d+)?")
    if host not in ("0.0.0.0", "::"):
        server.serve = partial(serve, origins=[None, here])  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]


def _stop(server: viser.ViserServer) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _is_free(host: str, port: int) -> bool:
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        with socket.socket(found[0][0], socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(found[0][4])
    except OSError:
        return False
    return True
