"""Many settings of one training: a grid or random draws of them, run side by side or over machines; one table.

    softwarp sweep runs/rates env=cart_pole algo.learning_rate=1e-3,3e-4 seed=0,1,2       # six runs, as many as cores
    softwarp sweep runs/rates env=cart_pole algo.learning_rate=1e-3,3e-4 seed=0,1,2 --ray auto      # on a Ray cluster
    softwarp sweep runs/search env=trunk algo.gamma=interval(0.9,0.99) 'algo.learning_rate=tag(log,interval(1e-4,1e-2))'
        seed=0,1 --samples 16                                                              # 16 draws, two seeds of each

Values are written as in Hydra's sweeps: ``a,b``, ``range(0,4)``, and with ``--samples`` also ``interval(low,high)``,
evenly on a logarithmic scale where it has the tag ``log``. Seeds are always all run. Every run is a ``softwarp train``
in ``FOLDER/<settings>/seed_<k>``; started again, complete runs are kept and begun ones go on. ``table.csv`` and
``table.md`` have a row per setting, the best first by what training itself ranks policies by: success, then distance;
else return; ``runs.csv`` has a row per run.
"""

import argparse
import csv
import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.override_parser.types import IntervalSweep, Override

from softwarp.io.atomic import atomic_path, write_text
from softwarp.jobs import Job
from softwarp.training.evaluation import score
from softwarp.training.logs import read_csv

from . import pool
from .config import ConfigError, TrainConfig, compose, parse
from .verbs import folder_name

KEPT = ("logger=csv", "logger.picture=false", "keep_checkpoints=1")
OUTCOME = ("steps", "seconds", "return", "success", "distance")
NAME = 80  # characters of a folder's name


@dataclass(frozen=True)
class Setting:
    """Values of what varies, seeds apart."""

    values: tuple[tuple[str, str], ...]

    @property
    def name(self) -> str:
        """Of its folder: told by its values, cut where these are long, as ``learning_rate_0.001__gamma_0.9``."""
        text = "__".join(f"{key.split('.')[-1]}_{value}" for key, value in self.values) or "default"
        plain = re.sub(r"[^A-Za-z0-9_.+-]", "_", text)
        if len(plain) <= NAME:
            return plain
        return f"{plain[: NAME - 9]}_{np.uint32(hash_of(text)):08x}"

    @property
    def overrides(self) -> list[str]:
        """As ``softwarp train`` takes them."""
        return [f"{key}={value}" for key, value in self.values]


def hash_of(text: str) -> int:
    """A number that is the same in every process."""
    return int(np.random.SeedSequence(list(text.encode())).generate_state(1)[0])


