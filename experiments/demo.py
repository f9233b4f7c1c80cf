"""``softwarp demo``: the whole way in some minutes - train the trunk, test it, film it, export it.

Settings are in ``hydra_configs/experiment/demo.yaml``. Run again after an interruption, it goes on where it stopped.
"""

import dataclasses
import importlib.util
import os
import sys
from pathlib import Path

from . import eval as evaluation
from . import export, render, shown, train
from .config import TrainConfig, compose


def main(out: str, minutes: float | None, overrides: list[str]) -> int:
    """Run all steps.

    Args:
        out: Folder for everything that is made.
        minutes: Training time; None keeps the setting's.
        overrides: Further settings of ``softwarp train``.

    Returns:
        Exit code.
    """
    folder = Path(out)
    run = folder / "run"
    if minutes is not None:
        overrides = [*overrides, f"time_limit={60.0 * minutes}"]
    if any((run / "checkpoints").glob("step_*.pt")):
        print(f"1/4 training: going on with {run}")
        code = train.main(overrides, resume=str(run))
    else:
        config: TrainConfig = compose("train", TrainConfig, ["experiment=demo", *overrides])
        config.out = str(run)
        print(f"1/4 training {config.env['name']}, {config.num_worlds} worlds, {config.time_limit / 60.0:.1f} minutes")
        code = train.run(config)
    if code:
        return code

    print("2/4 testing on unseen goals, beside policies that learned nothing")
    trained = evaluation.load_run(str(run), device="cpu", overrides=[])
    settings = evaluation.EvalConfig(run=str(run), episodes=32, baselines=True, json=str(folder / "evaluation.json"))
    evaluation.report(trained, settings)

    print("3/4 drawing")
    video = folder / ("reach.mp4" if importlib.util.find_spec("av") else "reach.gif")
    picture = render.RenderConfig(run=str(run), out=str(folder / "reach.png"))
    env, trajectory = shown.record(picture, [], stress=True)
    render.draw(env, trajectory, picture)
    render.draw(env, trajectory, dataclasses.replace(picture, out=str(video)))

    print("4/4 exporting")
    export.write(trajectory, str(folder / "reach.usdc"))
    made = {
        "policy": run / "best.pt",
        "learning curve": run / "curve.png",
        "evaluation": folder / "evaluation.json",
        "pictures": folder / "reach.png",
        "film": video,
        "USD scene": folder / "reach.usdc",
    }
    for name, path in made.items():
        print(f"  {name:<16}{path}")
    typed = sys.argv[0] if os.sep in sys.argv[0] else "softwarp"  # from this folder
    command = "python -m softwarp" if typed.endswith("__main__.py") else typed
    print("next:")
    for told in (f"train --resume {run} time_limit=600", f"render {run} four.gif worlds=4", "list", "new my_robot"):
        print(f"  {command} {told}")
    return 0
