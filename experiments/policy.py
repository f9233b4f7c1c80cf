"""``softwarp policy``: a trained policy as one file for a robot's computer, and how quickly it acts."""

import argparse
import itertools
from pathlib import Path
from typing import Any

import numpy as np

from softwarp.io.atomic import prove_writable

from . import early
from .verbs import ENDINGS as OF_VERBS

ENDINGS = OF_VERBS["policy export"]


def main(arguments: list[str]) -> int:
    """Export or time; returns the exit code."""
    parser = argparse.ArgumentParser(prog="softwarp policy", description=__doc__, allow_abbrev=False)
    verbs = parser.add_subparsers(dest="verb", required=True)
    write = verbs.add_parser("export", help="write networks and scaling to one file, and compare it with the policy")
    write.add_argument("run", metavar="RUN_OR_CHECKPOINT")
    write.add_argument("out", metavar="FILE", help=f"ends in {' or '.join(ENDINGS)}")
    timed = verbs.add_parser("time", help="call a policy at a fixed rate and tell its latency")
    timed.add_argument("run", metavar="RUN_OR_FILE", help="run, checkpoint or exported file")
    timed.add_argument("--rate", type=float, default=50.0, metavar="HZ", help="default 50")
    timed.add_argument("--seconds", type=float, default=5.0, help="default 5")
    known = parser.parse_args(arguments)
    early.policy(known.verb, known.run, getattr(known, "out", None))
    return write_file(known.run, known.out) if known.verb == "export" else time(known.run, known.rate, known.seconds)


def write_file(run: str, out: str) -> int:
    """Export, and say what the file takes and gives."""
    from softwarp.deploy import load_policy
    from softwarp.deploy.export import export, load_exported

    prove_writable(out)
    difference = export(load_policy(run), out)
    about = load_exported(out).about
    memory = f", memory ({about['memory']},)" if about["memory"] else ""
    print(f"{out}: observation ({about['observation']['size']},){memory} -> action, {about['action']['size']} ", end="")
    print("choices" if about["action"]["is_discrete"] else "numbers")
    unit = "of the choices differ" if about["action"]["is_discrete"] else "is the largest difference of an action"
    print(f"compared on 1024 random observations: {difference:.3g} {unit}")
    return 0


def time(run: str, rate: float, seconds: float) -> int:
    """Tell the latency of a policy on random observations."""
    from softwarp.deploy import Controller, load_policy
    from softwarp.deploy.export import load_exported

    if Path(run).suffix in ENDINGS:
        policy: Any = load_exported(run)
        size = policy.about["observation"]["size"]
    else:
        policy = load_policy(run)
        size = policy.spaces.observation_size
    seen = itertools.cycle(np.random.default_rng(0).standard_normal((1024, size), dtype=np.float32))
    controller = Controller(policy, lambda: next(seen), lambda action: None, rate=rate, safe=None)
    print(controller.run(seconds=seconds))
    return 0
