"""``softwarp paper``: SofaGym's figures and tables beside ours, on one page.

    softwarp paper FOLDER --quick                # everything once, small: does it run here?
    softwarp paper FOLDER                        # in full: days, most of them learning
    softwarp paper FOLDER --only speed table1    # some parts
    softwarp paper FOLDER --report-only          # the page of what there is

Parts are studies of this repository, run one after the other. A part that is finished is kept, with its settings and
its time in ``FOLDER/<part>/part.json``, and not run again with the same settings; learning goes on where it was
stopped. A part that fails is told on the page and the next one runs; the exit code is 1 then. ``FOLDER/paper.md`` is
written after every part. The paper is P. Schegg and others, SofaGym, Soft Robotics 10(2), 2023.
"""

import argparse
import json
import platform
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

import torch

from softwarp.control import InversePolicy
from softwarp.envs import registry
from softwarp.io.atomic import prove_writable, write_text
from softwarp.policies.baselines.table import rule
from softwarp.training.evaluation import run_episodes

from . import baselines, diamond_table1, gait_study, maze_plans, obstacle_study, plan
from .config import make_env_config
from .verbs import folder_name

PAGE, RECORD = "paper.md", "part.json"
# Simulated time over that of the clock at steps of 10 ms, one process, quad-core i7 of 3.1 GHz (sections 4.1 to 4.6).
PAPER_SPEED = {
    "CartStem": 3.6,
    "CartStemContact": 3.5,
    "CatchTheObject": 1.2,
    "Gripper": 0.15,
    "Diamond": 0.11,
    "Trunk": 0.5,
    "TrunkCup": 0.1,
    "Maze": 0.02,
    "SimpleMaze": 1.26,
    "MultiGaitFull": 0.007,
    "MultiGaitReduced": 0.15,
}
SEED = 2_000_003
PAPER_TOLERANCE = 0.003  # m, of ConcentricTubeRobot in SofaGym


@dataclass(frozen=True)
class Part:
    """A figure or table of the paper.

    Attributes:
        title: What it is there.
        theirs: What the paper has.
        differs: What is not the same.
        full: Arguments of the study.
        quick: Those of a small one.
        run: Carries it out in a folder, and returns what stands on the page, as Markdown.
    """

    title: str
    theirs: str
    differs: str
    full: tuple[str, ...]
    quick: tuple[str, ...]
    run: Callable[[Path, Sequence[str]], str]


@dataclass(frozen=True)
class Record:
    """What is kept of a part that was run."""

    arguments: tuple[str, ...]
    seconds: float
    text: str
    error: str = ""
    about: str = ""  # machine and versions

    @classmethod
    def load(cls, file: Path) -> "Record | None":
        """The record of a folder, None if there is none that can be read."""
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            return cls(**content | {"arguments": tuple(content["arguments"])})
        except (OSError, ValueError, TypeError, KeyError):
            return None


