"""Plays a film: a clock, a panel, and the choice of shapes to show."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from refu_core import RefuError
from refu_core.errors import printable
from refu_core.modes import SdfMode
from refu_lab.view._dressed import DressedFilm
from refu_lab.view._film import BODY, SKIN, SceneMesh
from refu_lab.view._live import LiveFilm
from refu_lab.view._marks import CLEARANCE, Band, BandFinder, Marking
from refu_lab.view._recorded import RecordedFilm
from refu_lab.view._stage import Stage

if TYPE_CHECKING:
    import viser

_SPEEDS = {"¼ ×": 0.25, "½ ×": 0.5, "1 ×": 1.0, "2 ×": 2.0, "4 ×": 4.0}
_HIDDEN = "hidden"
_BODIES = {"collider": BODY, "skin": SKIN, _HIDDEN: ""}
_GROUND_FRAMES = 5
"""Number of frames whose lowest point sets the ground."""
_IDLE_S = 0.5
"""How often an idle player checks whether to end [s]."""


class Player:
    """One film on one server. The thread in `run` does what the panel's callbacks ask for."""

    def __init__(self, server: viser.ViserServer, film: DressedFilm | RecordedFilm | LiveFilm) -> None:
        self._server, self._film = server, film
        self._stage, self._finder = Stage(server), BandFinder()
        self._times = film.times
        self._moment, self._index = 0.0, 0
        self._playing = len(self._times) > 1
        self._changed = threading.Event()
        self._seek: int | None = None
        self._failed = ""
        self._refused: tuple[tuple[str, ...], str] | None = None
        picked = np.unique(np.linspace(0, len(self._times) - 1, _GROUND_FRAMES).astype(int))
        lowest = [float(shape.vertices[:, 2].min()) for i in picked for shape in film.shapes(int(i))]
        first = film.shapes(0)
        self._stage.set(first, ground=min(lowest, default=0.0), front=film.front)
        self._build(first)
        self._show(0)
        if isinstance(film, LiveFilm):
            film.told = self._changed.set

    def run(self, *, until: Callable[[], bool] = lambda: False) -> None:
        """Plays until an interrupt, or until `until`, asked after each frame, returns true."""
        last = time.monotonic()
        while not until():
            now = time.monotonic()
            past, last = now - last, now
            if asked := self._changed.is_set():
                self._changed.clear()
                self._rewear()
            seek, self._seek = self._seek, None
            index = self._index if seek is None else seek
            if seek is not None:
                self._moment = float(self._times[seek])
            elif self._playing:
                self._moment += past * self._pace
                if self._moment >= self._length:
                    self._moment %= self._length
                index = int(np.searchsorted(self._times, self._moment, side="right")) - 1
            if asked or index != self._index:
                self._show(index)
                last = max(last, time.monotonic() - 1.0)  # don't leap ahead after a slow frame
            self._changed.wait(self._pause())

    def _pause(self) -> float:
        """Time until the next frame is due [s]."""
        if not self._playing:
            return _IDLE_S
        following = self._times[self._index + 1] if self._index + 1 < len(self._times) else self._length
        return float(np.clip((following - self._moment) / self._pace, 0.001, _IDLE_S))

    @property
    def _pace(self) -> float:
        """How fast the film plays. As everywhere here, what a client sends need not be one of the choices."""
        return _SPEEDS.get(self._speed.value, 1.0)

    @property
    def _length(self) -> float:
        """Length of the film, with the last frame shown as long as the others on average [s]."""
        steps = len(self._times) - 1
        return float(self._times[-1]) * (steps + 1) / steps if steps and self._times[-1] > 0 else 1.0

    # ---- what is shown -----------------------------------------------------------------------------------------------

    def _show(self, index: int) -> None:
        self._index = index
        try:
            shapes = self._film.shapes(index)
            bands = self._bands(shapes)
        except RefuError as error:
            self._tell(str(error))
            return
        if self._follows.value:
            person = shapes[0].person if shapes else ""
            self._stage.follow([shape for shape in shapes if shape.person == person])
        self._stage.draw(bands, wireframe=self._wire.value)
        if len(self._times) > 1:
            self._frame.value = index
        facts = self._film.facts(index)
        if not isinstance(self._film, LiveFilm):
            facts = [f"frame {index} of {len(self._times)}, {self._times[index]:.2f} s", *facts]
        self._said.content = "  \n".join(facts)

    def _bands(self, shapes: Sequence[SceneMesh]) -> list[tuple[SceneMesh, Sequence[Band]]]:
        shown = _BODIES.get(self._body.value)
        marking = next((one for one in Marking if one == self._marking.value), Marking.CLOTH)
        found: list[tuple[SceneMesh, Sequence[Band]]] = []
        for person in dict.fromkeys(shape.person for shape in shapes):
            own = [shape for shape in shapes if shape.person == person]
            garments = [shape for shape in own if shape.is_garment and self._is_shown(shape.name)]
            body = next((shape for shape in own if shape.name == BODY), None)
            found += zip(garments, self._finder.bands(marking, garments, body), strict=True)
            found += [(shape, [Band(shape.faces, shape.color)]) for shape in own if shape.name == shown]
        return found

    def _is_shown(self, garment: str) -> bool:
        box = self._boxes.get(garment)
        return box is None or isinstance(self._film, DressedFilm) or bool(box.value)

    def _rewear(self) -> None:
        """Changes garments or distance, if that was asked for."""
        film = self._film
        if not isinstance(film, DressedFilm):
            return
        wanted = tuple(name for name, box in self._boxes.items() if box.value)
        sdf = self._sdf.value
        if (set(wanted), sdf) == (set(film.garments), film.sdf) or (wanted, sdf) == self._refused:
            return
        if not wanted:
            self._tell("wear one garment at least")
        else:
            try:
                film.wear(wanted, sdf)
            except RefuError as error:
                self._tell(str(error))
                self._refused = wanted, sdf

    def _tell(self, what: str) -> None:
        """Notifies all connected clients, once."""
        if what != self._failed:
            self._failed = what
            for client in self._server.get_clients().values():
                client.add_notification("refu", printable(what), color="red", auto_close_seconds=8.0)

    # ---- the panel ---------------------------------------------------------------------------------------------------

    def _build(self, first: Sequence[SceneMesh]) -> None:
        gui, film = self._server.gui, self._film
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(44, 98, 150))
        gui.set_panel_label(f"refu view: {printable(film.title)}")
        names = list(dict.fromkeys(shape.name for shape in first if shape.is_garment))
        last = max(len(self._times) - 1, 1)
        is_live = isinstance(film, LiveFilm)  # it can't go back, and a body may come later
        with gui.add_folder("Play"):
            self._frame = gui.add_slider("frame", 0, last, 1, 0, disabled=len(self._times) < 2, visible=not is_live)
            self._button = gui.add_button(self._verb(), icon=None, visible=not is_live)
            self._speed = gui.add_dropdown("speed", tuple(_SPEEDS), initial_value="1 ×", visible=not is_live)
            self._follows = gui.add_checkbox("follow", initial_value=True, hint="the camera goes with the first person")
        with gui.add_folder("Show"):
            has_skin = any(shape.name == SKIN for shape in first)
            has_body = is_live or any(shape.name == BODY for shape in first)
            bodies = tuple(_BODIES) if has_skin else ("collider", _HIDDEN) if has_body else (_HIDDEN,)
            self._body = gui.add_dropdown("body", bodies, initial_value=bodies[0])
            markings = tuple(str(one) for one in Marking) if has_body else (str(Marking.CLOTH),)
            self._marking = gui.add_dropdown("colours", markings, initial_value=str(Marking.CLOTH))
            self._legend = gui.add_markdown(_legend(), visible=False)
            self._wire = gui.add_checkbox("wireframe", initial_value=False)
        with gui.add_folder("Wear"):
            is_dressed = isinstance(film, DressedFilm)
            wardrobe = film.wardrobe if isinstance(film, DressedFilm) else names
            self._boxes = {name: gui.add_checkbox(name, initial_value=name in names) for name in wardrobe}
            modes = tuple(str(mode) for mode in SdfMode)
            sdf = film.sdf if isinstance(film, DressedFilm) else modes[0]
            self._sdf = gui.add_dropdown("distance", modes, initial_value=sdf, visible=is_dressed)
        self._said = gui.add_markdown("")
        inputs = (self._speed, self._follows, self._body, self._marking, self._wire, self._sdf, *self._boxes.values())
        for one in inputs:
            one.on_update(self._ask)
        self._frame.on_update(self._sought)
        self._button.on_click(self._toggle)

    def _ask(self, _event: Any) -> None:
        self._legend.visible = self._marking.value == Marking.CLEARANCE
        self._failed = ""
        self._changed.set()

    def _sought(self, event: Any) -> None:
        if event.client is not None:  # a user moved it; the player's own changes trigger this, too
            self._seek = min(max(int(self._frame.value), 0), len(self._times) - 1)
            self._changed.set()

    def _toggle(self, _event: Any) -> None:
        self._playing = not self._playing and len(self._times) > 1
        self._button.label = self._verb()
        self._changed.set()

    def _verb(self) -> str:
        return "pause" if self._playing else "play"


def _legend() -> str:
    lines, below = [], 0.0
    for limit, color in CLEARANCE:
        shade = "#" + "".join(f"{round(255 * channel):02x}" for channel in color)
        what = f"{1e3 * below:g}–{1e3 * limit:g} mm" if limit < np.inf else f"> {1e3 * below:g} mm"
        what = what if limit > 0 else "inside"
        lines.append(f'<span style="color:{shade}">■</span> {what}')
        below = limit
    return "  \n".join(lines)
