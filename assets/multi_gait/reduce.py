"""Makes softwarp/envs/multi_gait_modes.npz, the modes of MultiGaitReduced, and tells how near they come.

    python assets/multi_gait/reduce.py OUT.npz [--device cuda:0] [--worlds 32] [--modes 60] [--contact-modes 30]
    python assets/multi_gait/reduce.py OUT.npz --turning [...]      # multi_gait_turning_modes.npz, of a floating frame
    python assets/multi_gait/reduce.py OUT.npz --mesh fine [...]    # of the fine mesh, which comes without modes
    python assets/multi_gait/reduce.py OUT.npz --mesh fine --told 01 12 20 02 21 14 --looks 12 --states 32 \
        --element-tolerance 0.015 --without-all                     # a quarter of an hour on a CPU: two actions long

Worlds fill or empty a group of chambers drawn at random, one action after the other; states of all of them are the
motion that modes and elements come from. Two more worlds or, with ``--tests``, as many as wanted are not learned from:
one walks the hand-written gait, others have commands of their own. The reduced robot then does the same beside them.
With ``--turning`` all five chambers are filled on their own, and the first of the worlds that test turns by legs across
from each other.
"""

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from softwarp import reduction
from softwarp.envs import registry
from softwarp.envs.scenes.multi_gait import AXIS_ENDS
from softwarp.policies.baselines.multi_gait import GAIT
from softwarp.reduction.basis import NORMS
from softwarp.reduction.motion import Watch

EXACT = {"coarse": 8, "fine": 1}  # worlds in float64 that forces of elements come from: a fine one takes 1 GB
UNSEEN = 2  # worlds that test at least
PAIRS = ((4, 1), (2, 3))  # chambers of legs across from each other
KEPT = 3e-5  # part of the motion that a file of it may leave out


def commands(worlds: int, actions: int, seed: int) -> torch.Tensor:
    """Actions of all worlds, (action, world): the gait in the first, then random ones that mostly change something."""
    draws = torch.Generator().manual_seed(seed)
    full, told = torch.zeros(worlds, 3, dtype=torch.bool), []
    every = torch.arange(worlds)
    for number in range(actions):
        group = torch.randint(3, (worlds,), generator=draws)
        is_full = full[every, group] ^ (torch.rand(worlds, generator=draws) < 0.1)
        choice = torch.where(is_full, group + 3, group)
        choice[0] = GAIT[number % len(GAIT)]
        full[every, choice % 3] = choice < 3
        told.append(choice)
    return torch.stack(told)


def listed(told: Sequence[str], seed: int) -> torch.Tensor:
    """Actions given by digits, a world each, (action, world); before them the gait and drawn ones, as ``commands``.

    Raises:
        ValueError: If worlds differ in how many they have.
    """
    lengths = {len(digits) for digits in told}
    if len(lengths) != 1:
        raise ValueError(f"--told: all worlds need as many actions, got {sorted(lengths)}")
    actions = lengths.pop()
    given = torch.tensor([[int(digits[number]) for digits in told] for number in range(actions)])
    return torch.cat([commands(UNSEEN, actions, seed), given], dim=1)


def apart(worlds: int, actions: int, seed: int) -> torch.Tensor:
    """Actions of five chambers apart, (action, world, 5): pairs of legs in turn in the first, then drawn volumes.

    An action leaves every other chamber as it is; of the others a third each is filled, emptied or brought between.
    """
    draws = torch.Generator().manual_seed(seed)
    share, told = torch.zeros(worlds, 5), []
    for number in range(actions):
        drawn = torch.rand(worlds, 5, generator=draws)
        drawn = torch.where(torch.rand(worlds, 5, generator=draws) < 2 / 3, drawn.round(), drawn)
        share = torch.where(torch.rand(worlds, 5, generator=draws) < 0.5, drawn, share)
        now = share.clone()
        now[0] = 0.0
        for pair, chambers in enumerate(PAIRS):  # filled in two of four actions, one after the other
            now[0, list(chambers)] = float((number - pair) % 4 < 2 and number >= pair)
        told.append(2.0 * now - 1.0)
    return torch.stack(told)


def with_tests(told: torch.Tensor, tests: int, seed: int, *, turning: bool) -> torch.Tensor:
    """Further worlds that test, behind the first ``UNSEEN``: their actions hang on the seed alone."""
    draw, actions = apart if turning else commands, len(told)
    more = [draw(UNSEEN, actions, seed + number)[:, 1:] for number in range(1, tests - UNSEEN + 1)]
    return torch.cat([told[:, :UNSEEN], *more, told[:, UNSEEN:]], dim=1)


