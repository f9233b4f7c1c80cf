"""``softwarp export``: an episode as a USD scene, a recorded trajectory, or a page that plays in any browser."""

from pathlib import Path
from typing import Any

from softwarp.io.trajectory import Trajectory

from . import shown


def main(arguments: list[str], given: dict[str, Any]) -> int:
    """Export as the overrides say; returns the exit code.

    Args:
        arguments: Hydra overrides of ExportConfig, and of the run's environment (``env.youngs=300e3``).
        given: Fields of ExportConfig from the command line, taken literally.
    """
    config = shown.settings("export", arguments, given)
    write(shown.record(config, arguments, stress=config.stress)[1], config.out)
    print(f"{config.out}: written")
    return 0


def write(trajectory: Trajectory, path: str) -> None:
    """A USD scene, a page for .html, or the trajectory itself for .npz."""
    if Path(path).suffix.lower() == ".npz":
        trajectory.save(path)
        return
    if Path(path).suffix.lower() == ".html":
        from softwarp.view import write_html

        write_html(
            trajectory, path, color="plain" if trajectory.stress is None or not len(trajectory.triangles) else "stress"
        )
        return
    from softwarp.io.usd import export_usd

    export_usd(trajectory, path)
