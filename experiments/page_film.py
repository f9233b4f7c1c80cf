"""Film and picture of ``softwarp view`` as a user sees it: ``python -m experiments.page_film docs/images/view``.

Writes ``view.gif`` and ``view.png`` with a mouse of its own in a browser without a window (``experiments/browser.py``):
the hand-written policy drives, a slider is taken over, inverse control follows a goal that is dragged, the robot is
pulled and coloured by stress. The viewer's clock stands still while a picture is drawn and taken, so the film shows
real time however slow the machine is; it takes some minutes.
"""

from __future__ import annotations

import argparse
import io
import math
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from softwarp.envs import registry
from softwarp.render import write_png, write_video
from softwarp.view import Viewer, window
from softwarp.view import viewer as viewers

from . import browser
from .view import drivers

NAME, SEED = "Trunk", 3
WIDTH, HEIGHT = 880, 560
SHOWN = (660, 420)
FRAMES_PER_SECOND = 6.0
PATIENCE = 300_000.0  # ms

HARMLESS = "Unable to preventDefault inside passive event listener invocation."  # of the slider's library

# A mouse to be seen, which pictures of pages leave out.
MOUSE = """
const mouse = document.createElement("div");
mouse.style.cssText = "position:fixed;z-index:99999;pointer-events:none;width:18px;height:18px;border-radius:50%;" +
    "margin:-9px 0 0 -9px;border:2px solid #333;background:rgba(255,200,0,0.5);left:-50px;top:-50px";
document.body.append(mouse);
addEventListener("pointermove", at => {
    mouse.style.left = at.clientX + "px"; mouse.style.top = at.clientY + "px";
}, true);
addEventListener("pointerdown", () => { mouse.style.background = "rgba(255,80,0,0.9)"; }, true);
addEventListener("pointerup", () => { mouse.style.background = "rgba(255,200,0,0.5)"; }, true);
"""