@torch.no_grad()
def run(env: Any, told: torch.Tensor, worlds: slice, looks: int, watch: Watch | None = None) -> torch.Tensor:
    """Carry out actions, (action, world, ...); places of all nodes of some worlds, (look, world, node, 3)."""
    env.reset()
    every, kept = env.action_repeat // looks, []
    for number, choice in enumerate(told):
        begun = time.perf_counter()
        for substep in range(env.action_repeat):
            env.apply_action(choice.to(env.device), substep)
            env.sim.step()
            if (substep + 1) % every == 0:
                kept.append(env.sim.node_x[worlds].double().cpu())
                if watch is not None:
                    watch.look()
        print(f"action {number + 1} of {len(told)}: {time.perf_counter() - begun:.1f} s", flush=True)
    return torch.stack(kept)


def only_seen(motion: reduction.Motion, worlds: int, tests: int) -> reduction.Motion:
    """Without the worlds that are to test; those that failed are not in it, and there must be none."""
    if len(motion) % worlds:
        raise RuntimeError("a world failed while motion was recorded")
    seen = (np.arange(len(motion)) % worlds) >= tests
    touch = None if motion.touch is None else motion.touch[seen]
    return reduction.Motion(motion.positions[seen], motion.travel, touch)


def keep_motion(path: Path, full: torch.Tensor, motion: reduction.Motion, rest: np.ndarray[Any, Any]) -> None:
    """Write the motion as amplitudes of so many directions that they leave out ``KEPT`` of it."""
    flat = (motion.positions - rest).reshape(len(motion), -1).astype(np.float64)
    squares, mixing = np.linalg.eigh(flat @ flat.T)
    left = np.sqrt(np.cumsum(squares.clip(min=0.0)) / squares.sum())
    mixing = mixing[:, np.argmax(left > KEPT) :]
    directions = (mixing.T @ flat).astype(np.float32)
    touched = np.zeros((0, 3), dtype=np.float32) if motion.touch is None else motion.touch
    index = np.flatnonzero(touched)
    np.savez_compressed(
        path,
        amplitudes=mixing.astype(np.float32),
        directions=directions,
        touched=index,
        touch=touched.ravel()[index],
        names=np.array(list(motion.travel)),
        travel=np.array(list(motion.travel.values())),
        full=full.float().numpy(),
    )


def kept_motion(path: Path, rest: np.ndarray[Any, Any]) -> tuple[torch.Tensor, reduction.Motion]:
    """What ``keep_motion`` wrote: places of the worlds that test, and the motion to learn from."""
    with np.load(path) as file:
        kept = dict(file)
    moved = (kept["amplitudes"] @ kept["directions"]).reshape(-1, *rest.shape)
    touch = np.zeros(moved.shape, dtype=np.float32)
    touch.ravel()[kept["touched"]] = kept["touch"]
    travel = dict(zip(kept["names"].tolist(), kept["travel"].tolist(), strict=True))
    return torch.tensor(kept["full"]).double(), reduction.Motion((rest + moved).astype(np.float32), travel, touch)


def told_beside(full: torch.Tensor, small: torch.Tensor, cycle: int, ends: Sequence[int]) -> list[str]:
    """How far the reduced robot is from the full one, along two cycles of the gait and at the end.

    Args:
        full: Places of all nodes [m], (look, world, node, 3).
        small: Those of the reduced robot.
        cycle: Looks.
        ends: Nodes at the rear and the front end of the body's axis.
    """
    lines, parts = [], []
    for world in range(full.shape[1]):
        name = "random commands" if world else "hand-written gait"
        a, b = full[:cycle, world], small[:cycle, world]
        means = [x.mean(dim=1) for x in (a, b)]
        apart = (means[0] - means[1]).norm(dim=-1)
        way = (means[0][1:] - means[0][:-1]).norm(dim=-1).sum()
        nodes = (a - b).norm(dim=-1).mean(dim=1)
        won = [float(m[-1, 0] - full[0, world].mean(dim=0)[0]) for m in means]
        axes = [x[-1, ends[1]] - x[-1, ends[0]] for x in (a, b)]
        turned = [math.degrees(math.atan2(float(axis[1]), float(axis[0]))) for axis in axes]
        parts.append(float(100 * apart.mean() / way))
        lines.append(
            f"{name}, two cycles: mean place {1e3 * apart.mean():.3f} mm apart (end {1e3 * apart[-1]:.3f}) on a way of "
            f"{1e3 * way:.2f} mm, {parts[-1]:.2f} %; nodes {1e3 * nodes.mean():.3f} mm apart; at the "
            f"end x is {1e3 * won[0]:.3f} mm in full, {1e3 * won[1]:.3f} reduced, the heading {turned[0]:.2f} and "
            f"{turned[1]:.2f} degrees"
        )
    drawn = parts[1:]
    return [
        *lines,
        f"random commands of {len(drawn)} worlds: {np.mean(drawn):.2f} % in the mean, {max(drawn):.2f} at most",
    ]