def speed(folder: Path, arguments: Sequence[str]) -> str:
    """How fast each robot runs: one world on the CPU with SofaGym's options where they exist, under random actions."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--tasks", nargs="+", default=list(PAPER_SPEED))
    given = parser.parse_args(arguments)
    lines = ["| robot | theirs | ours | times | options |", "|---|---|---|---|---|"]
    told = {}
    for name in given.tasks:
        factor, options = real_time_factor(name, given.seconds)
        told[name] = factor
        lines.append(
            f"| {name} | {PAPER_SPEED[name]:g} | {factor:.3g} | {factor / PAPER_SPEED[name]:.3g} | {options} |"
        )
        print(f"{name}: {factor:.3g} times real time", flush=True)
    write_text(folder / "speed.json", json.dumps(told, indent=1) + "\n")
    return "\n".join(lines)


@torch.no_grad()
def real_time_factor(name: str, seconds: float) -> tuple[float, str]:
    """Simulated time over that of the clock, and whose options these are.

    Args:
        name: Environment.
        seconds: Of the clock, at most, after the first action; at least one action is timed.
    """
    _, config = make_env_config({"name": name})
    is_theirs = hasattr(type(config), "paper")
    env = registry.make(name, num_worlds=1, seed=SEED, config=type(config).paper() if is_theirs else config)
    torch.manual_seed(SEED)
    td = env.step(env.rand_action(env.reset()))  # kernels are compiled, caches are warm
    begun, actions = time.perf_counter(), 0
    while actions == 0 or time.perf_counter() - begun < seconds:
        td = env.step(env.rand_action(env.maybe_reset(td["next"])))
        actions += 1
    return actions * env.control_dt / (time.perf_counter() - begun), "SofaGym's" if is_theirs else "ours"


def table1(folder: Path, arguments: Sequence[str]) -> str:
    """Diamond: inverse control and planners on the same targets."""
    diamond_table1.main([str(folder), *arguments])
    return (folder / "table.md").read_text(encoding="utf-8")


def obstacle(folder: Path, arguments: Sequence[str]) -> str:
    """Inverse control gets stuck, a planner does not."""
    obstacle_study.main([str(folder), *arguments])
    return (folder / "obstacle.md").read_text(encoding="utf-8")


def table2(folder: Path, arguments: Sequence[str]) -> str:
    """The quadruped: hand-made and learned gaits, reduced and full."""
    gait_study.main([str(folder), *arguments])
    return (folder / "table2.md").read_text(encoding="utf-8")


def mazes(folder: Path, arguments: Sequence[str]) -> str:
    """OPD through mazes."""
    told = maze_plans.main(["--output", str(folder / "plans.json"), *arguments])
    lines = ["| study | goals met | seconds per plan, mean |", "|---|---|---|"]
    for name, found in told.items():
        if found:
            met, mean = sum(entry.success for entry in found), sum(entry.seconds for entry in found) / len(found)
            lines.append(f"| {name} | {met} of {len(found)} | {mean:.2f} |")
    return "\n".join(lines)


def ctr(folder: Path, arguments: Sequence[str]) -> str:
    """Concentric tubes in a nasal passage: a planner, inverse control, and the hand-written policy."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--goals", type=int, default=20)
    parser.add_argument("--expansions", type=int, help="budget of a plan, in place of the preset's")
    given = parser.parse_args(arguments)
    summary, name = folder / "opd.json", "ConcentricTubeRobot"
    settings = ["env=concentric_tube_robot", "planner=opd", f"env.success_tolerance={PAPER_TOLERANCE}", f"seed={SEED}"]
    settings += [] if given.expansions is None else [f"planner.expansions={given.expansions}"]
    plan.main([*settings, f"episodes={given.goals}", f"summary={summary}", "progress=false"])
    episodes = json.loads(summary.read_text(encoding="utf-8"))["episodes"]
    told = [[entry["success"], entry["distance"], entry["seconds"]] for entry in episodes]
    lines = [
        "| method | goals met | distance at the end, mean [mm] | s per goal |",
        "|---|---|---|---|",
        row("OPD, within 3 mm", told),
    ]
    env = registry.make(name, num_worlds=given.goals, seed=SEED, config=make_env_config({"name": name})[1])
    for method, policy in (("inverse control", InversePolicy(env)), ("hand-written", rule(env, name))):
        begun, ended = time.perf_counter(), run_episodes(env, policy, seed=SEED)
        seconds = (time.perf_counter() - begun) / given.goals
        found = zip(ended.success.tolist(), ended.distance.tolist(), strict=True)
        lines.append(row(f"{method}, within 1 mm at the end", [[*pair, seconds] for pair in found]))
    return "\n".join(lines)


def row(method: str, told: Sequence[Sequence[float]]) -> str:
    """A line of the table: whether goals were met, distances [m], times [s]."""
    met, distance, seconds = (sum(column) / len(told) for column in zip(*told, strict=True))
    return f"| {method} | {met:.0%} of {len(told)} | {1e3 * distance:.2f} | {seconds:.1f} |"


def learning(folder: Path, arguments: Sequence[str]) -> str:
    """Tasks, algorithms and seeds."""
    code = baselines.main([str(folder), *arguments])
    if code:
        raise RuntimeError(f"softwarp baselines ended with {code}; its runs are kept, the same command goes on")
    return (folder / "table.md").read_text(encoding="utf-8")


