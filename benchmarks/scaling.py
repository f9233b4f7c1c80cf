"""How the speed of the trunk and of finer and finer cantilevers grows with worlds, nodes and cores.

Worlds and cores are those of the trunk. Nodes are those of the cantilever in ever smaller cells, stepped as one world
and as a batch; the slope of its curve tells how the factorisation grows with the mesh.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import warp as wp

from softwarp.io.atomic import atomic_path

from . import cantilever
from .scenes import Case, bare, time_scene
from .timing import array_bytes, limited_cores, machine, measure

WORLDS = {"cpu": (1, 4, 8, 16, 32, 64, 128), "cuda": (1, 16, 64, 256, 1024, 4096, 8192)}
CELLS = ((8, 2, 2), (15, 3, 3), (20, 4, 4), (30, 6, 6))
BATCH = {"cpu": 16, "cuda": 256}  # worlds of the second curve over nodes
CORE_WORLDS = 64


def measure_all(device: str, quick: bool, cores: int) -> list[dict[str, Any]]:
    """Records of the three curves; cores are varied on a CPU only."""
    is_cpu = bool(wp.get_device(device).is_cpu)
    kind = "cpu" if is_cpu else "cuda"
    repeats, steps = (3, 3) if quick else (5, 10)
    records = []
    for worlds in WORLDS[kind][:: 3 if quick else 1]:
        record = time_scene("trunk", worlds, device, cores, repeats=repeats, steps=steps, stages=False)
        records.append(record | {"figure": "worlds"})
    for cells in CELLS[: 2 if quick else None]:
        for worlds in (1, BATCH[kind]):
            case = bare(cantilever, worlds, device, "float32", cells=cells)
            records.append(time_case(case, device, cores if is_cpu else None, steps, repeats))
    for count in core_counts(cores) if is_cpu else ():
        with limited_cores(count):
            record = time_scene("trunk", CORE_WORLDS, device, count, repeats=repeats, steps=steps, stages=False)
        records.append(record | {"figure": "cores", "cores": count})
    for record in records:
        print(
            f"scaling with {record['figure']:7s} {record['worlds']:6d} worlds, {record['nodes']:6d} nodes, "
            f"{record['hardware']}: {record['ms_per_step']:9.3f} ms/step, "
            f"{record['world_steps_per_s']:10.0f} world-steps/s",
            flush=True,
        )
        del record["case"]
    return records


def time_case(case: Case, device: str, cores: int | None, steps: int, repeats: int) -> dict[str, Any]:
    """A point of the curves over nodes."""
    sim = case.sim
    record = {"case": "cantilever", "scene": "cantilever", "figure": "nodes", "worlds": sim.num_worlds}
    record |= {"nodes": sim.model.node_count, "tets": sim.model.tet_count}
    record |= measure(sim, case.drive, steps, repeats) | machine(device, cores)
    return record | {"memory_mb_per_world": 1e-6 * array_bytes(sim) / sim.num_worlds}


def core_counts(cores: int) -> list[int]:
    """1, 2, 4 ... and all."""
    counts = {cores}
    count = 1
    while count < cores:
        counts.add(count)
        count *= 2
    return sorted(counts)


def draw(records: list[dict[str, Any]], path: Path) -> None:
    """World-steps per second over worlds, milliseconds per world-step over nodes, world-steps per second over cores."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(12.0, 3.8), layout="constrained")
    for device in dict.fromkeys(record["device"] for record in records):
        kept = [record for record in records if record["device"] == device and "figure" in record]
        label = kept[0]["hardware"] if kept else device
        for axis, name, key in zip(axes, ("worlds", "nodes", "cores"), ("worlds", "nodes", "cores"), strict=True):
            rows = [record for record in kept if record["figure"] == name]
            batches = sorted({record["worlds"] for record in rows}) if name == "nodes" else [None]
            for batch in batches:
                points = [record for record in rows if batch is None or record["worlds"] == batch]
                y = [1e3 / r["world_steps_per_s"] if name == "nodes" else r["world_steps_per_s"] for r in points]
                told = label if batch is None else f"{label}, {batch} world{'s' if batch > 1 else ''}"
                if points:
                    axis.plot([record[key] for record in points], y, "o-", label=told)
    for axis, name in zip(axes, ("trunk, worlds", "cantilever, nodes", "64 trunks, cores"), strict=True):
        axis.set(xscale="log", yscale="log", xlabel=name)
        axis.grid(True, which="both", alpha=0.3)
        if axis.lines:
            axis.legend(fontsize=7)
    axes[0].set_ylabel("world-steps/s")
    axes[1].set_ylabel("ms per world-step")
    axes[2].set_ylabel("world-steps/s")
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=150)
    pyplot.close(figure)
