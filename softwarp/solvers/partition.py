"""How a batch is taken through a step: the variant of the kernels, and the worlds that step as one."""

from __future__ import annotations

import os
from itertools import pairwise
from typing import get_args

import numpy as np
import warp as wp

from softwarp import checks
from softwarp.kernels.algebra.lanes import LANE_COUNT, Variant, variant
from softwarp.model.model import Model
from softwarp.solvers.options import SolverPath as SolverPath

GPU_PATHS = ("panels", "levels")
MOST_THREADS = 4096
LANES_FROM = 4  # worlds from which eight SIMD lanes beat one world after the other; benchmarks/trunk.py
FREE_SHARDS, FREE_WORLDS = 8, 4  # for a thread at most, and in each at least, where threads take what is left
SHARD_BYTES = 2.0e6  # of factors, held by the worlds that a CPU thread takes through a step together: its cache


def choose_variant(model: Model, path: SolverPath) -> Variant:
    """Variant of the kernels for a model's device, precision and number of worlds.

    Results differ by rounding between variants, and so does a world on ``auto`` below and from ``LANES_FROM`` worlds.

    Raises:
        ValueError: For an unknown path, or one of a GPU on a CPU.
    """
    checks.choice(path, "solver_path", get_args(SolverPath))
    if wp.get_device(model.device).is_cuda:
        return variant("cuda", model.precision)
    if path in GPU_PATHS:
        raise ValueError(f"solver_path {path!r} is for a GPU; for device {model.device!r} choose auto, scalar or lanes")
    if path == "auto":
        many = model.num_worlds >= LANES_FROM and model.precision == "float32"
        path = "lanes" if many else "scalar"
    return variant(path, model.precision)


def thread_count(threads: int | None) -> int:
    """CPU threads to use; None takes all cores of the process.

    Raises:
        ValueError: If there is to be none.
    """
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return available if threads is None else checks.count(threads, "threads", high=MOST_THREADS)


def world_ranges(chosen: Variant, model: Model, threads: int | None) -> list[tuple[int, int]]:
    """Worlds that step as one: all on a GPU; on a CPU as many as a core's cache holds, those with most worlds first.

    Each thread has as many of these shards as the others, if there are enough worlds.
    """
    worlds = model.num_worlds
    if chosen.world_fastest:
        return [(0, worlds)]
    count = thread_count(threads)
    unit = LANE_COUNT if chosen.lanes > 1 else 1
    packs = -(-worlds // unit)
    factors = 9.0 * (8 if model.precision == "float64" else 4) * model.symbolic.block_count * unit
    together = max(1, int(SHARD_BYTES / max(factors, 1.0)))
    return _cut(worlds, unit, count * -(-packs // (count * together)))


def free_ranges(chosen: Variant, model: Model, threads: int | None, uneven: bool) -> tuple[list[tuple[int, int]], bool]:
    """Worlds that step as one, and whether threads take the next of them as soon as they are free.

    That is so where steps are ``uneven``, as some worlds take much longer than others, and a thread would have one
    shard: there are smaller ones then, each with memory of its own. With more of them, waits of threads even out.
    """
    ranges, count = world_ranges(chosen, model, threads), thread_count(threads)
    if chosen.world_fastest or not uneven or not 1 < len(ranges) <= count:
        return ranges, False
    unit = LANE_COUNT if chosen.lanes > 1 else 1
    finer = min(model.num_worlds // max(unit, FREE_WORLDS), FREE_SHARDS * count)
    return (_cut(model.num_worlds, unit, finer), True) if finer > len(ranges) else (ranges, False)


def _cut(worlds: int, unit: int, count: int) -> list[tuple[int, int]]:
    packs = -(-worlds // unit)
    sizes = [part.size for part in np.array_split(np.arange(packs), min(count, packs))]
    cuts = np.cumsum([0, *sizes]) * unit
    return [(int(a), int(min(b, worlds))) for a, b in pairwise(cuts)]
