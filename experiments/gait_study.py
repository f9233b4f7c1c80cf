"""Table 2 and figure 6 of SofaGym's paper: the quadruped's hand-made and learned gaits, on two models.

    python -m experiments.gait_study FOLDER                 # learns on the reduced model, three seeds, then compares
    python -m experiments.gait_study FOLDER --remember      # simulates each state once, and learns from memory
    python -m experiments.gait_study FOLDER --policies RUN  # compares trained ones
    python -m experiments.gait_study FOLDER --gaits 102414104053 --actions 12  # actions that gait_search has found
    python -m experiments.gait_study FOLDER --device cuda:0 --training num_worlds=512 total_steps=300000

PPO learns on MultiGaitReduced; what it learned and the paper's gait (fill rear, centre, front, then empty them in the
same order) then run on the reduced and on the full model from the same start, each policy taking its most likely
actions. Sequences of actions without a policy may stand beside them. ``table2.md``, ``gaits.json`` and ``figure6.png``
are written. Lengths are in millimetres: the paper calls its own cm, but its code counts millimetres. Six actions are
the paper's; SofaGym's training script of 2022 takes 18, three cycles (``--actions 18``).
"""

import argparse
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softwarp import notices
from softwarp.envs import registry
from softwarp.io.atomic import atomic_path, write_text
from softwarp.policies.baselines.multi_gait import multi_gait_baseline
from softwarp.training import loop
from softwarp.training.algorithms import make_algorithm
from softwarp.training.evaluation import run_episodes

from . import train
from .config import TrainConfig, compose, to_plain
from .eval import check_fit, load_run
from .gait_memory import Memory, Remembered, remember
from .gait_search import ROBOTS, SEED, at_rest

PRESET = "fast/multigaitreduced"
HAND = "hand-made"
THEIRS = {HAND: (5.38, 3.24, 3.56), "learned": (6.33, 4.51, 6.21)}  # return and way reduced, way full
LOOKS = 12  # places of every action that are kept


@dataclass(frozen=True)
class Walk:
    """One episode.

    Attributes:
        gait: Which policy.
        robot: "reduced" or "full".
        actions: What was done.
        way: Along x from the start, several times an action [mm].
        forward: Sum of what actions won, without what they lost [mm]: the paper's return.
        status: Worst of the world.
    """

    gait: str
    robot: str
    actions: tuple[int, ...]
    way: tuple[float, ...]
    forward: float
    status: int


