"""``softwarp demo``: the whole way in some minutes - train the trunk, test it, film it, export it.

Settings are in ``hydra_configs/experiment/demo.yaml``. Run again after an interruption, it goes on where it stopped.
"""

import importlib.util
from pathlib import Path

from . import eval as evaluation
from . import export, render, train
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
    frames, period = render.film(trained, render.RenderConfig(worlds=1))
    render.write(frames, str(folder / "reach.png"), fps=0, count=6)
    render.write(frames, str(video), fps=round(1.0 / period), count=0)

    print("4/4 exporting")
    export.write(export.record(trained, export.ExportConfig(worlds=1)), str(folder / "reach.usdc"))
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
    return 0