PARTS = {
    "speed": Part(
        "Sections 4.1 to 4.6: simulated time over that of the clock, one process, steps of 10 ms",
        "in the table",
        "the machine; random actions; one world",
        (),
        ("--seconds", "1", "--tasks", "CartStem", "Diamond"),
        speed,
    ),
    "table1": Part(
        "Table 1: Diamond, mean over targets",
        "QP 13.24 mm in 3.93 s, OPD 3.13 mm in 38.24 s",
        "targets and budget of OPD, which the paper does not give; see docs/table1.md",
        ("--methods", "QP", "OPD", "MPPI", "CEM"),
        ("--setting", "small", "--methods", "QP", "OPD"),
        table1,
    ),
    "table2": Part(
        "Table 2 and figure 6: MultiGait, hand-made and learned gaits on the reduced and the full model",
        "hand-made: return 5.38, way 3.24 reduced and 3.56 full; learned: 6.33, 4.51 and 6.21, called cm",
        "lengths in mm, which SofaGym's code counts; modes of ours, coarse mesh; a time limit ends the task",
        ("--remember",),
        (
            *("--seeds", "0", "--actions", "2", "--models", "reduced", "--training", "num_worlds=2", "total_steps=8"),
            *("algo.horizon=2", "evaluations=1", "evaluation_episodes=1"),
        ),
        table2,
    ),
    "obstacle": Part(
        "Where the way leads round something, QP gets stuck and planning does not",
        "told of CTR: OPD 100 %, QP stuck; no numbers",
        "here on CartStemContact, with CEM",
        (),
        ("--starts", "2"),
        obstacle,
    ),
    "ctr": Part(
        "Concentric tubes: goals in a nasal passage",
        "OPD meets 100 % of the goals, QP gets stuck",
        "passage, tubes and goals are ours (docs/environments/concentric_tube_robot.md)",
        (),
        ("--goals", "1", "--expansions", "4"),
        ctr,
    ),
    "mazes": Part(
        "SimpleMaze: OPD to all four corners",
        "4 of 4",
        "random mazes are ours",
        ("--first", "100"),
        ("--mazes", "1", "--goals", "1"),
        mazes,
    ),
    "figure2": Part(
        "Figure 2: PPO, SAC and both with AVEC on CartStem, CartStemContact and CatchTheObject, six seeds",
        "CartStem solved by PPO (18 h) and PPO-AVEC (6 h); CartStemContact: SAC best, PPO oscillates (19 h for all); "
        "CatchTheObject: about -3, SAC-AVEC -4 (23 h for all); 40 cores",
        "presets of ours with many worlds; `softwarp baselines FOLDER --setting paper` has SofaGym's",
        ("--setting", "fast"),
        ("--setting", "small", "--seeds", "1", "--tasks", "cartstem", "--algorithms", "ppo"),
        learning,
    ),
    "figures3and4": Part(
        "Figures 3 and 4: Gripper with and without random pull, memory and cloning",
        "discounted return about 190 with and without pull; cloning the same, sooner",
        "the reward's scale",
        ("--setting", "fast", "--tasks", "gripper"),
        ("--setting", "small", "--seeds", "1", "--tasks", "gripper", "--algorithms", "ppo"),
        learning,
    ),
}
MISSING = ("the real tripod of Maze: docs/transfer.md has the replays in simulation",)


def about() -> str:
    """Machine and versions, for the page."""
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("softwarp", "warp-lang", "torch"))
    return f"{platform.machine()}, {torch.get_num_threads()} threads, Python {platform.python_version()}, {versions}"


def carry_out(part: Part, folder: Path, arguments: tuple[str, ...]) -> Record:
    """Run a part and keep its record; errors are part of that."""
    folder.mkdir(parents=True, exist_ok=True)
    begun, text, error = time.perf_counter(), "", ""
    try:
        text = part.run(folder, arguments)
    except (Exception, SystemExit) as reason:  # noqa: BLE001 - of a study, of any kind; the other parts go on
        traceback.print_exc()
        error = f"{type(reason).__name__}: {reason}".splitlines()[0]
    record = Record(arguments, time.perf_counter() - begun, text.strip(), error, about())
    write_text(folder / RECORD, json.dumps(asdict(record), indent=1) + "\n")
    return record


def page(folder: Path) -> str:
    """The page of what there is."""
    lines = ["# SofaGym's paper beside softwarp", "", "Made by `softwarp paper`; the seeds are those of each study."]
    for name, part in PARTS.items():
        record = Record.load(folder / name / RECORD)
        lines += ["", f"## {part.title}", "", f"- **Theirs**: {part.theirs}.", f"- **Differs**: {part.differs}."]
        if record is None:
            lines += ["- **Ours**: not run."]
            continue
        command = f"`softwarp paper FOLDER --only {name}`, {' '.join(record.arguments) or 'full settings'}"
        lines += [f"- **Ours**: {command}; {record.seconds:.0f} s; {record.about}."]
        lines += [f"- **Failed**: {record.error}"] if record.error else ["", record.text]
        lines += [f"\n![{part.title}]({name}/{path.name})" for path in sorted((folder / name).glob("*.png"))]
    return "\n".join([*lines, "", "## Not here", "", *(f"- {what}" for what in MISSING), ""])


def main(argv: Sequence[str] | None = None) -> int:
    """Run what is asked for and write the page; returns 1 if a part failed."""
    parser = argparse.ArgumentParser(
        prog="softwarp paper", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=folder_name)
    parser.add_argument("--quick", action="store_true", help="small settings, minutes")
    names = list(PARTS)
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="PART", help=", ".join(names))
    parser.add_argument("--report-only", action="store_true", help="run nothing, write the page")
    given = parser.parse_args(argv)
    prove_writable(given.folder / PAGE)
    failed = False
    for name in [] if given.report_only else given.only:
        part, place = PARTS[name], given.folder / name
        arguments = part.quick if given.quick else part.full
        record = Record.load(place / RECORD)
        if record is not None and not record.error and record.arguments == arguments:
            print(f"{name}: kept, {record.seconds:.0f} s", flush=True)
            continue
        print(f"{name}: {part.title}", flush=True)
        record = carry_out(part, place, arguments)
        print(f"{name}: {record.error or 'done'}, {record.seconds:.0f} s", flush=True)
        failed = failed or bool(record.error)
        write_text(given.folder / PAGE, page(given.folder))
    write_text(given.folder / PAGE, page(given.folder))
    print(f"{given.folder / PAGE}: written")
    return int(failed)