class Clock:
    """Time that passes while somebody sleeps, and only then."""

    def __init__(self) -> None:
        self._now = 0.0

    def monotonic(self) -> float:
        """Seconds that were slept."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self._now += max(seconds, 0.0)


class Operator:
    """A user of the page, as slow as people are, who is filmed.

    Args:
        page: Of Playwright's.
        viewer: What it shows.
    """

    def __init__(self, page: Any, viewer: Viewer) -> None:
        self.page, self._viewer = page, viewer
        self._at = (0.3 * WIDTH, 0.8 * HEIGHT)
        self.frames: list[NDArray[np.uint8]] = []

    def tick(self) -> None:
        """Let the viewer go on until the next frame, and take it."""
        self._viewer.run(1.0 / FRAMES_PER_SECOND)
        before = self.page.evaluate("window.drawn")
        self.page.wait_for_timeout(50)
        for _ in range(20):
            if self.page.evaluate("window.drawn") > before:
                break
            self.page.wait_for_timeout(50)
        picture = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
        self.frames.append(np.asarray(picture.resize(SHOWN, Image.Resampling.LANCZOS)))

    def wait(self, seconds: float) -> None:
        """Watch, for so long."""
        for _ in range(round(seconds * FRAMES_PER_SECOND)):
            self.tick()

    def go(self, x: float, y: float, seconds: float = 0.4) -> None:
        """Move the mouse there in a straight line, slowly at both ends."""
        start, steps = self._at, max(2, round(seconds * FRAMES_PER_SECOND))
        for part in 0.5 - 0.5 * np.cos(np.pi * np.arange(1, steps + 1) / steps):
            self.page.mouse.move(start[0] + part * (x - start[0]), start[1] + part * (y - start[1]))
            self.tick()
        self._at = (x, y)

    def drag(self, *places: tuple[float, float], seconds: float = 0.8, key: str = "") -> None:
        """Take hold of what is at the first place, and lead it over the others."""
        self.go(*places[0])
        if key:
            self.page.keyboard.down(key)
        self.page.mouse.down()
        for place in places[1:]:
            self.go(*place, seconds=seconds)
            self.wait(0.3)
        self.page.mouse.up()
        if key:
            self.page.keyboard.up(key)

    def press(self, place: tuple[float, float]) -> None:
        """Click there."""
        self.go(*place)
        self.page.mouse.down()
        self.wait(0.1)
        self.page.mouse.up()

    def middle(self, thing: Any) -> tuple[float, float]:
        """Of an element of the page."""
        box = thing.bounding_box()
        return box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]

    def named(self, label: str) -> Any:
        """What a text of the panel belongs to."""
        name = self.page.get_by_text(label, exact=True).get_attribute("for")
        return self.page.locator(f'[id="{name}"]')

    def choose(self, label: str, option: str) -> None:
        """An entry of a list by the text beside it."""
        self.press(self.middle(self.named(label)))
        self.wait(0.2)
        self.press(self.middle(self.page.get_by_role("option", name=option, exact=True)))

    def slide(self, label: str, *parts: float) -> None:
        """A slider by its name, to parts of its length."""
        row = self.named(label)
        start = self.middle(row.get_by_role("slider"))
        box = row.locator(".mantine-Slider-track").bounding_box()
        places = [(box["x"] + part * box["width"], start[1]) for part in parts]
        self.drag(start, *places)

    def place(self, point: ArrayLike) -> tuple[float, float]:
        """Where a point of the scene is seen on the page."""
        camera = next(iter(self._viewer._server.get_clients().values())).camera
        box = self.page.locator("canvas").first.bounding_box()
        eye = np.asarray(camera.position)
        ahead = _unit(np.asarray(camera.look_at) - eye)
        right = _unit(np.cross(ahead, np.asarray(camera.up_direction)))
        up = np.cross(right, ahead)
        away = np.asarray(point, dtype=np.float64) - eye
        scale = 0.5 * box["height"] / (math.tan(0.5 * camera.fov) * (away @ ahead))
        across, above = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
        return float(across + scale * (away @ right)), float(above - scale * (away @ up))


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / np.linalg.norm(vector))


def perform(user: Operator, viewer: Viewer) -> None:
    """What the film shows."""
    env, size = viewer.env, viewer.stage.size
    user.wait(1.0)
    user.slide("long_0", 0.9, 0.5)
    user.slide("long_1", 0.1)
    user.wait(0.4)
    user.choose("chosen", "inverse")
    user.wait(0.5)
    goal = env.goal_points()[0].cpu().numpy().astype(np.float64)
    for axis, shift in ((2, 0.2), (1, 0.1)):
        arm = np.eye(3)[axis] * size
        grip = goal + 0.1 * arm
        user.drag(user.place(grip), user.place(grip + shift * arm), seconds=1.2)
        goal = goal + shift * arm
        user.wait(0.6)
    tip = env.tip()[0].cpu().numpy().astype(np.float64)
    start = user.place(tip)
    user.drag(start, (start[0] + 120, start[1] - 60), (start[0] + 60, start[1] + 60), key="Shift")
    user.wait(0.4)
    user.press(user.middle(user.page.get_by_text("run", exact=True)))  # which makes room for what is below
    user.wait(0.5)
    user.choose("colour", "stress")
    user.wait(1.6)


def film(viewer: Viewer) -> list[NDArray[np.uint8]]:
    """Pictures of the page."""
    errors: list[str] = []
    with browser.chromium() as program:
        page = browser.opened(program, viewer.url, WIDTH, HEIGHT, errors)
        page.set_default_timeout(PATIENCE)
        page.evaluate(MOUSE)
        page.wait_for_timeout(5000)  # until all is there
        page.locator(".mantine-Notification-closeButton").click()  # what viser says about drawing in software
        page.wait_for_timeout(1000)
        user = Operator(page, viewer)
        perform(user, viewer)
    if set(errors) - {HARMLESS}:
        raise RuntimeError(f"the page told errors: {errors}")
    return user.frames


def main() -> None:
    """Write film and picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", type=Path, help="of the files, without ending")
    given = parser.parse_args()
    env = registry.make(NAME, num_worlds=1, seed=SEED)
    clock = Clock()
    with patch.object(window, "time", clock), patch.object(viewers, "time", clock):
        with Viewer(env, drivers(env, NAME, ""), seed=SEED) as viewer:
            viewer.panel._goes_on.value = False
            frames = film(viewer)
    write_video(given.path.with_suffix(".gif"), frames, FRAMES_PER_SECOND)
    write_png(given.path.with_suffix(".png"), frames[len(frames) // 2])
    print(f"{len(frames)} frames")


if __name__ == "__main__":
    main()