def main(arguments: Sequence[str]) -> int:
    """Train and report; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="softwarp sweep", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=folder_name)
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="settings of softwarp train, key=a,b varies")
    parser.add_argument("--samples", type=int, help="draw so many settings at random, instead of taking all")
    parser.add_argument("--draw-seed", type=int, default=0, help="of these draws")
    parser.add_argument("--report-only", action="store_true", help="train nothing, tell what there is")
    pool.add_options(parser)
    args = parser.parse_intermixed_args(arguments)
    for name in ("jobs", "samples"):
        if getattr(args, name) is not None and getattr(args, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(args, name)}")
    fixed, settings, seeds = variations(args.overrides, args.samples, args.draw_seed)
    jobs = {(s, seed): job_of(args.folder, fixed, s, seed) for s in settings for seed in seeds}
    by_seed = [jobs[s, seed] for seed in seeds for s in settings]  # so that a stop leaves something of everything
    failed = [] if args.report_only else pool.run(by_seed, args)
    print(write_report(args.folder, settings, jobs))
    return 1 if failed else 0


def variations(
    overrides: Sequence[str], samples: int | None, draw_seed: int
) -> tuple[list[str], list[Setting], list[str]]:
    """Settings that stay, those that vary in all their combinations or in draws, and seeds.

    Raises:
        ConfigError: For a setting that names no values, or an interval without ``--samples``.
    """
    parsed = parse(list(overrides))
    varying = [override for override in parsed if override.is_sweep_override() and override.key_or_group != "seed"]
    fixed = [o.input_line for o in parsed if not o.is_sweep_override() and o.key_or_group not in ("seed", "out")]
    given = next((override for override in parsed if override.key_or_group == "seed"), None)
    seeds = ["0"] if given is None else choices(given)
    if any(override.key_or_group == "out" for override in parsed):
        raise ConfigError("out: every run of a sweep has a folder of its own; leave it out")
    if samples is None:
        combined = itertools.product(*(choices(override) for override in varying))
    else:
        rng = np.random.default_rng(draw_seed)
        combined = (tuple(drawn(override, rng) for override in varying) for _ in range(samples))  # type: ignore[assignment]
    keys = [override.key_or_group for override in varying]
    settings = [Setting(tuple(zip(keys, values, strict=True))) for values in combined]
    return fixed, list(dict.fromkeys(settings)), seeds


def choices(override: Override) -> list[str]:
    """Values of a setting, as they are written."""
    if isinstance(override.value(), IntervalSweep):
        told = f"setting {override.input_line!r}: an interval has no list of values"
        raise ConfigError(f"{told}; draw from it with --samples N, or write values, {override.key_or_group}=a,b")
    if not override.is_sweep_override():
        return [override.get_value_element_as_str()]
    return list(override.sweep_string_iterator())


def drawn(override: Override, rng: np.random.Generator) -> str:
    """A value at random."""
    value = override.value()
    if not isinstance(value, IntervalSweep):
        return str(rng.choice(choices(override)))
    low, high = float(value.start or 0.0), float(value.end or 0.0)
    if not low < high or ("log" in value.tags and low <= 0.0):
        need = "begin above 0 and " if "log" in value.tags else ""
        raise ConfigError(f"setting {override.input_line!r}: the interval must {need}end above its beginning")
    is_log = "log" in value.tags
    found = math.exp(rng.uniform(math.log(low), math.log(high))) if is_log else rng.uniform(low, high)
    return str(round(found)) if isinstance(value.start, int) and isinstance(value.end, int) else f"{found:.6g}"


def job_of(root: Path, fixed: Sequence[str], setting: Setting, seed: str) -> Job:
    """The run of a setting and a seed.

    Raises:
        ConfigError: If its settings cannot be composed.
    """
    folder = root / setting.name / f"seed_{seed}"
    overrides = [*fixed, *setting.overrides, *KEPT, f"seed={seed}"]
    config = compose("train", TrainConfig, overrides)
    return Job(folder, (*overrides, f"out={folder.resolve()}"), config.total_steps)


def write_report(root: Path, settings: Sequence[Setting], jobs: dict[tuple[Setting, str], Job]) -> str:
    """Write ``runs.csv``, ``table.csv`` and ``table.md``; returns the table as text."""
    found: dict[Setting, list[dict[str, float]]] = {setting: [] for setting in settings}
    lines: list[dict[str, Any]] = []
    for (setting, seed), job in jobs.items():
        rows = read_csv(job.folder / "evaluation.csv", ("steps", "seconds", "return", "success"))
        if rows:
            found[setting].append(rows[-1])
            told = {key: rows[-1][key] for key in OUTCOME if key in rows[-1]}
            lines.append({**dict(setting.values), "seed": seed, **told, "complete": job.is_done})
    if not lines:
        return f"{root}: no run has been evaluated yet"
    ranked = sorted((s for s in settings if found[s]), key=lambda s: -float(np.mean([score(r) for r in found[s]])))
    table: list[dict[str, Any]] = []
    for setting in ranked:
        rows = found[setting]
        means = {key: float(np.mean([row[key] for row in rows])) for key in OUTCOME if all(key in row for row in rows)}
        spread = {
            f"{key} {name}": float(of([row[key] for row in rows]))
            for key in ("return", "success")
            for name, of in (("least", np.min), ("most", np.max))
        }
        table.append({**dict(setting.values), "seeds": len(rows), **means, **spread})
    for name, content in (("runs", lines), ("table", table)):
        with atomic_path(root / f"{name}.csv") as scratch, scratch.open("w", newline="") as file:
            writer = csv.DictWriter(
                file, list(dict.fromkeys(key for row in content for key in row)), lineterminator="\n"
            )
            writer.writeheader()
            writer.writerows(content)
    text = markdown(table, len(jobs), sum(job.is_done for job in jobs.values()))
    write_text(root / "table.md", text)
    return text


def markdown(table: Sequence[dict[str, Any]], count: int, complete: int) -> str:
    """The table for a reader."""
    columns = [key for key in table[0] if not key.endswith((" least", " most"))]

    def cell(row: dict[str, Any], key: str) -> str:
        value = row.get(key, "")
        if not isinstance(value, float):
            return str(value)
        text = f"{value:,.0f}" if key in ("steps", "seconds") else f"{value:.4g}"
        return f"{text} ({row[f'{key} least']:.4g} to {row[f'{key} most']:.4g})" if f"{key} least" in row else text

    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(cell(row, key) for key in columns) + " |" for row in table]
    return "\n".join([*lines, "", f"{complete} of {count} runs are complete; means over seeds (least to most).", ""])
