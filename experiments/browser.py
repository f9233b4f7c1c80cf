"""A Chromium without a window, for films and measurements of pages: drawn in software, as on machines without a GPU."""

from __future__ import annotations

import contextlib
import importlib
import shutil
from collections.abc import Iterator
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")

# Counts the frames in which a page has drawn with WebGL, as ``window.drawn``.
COUNTING = """
window.drawn = 0;
let hasDrawn = false;
for (const name of ["drawElements", "drawArrays", "drawElementsInstanced"]) {
    const draw = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...words) { hasDrawn = true; return draw.apply(this, words); };
}
const count = () => { window.drawn += hasDrawn ? 1 : 0; hasDrawn = false; requestAnimationFrame(count); };
requestAnimationFrame(count);
"""


def path() -> str | None:
    """Of the browser's program, if there is one."""
    return next((found for found in map(shutil.which, NAMES) if found), None)


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """A browser of Playwright's; it ends with the block.

    Raises:
        ImportError: Without Playwright.
        FileNotFoundError: Without a Chromium.
    """
    if path() is None:
        raise FileNotFoundError(f"no browser: none of {', '.join(NAMES)} is installed; apt install chromium")
    try:
        playwright = importlib.import_module("playwright.sync_api")
    except ImportError as error:
        raise ImportError(
            "this needs the package playwright, which is not installed; pip install playwright"
        ) from error
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path(), args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


def opened(browser: Any, url: str, width: int, height: int, errors: list[str]) -> Any:
    """A page that shows a scene.

    Args:
        browser: That of ``chromium``.
        url: Address.
        width: Of the page [pixels].
        height: Of the page [pixels].
        errors: What the page tells is added to it.
    """
    page = browser.new_page(viewport={"width": width, "height": height})
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
    page.add_init_script(COUNTING)
    page.goto(url)
    page.wait_for_selector("canvas", state="attached", timeout=60000)
    return page
