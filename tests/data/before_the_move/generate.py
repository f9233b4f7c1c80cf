"""Wrote the files of this folder, at commit 737d275 of softwarp 0.1.0. They are kept as they are: do not run it again.

From the top of the repository: python -m tests.data.before_the_move.generate FOLDER
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from softwarp import cli
from softwarp.io.trajectory import Recorder
from softwarp.training.checkpoints import load_policy
from softwarp.training.demonstrations import Demonstrations
from tests.contract import test_old_files as old

SMALL = ["num_worlds=2", "network.hidden=[8]", "total_steps=64", "evaluations=1", "evaluation_episodes=2"]
SMALL += ["keep_checkpoints=1", "logger=csv", "logger.progress=false", "logger.picture=false"]
PPO = ["algo=ppo", "algo.horizon=16", "algo.minibatches=2", "algo.epochs=2"]
RUNS = {
    "ppo": PPO,
    "sac": ["env.action_kind=continuous", "algo=sac", "algo.batch=8", "algo.warmup_steps=16", "algo.capacity=48"],
    "memory": ["env.action_kind=continuous", *PPO, "network.recurrent=4"],
}
PLAN = ["plan", "env=cart_stem_contact", "env.max_episode_steps=3", "env.solver_path=scalar", "progress=false"]
TREE = ["planner=opd", "env.action_kind=discrete", "planner.expansions=8", "planner.batch=2"]
SEQUENCE = ["planner=cem", "planner.population=8", "planner.elites=2", "planner.expansions=32"]


def run(*arguments: str) -> None:
    """A command as typed, which must succeed; run folders tell it."""
    sys.argv = ["softwarp", *arguments]
    assert cli.main(arguments) == 0


def main() -> None:
    """Write all files into the folder that is named."""
    os.chdir(sys.argv[1])
    expected: dict[str, np.ndarray] = {}

    def keep(prefix: str, values: dict[str, np.ndarray]) -> None:
        expected.update({f"{prefix}/{name}": value for name, value in values.items()})

    sim = old.machine()
    old.command(sim)
    for _ in range(6):
        sim.step()
    sim.snapshot().save("machine.npz")
    keep("machine", old.seen(sim, old.MACHINE_VIEWS))
    recorder = Recorder(sim, contacts=True, name="machine")
    recorder.capture()
    for _ in range(3):
        sim.step()
        recorder.capture()
    keep("machine later", old.seen(sim, old.MACHINE_VIEWS))
    recorder.finish().save("film.npz")

    env = old.cart_stem()
    now = env.reset()
    for _ in range(2):
        now = env.step(now.set("action", 0.5 + env.action_spec.zero()))["next"]
    env.sim.snapshot().save("cart_stem.npz")
    keep("cart_stem", old.seen(env.sim, old.ENV_VIEWS))
    env.sim.step(5)
    keep("cart_stem later", old.seen(env.sim, old.ENV_VIEWS))

    for name, settings in RUNS.items():
        run("train", "env=cart_pole", *settings, *SMALL, f"out={name}")
        (Path(name) / ".lock").unlink()
        newest = max((Path(name) / "checkpoints").glob("step_*.pt"))
        for place, path in (("best", Path(name)), ("newest", newest)):
            content = load_policy(path)
            keep(f"{name}/{place}", {"chances": old.chances(content), "actions": old.acted(content)})
        with tempfile.TemporaryDirectory() as scratch:
            summary = old.evaluate(Path(name), Path(scratch) / "summary.json")
            keep(f"{name}/evaluation", {key: np.array(value) for key, value in summary.items()})
            copy = shutil.copytree(name, Path(scratch) / name)
            old.go_on(copy)
            keep(f"{name}/resumed", old.weights(copy))

    for name, settings in zip(old.PLANS, (TREE, SEQUENCE), strict=True):
        run(*PLAN, *settings, f"out={name}.json")
    run("record", "demonstrations.npz", "env=cart_stem", "env.action_kind=continuous", "episodes=2", "num_worlds=2")
    shown = Demonstrations.load(Path("demonstrations.npz"))
    keep("shown", {name: getattr(shown, name).numpy() for name in ("observation", "action", "returns", "success")})
    np.savez_compressed("expected.npz", **expected)


if __name__ == "__main__":
    main()
