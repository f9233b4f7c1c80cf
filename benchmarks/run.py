"""``softwarp bench``: every scene on every device, and how speed grows with worlds, nodes and cores.

    softwarp bench                                      # all scenes, all devices, minutes
    softwarp bench --quick                              # a look at all of them in a minute or two
    softwarp bench --filter trunk --worlds 1 64 --cores 1
    softwarp bench --env my_module:MyRobot              # an environment of your own
    softwarp bench --out bench                          # also bench/results.json, results.md and scaling.png
    softwarp bench PART ...                             # PART --help tells more about one of the others:

PART is ``peers`` (other simulators on the same cantilever), ``start`` (cold start), ``contacts`` (many of them),
``lift`` (a grasp), ``tubes`` (in a vessel), ``walls`` (whether they come into its wall), ``reduced`` (a quadruped in
its modes), ``gradients`` (through motions),
``adjoint`` (of steps), ``design``, ``searches``, ``first_order`` (all by gradients), ``episodes`` (whole ones, of
robots that touch), ``laws`` (of solids), ``accuracy``, ``locking``, ``training``, ``ranks`` (that train together),
``rank_curves`` (what they learn), ``capture``, ``robustness``, ``soak``, ``view`` (pictures per second), ``fidelity``,
``refinement`` or ``mutations``
(do the tests notice). Compare numbers of one run on one machine only.
Figures are medians over repetitions, the best and the worst beside them.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import warp as wp

from softwarp.io.atomic import write_text
from softwarp.solvers.partition import SolverPath

from . import scaling
from .scenes import SCENES, add_environment, time_scene
from .timing import limited_cores, save, show

PARTS = (
    "accuracy",
    "locking",
    "peers",
    "start",
    "contacts",
    "lift",
    "tubes",
    "walls",
    "reduced",
    "gradients",
    "adjoint",
    "design",
    "searches",
    "first_order",
    "episodes",
    "training",
    "ranks",
    "rank_curves",
    "capture",
    "robustness",
    "soak",
    "view",
    "laws",
    "fidelity",
    "refinement",
    "mutations",
)
QUICK_WORLDS = (1, 16)
HEAD = ("scene", "nodes", "worlds", "device", "ms/step", "min", "world-steps/s", "MB/world", "first step [s]", "failed")


def main(arguments: Sequence[str]) -> int:
    """Hand over to a part, or time the scenes."""
    if arguments and arguments[0] in PARTS:
        return int(importlib.import_module(f".{arguments[0]}", __package__).main(arguments[1:]))
    if arguments and not arguments[0].startswith("-"):
        told = f"there are {', '.join(PARTS)}; --filter chooses scenes"
        raise ValueError(f"softwarp bench has no part {arguments[0]!r}; {told}")
    args = parse(arguments)
    own = [add_environment(name) for name in args.env]
    names = own or [name for name in [*SCENES, "scaling"] if args.filter in name]
    if not names:
        raise ValueError(f"no scene matches {args.filter!r}; there are {', '.join(SCENES)} and scaling")
    records: list[dict[str, Any]] = []
    out: Path | None = args.out
    with limited_cores(args.cores) as cores:
        for device in args.device or devices():
            for name in names:
                if name == "scaling":
                    records += scaling.measure_all(device, args.quick, cores)
                else:
                    records += time_worlds(name, device, cores, args)
                save(records, out / "results.json" if out else None)
    text = table(records)
    print(f"\n{text}")
    if out:
        write_text(out / "results.md", text + "\n")
        if "scaling" in names:
            scaling.draw(records, out / "scaling.png")
        print(f"\nwritten to {out}")
    return 1 if any(record["failed_worlds"] for record in records) else 0


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Options of the scenes."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--filter", default="", metavar="TEXT", help="only what has TEXT in its name")
    parser.add_argument("--env", nargs="+", default=[], metavar="NAME", help="only these, such as my_module:MyRobot")
    parser.add_argument("--quick", action="store_true", help="few worlds and repetitions, no stages")
    parser.add_argument("--worlds", type=int, nargs="+", help="numbers of worlds instead of each scene's own")
    parser.add_argument("--device", nargs="+", help="Warp devices; all that there are if left out")
    parser.add_argument("--cores", type=int, help="cores of a CPU to run on")
    parser.add_argument("--precision", default="float32", choices=["float32", "float64"])
    parser.add_argument("--path", default="auto", choices=get_args(SolverPath), help="solver path")
    parser.add_argument("--repeats", type=int, help="samples of each figure")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="for results.json, results.md and scaling.png")
    return parser.parse_args(arguments)


def devices() -> list[str]:
    """The processor, and the first GPU if there is one."""
    return ["cpu", "cuda:0"] if wp.get_cuda_device_count() else ["cpu"]


def time_worlds(name: str, device: str, cores: int, args: argparse.Namespace) -> list[dict[str, Any]]:
    """One scene with several numbers of worlds."""
    kind = "cpu" if wp.get_device(device).is_cpu else "cuda"
    records = []
    for worlds in args.worlds or (QUICK_WORLDS if args.quick else SCENES[name].worlds[kind]):
        record = time_scene(
            name,
            worlds,
            device,
            cores,
            precision=args.precision,
            repeats=args.repeats or (3 if args.quick else 9),
            steps=5 if args.quick else None,
            stages=not args.quick,
            solver_path=args.path,
        )
        note = f", {record['env_steps_per_s']:.0f} env-steps/s" if "env_steps_per_s" in record else ""
        show(record, note)
        records.append(record)
    return records


def table(records: list[dict[str, Any]]) -> str:
    """Records as a Markdown table under the machine they were made on."""
    lines = []
    for device in dict.fromkeys(record["device"] for record in records):
        rows = [record for record in records if record["device"] == device]
        if not rows:
            continue
        about = rows[0]
        versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
        lines += [f"{about['hardware']}; python {about['python']}, {versions}; commit {about['commit']}", ""]
        lines += ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
        lines += ["| " + " | ".join(row(record)) + " |" for record in rows] + [""]
    return "\n".join(lines).rstrip()


def row(record: dict[str, Any]) -> tuple[str, ...]:
    """Cells of a record."""
    scaling_with = f", scaling with {record['figure']}" if "figure" in record else ""
    return (
        record["scene"] + scaling_with,
        str(record["nodes"]),
        str(record["worlds"]),
        record["hardware"],
        f"{record['ms_per_step']:.3g}",
        f"{record['ms_min']:.3g}",
        f"{record['world_steps_per_s']:.0f}",
        f"{record['memory_mb_per_world']:.2f}",
        f"{record['first_step_s']:.1f}",
        str(record["failed_worlds"]),
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