def main() -> None:
    """Record, train, save, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, default=32)
    parser.add_argument("--actions", type=int, default=18)
    parser.add_argument(
        "--modes", type=int, nargs="*", default=[60], help="several: OUT is that of the last; none: record"
    )
    parser.add_argument("--contact-modes", type=int, nargs="+", default=[30], help="as many as of modes, or one")
    parser.add_argument("--norm", nargs="+", choices=list(NORMS), default=["step"], help="as many as of modes, or one")
    parser.add_argument("--element-tolerance", type=float, nargs="+", default=[0.01])
    parser.add_argument("--told", nargs="+", metavar="DIGITS", help="actions of worlds to learn from, not drawn ones")
    parser.add_argument("--tests", type=int, default=UNSEEN, help="worlds that are not learned from, two at least")
    parser.add_argument("--looks", type=int, default=4, help="states of an action")
    parser.add_argument("--states", type=int, default=64)
    parser.add_argument("--repeat", type=int, default=60, help="sub-steps of an action; fewer to try this script")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--motion", type=Path, help="file that the motion is kept in, or read from where it is there")
    parser.add_argument("--turning", action="store_true", help="chambers apart, in a floating frame")
    parser.add_argument("--mesh", default="coarse", choices=list(EXACT))
    parser.add_argument("--without-all", action="store_true", help="do not run the modes with all elements as well")
    given = parser.parse_args()
    options = {"max_episode_steps": 10_000, "action_repeat": given.repeat, "ramp": min(15, given.repeat)}
    options["mesh"] = given.mesh
    if given.turning:
        options |= {"chambers": "each", "action_kind": "continuous"}
    if given.tests < UNSEEN:
        parser.error(f"--tests: at least {UNSEEN}, got {given.tests}")
    if given.told:
        told = listed(given.told, given.seed)
    else:
        told = (apart if given.turning else commands)(UNSEEN + given.worlds, given.actions, given.seed)
    told = with_tests(told, given.tests, given.seed, turning=given.turning)
    worlds, testing = told.shape[1], slice(0, given.tests)
    double = {"precision": "float64", "settle": False}  # elements are looked at, no motion
    exact = registry.make("MultiGaitFull", num_worlds=EXACT[given.mesh], seed=given.seed, **double, **options)
    rest = exact.sim.model.node_rest
    if given.motion is not None and given.motion.exists():
        full, motion = kept_motion(given.motion, rest)
        if full.shape[1] != given.tests:
            parser.error(f"--tests: {given.motion} has {full.shape[1]} worlds that test, got {given.tests}")
    else:
        env = registry.make("MultiGaitFull", num_worlds=worlds, device=given.device, seed=given.seed, **options)
        watch = Watch(env.sim)
        full = run(env, told, testing, given.looks, watch)
        motion = only_seen(watch.finish(), worlds, given.tests)
        motion = motion if given.turning else motion.symmetric(rest)
        if given.motion is not None:
            keep_motion(given.motion, full, motion, rest)
    cycle = 2 * len(GAIT) * given.looks
    count = len(given.modes)
    settings = (given.norm, given.contact_modes, given.element_tolerance)
    each = [values * count if len(values) == 1 else values for values in settings]
    for modes, norm, pressed, tolerance in zip(given.modes, *each, strict=True):
        begun = time.perf_counter()
        small = reduction.train(
            exact.sim,
            motion,
            modes=modes,
            contact_modes=pressed,
            frame="floating" if given.turning else "fixed",
            mirrored=given.turning,
            norm=norm,
            element_tolerance=tolerance or None,
            membrane_tolerance=tolerance or None,
            states=given.states,
            seed=given.seed,
        )
        took = time.perf_counter() - begun
        print(f"{small.told()}; {pressed} for contact; norm {norm}; tolerance {tolerance}; {took:.0f} s")
        print({key: value for key, value in small.report.items() if key != "amplitudes"}, flush=True)
        small.save(given.out, compact=True)
        for name, kept in {"chosen elements": small, "all elements": small.everything()}.items():
            if given.without_all and kept is not small:
                continue
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "modes.npz"
                kept.save(file)
                pair = registry.make(
                    "MultiGaitFull",
                    num_worlds=given.tests,
                    device=given.device,
                    seed=given.seed,
                    reduced=str(file),
                    **options,
                )
                other = run(pair, told[: min(2 * len(GAIT), len(told)), testing], testing, given.looks)
            ends = [exact.scene.tracked[k] for k in AXIS_ENDS]
            for line in told_beside(full, other, min(cycle, len(other)), ends):
                print(f"  {name}: {line}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
