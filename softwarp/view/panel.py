"""What a viewer's user sets and reads: a column of sliders, buttons and numbers beside the picture."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

HAND = "by hand"
_OUTCOMES = ("action_mask", "distance", "success", "world_status")  # no observations
COLORS = ("plain", "stress", "strain", "contact")
NOTHING = "nothing"
_KEPT = 300  # actions that the plot shows
_SECONDS: Any = {"x": {"time": False}}  # not a date
_STROKES = ("#2a7f8e", "#c2452d", "#6b4fa0", "#b8860b", "#3d7a3d", "#a03d73", "#4d6fb3", "#7a6a58")
_MOST_SLIDERS = 64


class Panel:
    """Controls of a running environment; what users set is read by the viewer's loop, from its own thread.

    Args:
        server: A ``viser.ViserServer``.
        env: The environment.
        drivers: Names of what may choose actions besides the user; the first one does at the start.
        seed: Of the first episode.
        speed: Simulated time over that of the clock.
        has_chambers: Whether there is something to see in the bodies.
        has_contacts: Whether bodies can touch.
        has_nodes: Whether there is a soft body to pull.
    """

    def __init__(
        self,
        server: Any,
        env: Any,
        drivers: list[str],
        *,
        seed: int,
        speed: float,
        has_chambers: bool,
        has_contacts: bool,
        has_nodes: bool,
    ) -> None:
        gui = server.gui
        self.steps_asked = 0
        self.resets_asked = 0
        self._env = env
        with gui.add_folder("run"):
            self._told = gui.add_markdown("starting")
            self._paused = gui.add_checkbox("pause", initial_value=False)
            gui.add_button("single step", hint="one action, then pause").on_click(lambda _: self._ask_step())
            gui.add_button("reset", hint="a new episode in every world").on_click(lambda _: self._ask_reset())
            self._seed = gui.add_number("seed", seed, min=0, step=1, hint="of the episode that reset begins")
            self._speed = gui.add_slider("speed", 0.1, 4.0, 0.1, min(max(speed, 0.1), 4.0), hint="1: real time")
            self._goes_on = gui.add_checkbox("new episode at the end", initial_value=True)
        with gui.add_folder("actions"):
            self._driver = gui.add_dropdown("chosen", [*drivers, HAND], initial_value=[*drivers, HAND][0])
            self._choice, self._sliders = self._add_actions(gui)
            for control in [*self._sliders, *([] if self._choice is None else [self._choice])]:
                control.on_update(self._moved)
        with gui.add_folder("show"):
            colors = COLORS if has_nodes and has_contacts else COLORS[:-1] if has_nodes else COLORS[:1]
            self._color = gui.add_dropdown("colour", colors, visible=has_nodes)
            self._chambers = gui.add_checkbox("chambers", initial_value=False, visible=has_chambers)
            self._contacts = gui.add_checkbox("contact forces", initial_value=False, visible=has_contacts)
            self._pull = gui.add_slider(
                "pull [N/m]",
                1.0,
                500.0,
                1.0,
                20.0,
                visible=has_nodes,
                hint="stiffness of the spring between a soft body and the pointer: drag it with shift held",
            )
        with gui.add_folder("plot", expand_by_default=False):
            data = (np.zeros(1), np.zeros(1))
            self._plots = [
                gui.add_uplot(
                    data,
                    ({"label": "s"}, {"label": name, "width": 2, "stroke": _STROKES[0]}),
                    title=f"{name}, world 0",
                    scales=_SECONDS,
                    height=130,
                )
                for name in ("reward", "distance")
            ]
            self._sources = _sources(env)
            self._plotted = gui.add_dropdown("sensor", [NOTHING, *self._sources], hint="or observation, of world 0")
            lines = [{"label": str(number), "width": 2, "stroke": stroke} for number, stroke in enumerate(_STROKES)]
            blank = (np.zeros(1),) * (1 + len(_STROKES))
            self._sensor = gui.add_uplot(
                blank, ({"label": "s"}, *lines), title="sensor", scales=_SECONDS, height=150, visible=False
            )
        self._history: list[tuple[float, float, float]] = []
        self._seen: list[tuple[float, ...]] = []
        self._seen_of = NOTHING

    def _add_actions(self, gui: Any) -> tuple[Any, list[Any]]:
        """A choice of discrete actions, or a slider for each continuous one."""
        count = self._env.action_count
        if count:
            names = _names(self._env, count)
            return gui.add_dropdown("action", [f"{number}: {name}" for number, name in enumerate(names)]), []
        spec = self._env.action_spec.space
        low, high = spec.low.reshape(self._env.num_worlds, -1)[0], spec.high.reshape(self._env.num_worlds, -1)[0]
        names = _names(self._env, len(low))
        sliders = [
            gui.add_slider(name, float(a), float(b), (float(b) - float(a)) / 200.0, min(max(0.0, float(a)), float(b)))
            for name, a, b in list(zip(names, low, high, strict=True))[:_MOST_SLIDERS]
        ]
        return None, sliders

    @property
    def paused(self) -> bool:
        """Whether time stands still."""
        return bool(self._paused.value)

    @property
    def driver(self) -> str:
        """Who chooses actions."""
        return str(self._driver.value)

    @property
    def seed(self) -> int:
        """Of the episode that a reset begins."""
        return max(0, int(self._seed.value))

    @property
    def speed(self) -> float:
        """Simulated time over that of the clock."""
        return float(self._speed.value)

    @property
    def goes_on(self) -> bool:
        """Whether a new episode begins where one ends."""
        return bool(self._goes_on.value)

    @property
    def color(self) -> str:
        """What soft bodies are coloured by: ``plain``, ``stress``, ``strain`` or ``contact``."""
        return str(self._color.value)

    @property
    def shows_chambers(self) -> bool:
        """Whether bodies are to be seen through."""
        return bool(self._chambers.value)

    @property
    def shows_contacts(self) -> bool:
        """Whether contact forces are to be drawn."""
        return bool(self._contacts.value)

    @property
    def pull_stiffness(self) -> float:
        """Of the spring that a user pulls with [N/m]."""
        return float(self._pull.value)

    def action(self) -> Tensor:
        """What the user chose, for all worlds."""
        worlds, device = self._env.num_worlds, self._env.device
        if self._choice is not None:
            chosen = self._choice.options.index(self._choice.value)
            return torch.full((worlds,), chosen, dtype=torch.int64, device=device)
        values = torch.zeros(self._env.action_size, device=device)
        for number, slider in enumerate(self._sliders):
            values[number] = float(slider.value)
        return values.expand(worlds, -1).clone()

    def show_action(self, action: Tensor) -> None:
        """Let the sliders follow the first world's action that somebody else chose."""
        if self._choice is not None:
            self._choice.value = self._choice.options[int(action.reshape(-1)[0])]
            return
        for slider, value in zip(self._sliders, action[0].tolist(), strict=False):
            slider.value = min(max(value, slider.min), slider.max)

    def note(self, time: float, reward: float, distance: float, observed: Any) -> None:
        """Add an action's outcome in world 0 to the plots.

        Args:
            time: Simulated [s].
            reward: Of the action.
            distance: To the goal.
            observed: What the environment told, by key.
        """
        self._history = [*self._history[1 - _KEPT :], (time, reward, distance)]
        name = str(self._plotted.value)
        if name != self._seen_of:
            self._seen, self._seen_of = [], name
        if name in self._sources:
            values = self._sources[name](observed)[0].reshape(-1)[: len(_STROKES)]
            self._seen = [*self._seen[1 - _KEPT :], (time, *map(float, values.tolist()))]

    def forget(self) -> None:
        """Begin new plots."""
        self._history, self._seen = [], []

    def _moved(self, event: Any) -> None:
        """Whoever moves a slider in a browser chooses actions from now on; policies move them, too."""
        if event.client_id is not None:
            self.take_over()

    def take_over(self) -> None:
        """Let the user choose actions from now on."""
        self._driver.value = HAND

    def tell(self, text: str) -> None:
        """Renew the text and the plots."""
        self._told.content = text
        if len(self._history) > 1:
            time, *series = np.array(self._history).T
            for plot, values in zip(self._plots, series, strict=True):
                plot.data = (time, np.nan_to_num(values))
        self._plot_sensor()

    def _plot_sensor(self) -> None:
        """The plot of what is chosen: as many lines as it has numbers, the others without points."""
        self._sensor.visible = len(self._seen) > 1
        if self._sensor.visible:
            time, *series = np.array(self._seen).T
            self._sensor.title = f"{self._seen_of}, world 0"
            blank = [np.full(len(time), np.nan)] * (len(_STROKES) - len(series))
            self._sensor.data = (time, *map(np.nan_to_num, series), *blank)

    def _ask_step(self) -> None:
        self._paused.value = True
        self.steps_asked += 1

    def _ask_reset(self) -> None:
        self.resets_asked += 1


def _names(env: Any, count: int) -> list[str]:
    """A name per entry of an action or per choice: the environment's, or of cables or chambers, if there are as many.

    Raises:
        ValueError: Where the environment names another number.
    """
    model, given = env.sim.model, env.action_names()
    if given and len(given) != count:
        raise ValueError(f"{type(env).__name__}.action_names() gives {len(given)} names; its actions have {count}")
    for names in (given, model.cable_names, model.cavity_names):
        if len(names) == count:
            return [str(name) for name in names]
    return [f"action {number}" for number in range(count)]


def _sources(env: Any) -> dict[str, Callable[[Any], Tensor]]:
    """What can be plotted by name, (world, k): all sensors that the scene can have, then the observations."""
    found: dict[str, Callable[[Any], Tensor]] = {
        name: functools.partial(_sensed, read) for name, read in env.readings().items()
    }
    keys = [str(key) for key in env.observation_spec]
    found.update({key: operator.itemgetter(key) for key in keys if key not in found and key not in _OUTCOMES})
    return found


def _sensed(read: Callable[[], Tensor], _: Any) -> Tensor:
    return read()