@torch.no_grad()
def walk(gait: str, robot: str, env: Any, policy: Any, actions: int) -> Walk:
    """Let a policy lead a robot for some actions."""
    state, every = env.reset(), max(env.action_repeat // LOOKS, 1)
    start = last = float(env.position()[0, 0])
    done, way, forward, status = [], [0.0], 0.0, 0
    for number in range(actions):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            chosen = policy(TensorDict(state.exclude("action"), batch_size=env.batch_size))["action"]
        done.append(int(chosen[0]))
        for substep in range(env.action_repeat):
            env.apply_action(chosen, substep)
            env.sim.step()
            status = max(status, int(env.sim.status[0]))
            if (substep + 1) % every == 0:
                way.append(1e3 * (float(env.position()[0, 0]) - start))
        now = float(env.position()[0, 0])
        forward, last = forward + 1e3 * max(0.0, now - last), now
        state = state.exclude("action").update(env.observe())
        notices.progress(f"{gait} gait, {robot} model", f"action {number + 1} of {actions}")
    notices.progress_ends()
    return Walk(gait, robot, tuple(done), tuple(way), forward, status)


def open_loop(digits: str) -> Callable[[TensorDict], TensorDict]:
    """A policy that does what it was told, an action a digit, over and over."""
    actions = itertools.cycle(map(int, digits))
    return lambda td: td.set("action", torch.full(td.batch_size, next(actions)))


def compare(
    policies: Sequence[str], gaits: Sequence[str], actions: int, device: str, models: Sequence[str]
) -> list[Walk]:
    """All gaits on all models."""
    walks = []
    for robot in models:
        env = registry.make(ROBOTS[robot], num_worlds=1, device=device, seed=SEED, max_episode_steps=actions + 1)
        shown: dict[str, Any] = {HAND: multi_gait_baseline(env)}
        for number, run in enumerate(policies, 1):
            shown[f"learned {number}"] = check_fit(load_run(run, device=device, overrides=[]), env)
        shown |= {f"given {number}": open_loop(digits) for number, digits in enumerate(gaits, 1)}
        walks += [walk(gait, robot, env, policy, actions) for gait, policy in shown.items()]
    return walks


def table(walks: Sequence[Walk]) -> str:
    """Table 2, theirs beside ours."""
    by = {(w.gait, w.robot): w for w in walks}
    models = [name for name in ROBOTS if any(w.robot == name for w in walks)]
    heads = " | ".join(f"way {name} [mm]" for name in models)
    lines = [f"| gait | return reduced | {heads} | actions |", "|---|---|" + "---|" * (len(models) + 1)]
    hand = {name: by[HAND, name].way[-1] for name in models}
    for gait in dict.fromkeys(w.gait for w in walks):
        ways = " | ".join(f"{by[gait, name].way[-1]:.2f}" for name in models)
        told = by.get((gait, "reduced"))
        first = by[gait, models[0]]
        won = f"{told.forward:.2f}" if told else ""
        lines.append(f"| {gait} | {won} | {ways} | {' '.join(map(str, first.actions))} |")
    for gait, (won, *ways) in THEIRS.items():
        shown = " | ".join(f"{way:.2f}" for name, way in zip(ROBOTS, ways, strict=True) if name in models)
        lines.append(f"| theirs, {gait} | {won:.2f} | {shown} | |")
    notes = []
    for gait in dict.fromkeys(w.gait for w in walks):
        if gait != HAND:
            told = ", ".join(f"{by[gait, name].way[-1] / hand[name]:.2f} on the {name}" for name in models)
            notes.append(f"{gait} goes as far as the hand-made gait times {told} model (theirs: 1.39 and 1.74).")
        if len(models) == 2:
            full, small = by[gait, "full"].way[-1], by[gait, "reduced"].way[-1]
            notes.append(
                f"{gait}: the reduced model ends {100 * abs(small - full) / abs(full):.1f} % off the full one."
            )
    if len(models) == 2:
        ranked = [sorted({w.gait for w in walks}, key=lambda gait: -by[gait, name].way[-1]) for name in models]
        kept = "the same" if ranked[0] == ranked[1] else f"not the same: {', '.join(ranked[0])}; {', '.join(ranked[1])}"
        notes.append(f"Rank of the gaits on both models: {kept}.")
    return "\n".join([*lines, "", *(f"- {note}" for note in notes)])


def draw(walks: Sequence[Walk], path: Path) -> None:
    """Way over time of all gaits on all models, with the actions of each."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    colours = {gait: f"C{k}" for k, gait in enumerate(dict.fromkeys(w.gait for w in walks))}
    for w in walks:
        each = (len(w.way) - 1) / len(w.actions)
        time = [k / each for k in range(len(w.way))]
        style = "-" if w.robot == "full" else "--"
        axes.plot(time, w.way, style, color=colours[w.gait], label=f"{w.gait}, {w.robot}")
    axes.set(xlabel="action", ylabel="way along x [mm]")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=120, format="png")


def learn(given: argparse.Namespace) -> list[str]:
    """Folders of trained runs, a seed each; those that are there are kept."""
    runs, memory = [], None
    for seed in given.seeds:
        run = given.folder / f"seed_{seed}"
        runs.append(str(run))
        if (given.folder / f"seed_{seed}.done").exists():
            continue
        settings = [f"experiment={PRESET}", f"seed={seed}", f"device={given.device}", f"out={run}"]
        settings += [f"env.max_episode_steps={given.actions}", *given.training]
        if given.remember:
            memory = memory or _remembered(given)
            learn_from(memory, compose("train", TrainConfig, settings), run)
        elif code := train.main(settings):
            raise SystemExit(code)
        write_text(given.folder / f"seed_{seed}.done", "learned\n")
    return runs


def _remembered(given: argparse.Namespace) -> Memory:
    """All states of the reduced robot that the actions lead to."""
    worlds = 64 if given.device == "cpu" else 1024
    first, model = at_rest("reduced", given.actions, given.device, worlds, memory=2000.0)
    return remember(model, first, given.actions)


def learn_from(memory: Memory, config: TrainConfig, run: Path) -> None:
    """Train on what is remembered, as ``softwarp train`` would on the robot."""
    torch.manual_seed(config.seed)
    algorithm = make_algorithm(Remembered(memory, config.num_worlds), config.network, config.algo)
    judged = Remembered(memory, config.evaluation_episodes)
    evaluate = partial(run_episodes, judged, seed=config.evaluation_seed, deterministic=True)
    run.mkdir(parents=True, exist_ok=True)
    loop.train(algorithm, evaluate, run, config, logger=config.logger, settings=to_plain(config))


def main(argv: Sequence[str] | None = None) -> list[Walk]:
    """Learn, unless policies are given, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--policies", nargs="+", default=[], metavar="RUN", help="trained runs; none: learn")
    parser.add_argument("--gaits", nargs="+", default=[], metavar="DIGITS", help="actions, over and over, not to learn")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of learning")
    parser.add_argument("--training", nargs="+", default=[], metavar="KEY=VALUE", help=f"changes of {PRESET}")
    parser.add_argument(
        "--actions", type=int, default=6, help="of an episode; default 6, a cycle of the hand-made gait"
    )
    parser.add_argument("--remember", action="store_true", help="simulate each state once, and learn from memory")
    parser.add_argument("--models", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args(argv)
    policies = list(given.policies)
    if not (policies or given.gaits):
        policies = learn(given)
    walks = compare(policies, given.gaits, given.actions, given.device, given.models)
    given.folder.mkdir(parents=True, exist_ok=True)
    text = table(walks)
    write_text(given.folder / "gaits.json", json.dumps([asdict(w) for w in walks], indent=1) + "\n")
    write_text(given.folder / "table2.md", text + "\n")
    draw(walks, given.folder / "figure6.png")
    print(text)
    return walks


if __name__ == "__main__":
    main()
