"""Other simulators on the cantilever of ``cantilever.py``: speed, and the tip's sag beside it.

    softwarp bench peers                             # one world on one core, 64 on all cores
    softwarp bench peers --filter mujoco --cores 2 --json peers.json

Same nodes, tetrahedra, masses, material constants, damping and time step for every simulator that takes them, all on
the same cores, one after the other in every round so that a change of clock meets all. A fast wrong answer is no
answer: beside the speed stands how far the tip sags at rest, 59.4 mm for linear tetrahedra on these cells and 73.4 mm
converged. Speed is measured while the beam swings, let go straight; on one core as processor time, which other programs
on the machine change little.

MuJoCo's flex is integrated by ``discrete``, the only integrator of its implicit elasticity (St. Venant-Kirchhoff). It
ends its linear solve by default after 100 iterations and warns; a second entry lets it converge. Batches
take one thread per core by ``mujoco.rollout``, step by step where the warning would end a longer rollout.
Newton has vertex block descent, which stays too soft unless steps are short; a second entry takes as short ones as it
needs. Genesis has implicit finite elements with conjugate gradients. Simulators that are not installed are listed with
what installs them.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import os
import statistics
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import warp as wp

from . import cantilever as beam
from .timing import limited_cores, machine, save, summary

SWING = 20  # steps of a sample, from the straight beam
SETTLE = 600  # steps after which the beam rests
WORLDS = 64
BUDGET = 20.0  # s of samples of one simulator, after which it sits out the other rounds
RUNNERS: dict[str, type[Runner]] = {}


class Runner(ABC):
    """A simulator that steps the cantilever.

    Attributes:
        module: What it is imported as.
        package: What it is called where packages are.
        install: What ``pip install`` takes for it.
        settings: What tells its configuration in tables.
        steps: Of a sample.
        worlds: Number of worlds.
    """

    module = package = install = ""
    settings = ""
    steps = SWING
    nodes, tets = 525, 1600

    def __init__(self, worlds: int, cores: int) -> None:
        self.worlds = worlds

    @abstractmethod
    def swing(self, steps: int) -> None:
        """Let all worlds go straight and take them through some steps."""

    @abstractmethod
    def sag(self, steps: int) -> float:
        """Sag of the tip [m] after so many steps, in the first world."""

    def notes(self) -> str:
        """What went wrong."""
        return ""

    @classmethod
    def missing(cls) -> bool:
        """Whether it is not installed; a module of its name may be another package's."""
        try:
            metadata.version(cls.package)
        except metadata.PackageNotFoundError:
            return True
        return importlib.util.find_spec(cls.module) is None

    @classmethod
    def version(cls) -> str:
        """Of the installed module."""
        return str(importlib.import_module(cls.module).__version__)


def register(name: str) -> Callable[[type[Runner]], type[Runner]]:
    """Enter a runner into the table under a name."""

    def enter(cls: type[Runner]) -> type[Runner]:
        RUNNERS[name] = cls
        return cls

    return enter


@register("softwarp")
class Softwarp(Runner):
    """This simulator, corotational linear tetrahedra."""

    module = "softwarp"
    settings = "corotational, float32, direct solve"

    def __init__(self, worlds: int, cores: int) -> None:
        super().__init__(worlds, cores)
        self.sim = beam.build(worlds, "cpu", "float32", threads=cores)
        self.start = self.sim.node_x[0].numpy().copy()

    def swing(self, steps: int) -> None:
        """All worlds."""
        self.sim.reset()
        for _ in range(steps):
            self.sim.step()

    def sag(self, steps: int) -> float:
        """Of the first world."""
        self.swing(steps)
        return beam.sag(self.start, self.sim.node_x[0].numpy())

    def notes(self) -> str:
        """Failed worlds."""
        failed = int((self.sim.status > 1).sum())
        return f"{failed} worlds failed" if failed else ""


@register("mujoco")
class Mujoco(Runner):
    """MuJoCo's flex with its default settings."""

    module, package, install = "mujoco", "mujoco-core", "softwarp[peers]"
    settings = "flex, discrete, 100 iterations"
    iterations = 100
    chunk = 1  # steps of a rollout; the warning of the unfinished solve would end a longer one

    def __init__(self, worlds: int, cores: int) -> None:
        import mujoco
        from mujoco import rollout

        super().__init__(worlds, cores)
        mujoco.set_mju_user_warning(lambda text: None)  # the number of warnings is told by notes
        self.start = beam.mesh().nodes
        self.model = mujoco_model(self.iterations)
        self.data = [mujoco.MjData(self.model) for _ in range(cores)]
        self.pool = rollout.Rollout(nthread=cores)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        straight = np.empty(mujoco.mj_stateSize(self.model, kind))
        mujoco.mj_getState(self.model, self.data[0], straight, kind)
        self.straight = np.tile(straight, (worlds, 1))

    def swing(self, steps: int) -> None:
        """One world by itself, several by the threaded rollout."""
        if self.worlds == 1:
            self.advance(steps)
            return
        state = self.straight
        for _ in range(steps // self.chunk):
            states, _ = self.pool.rollout(self.model, self.data, state, nstep=self.chunk)
            state = states[:, -1]

    def advance(self, steps: int) -> None:
        """One world, from the straight beam."""
        import mujoco

        mujoco.mj_resetData(self.model, self.data[0])
        for _ in range(steps):
            mujoco.mj_step(self.model, self.data[0])

    def sag(self, steps: int) -> float:
        """Of one world."""
        self.advance(steps)
        return beam.sag(self.start, self.data[0].flexvert_xpos)

    def notes(self) -> str:
        """How often the linear solve gave up."""
        import mujoco

        self.advance(self.steps)
        count = self.data[0].warning[mujoco.mjtWarning.mjWARN_INERTIA].number
        return f"linear solve unfinished in {count} of {self.steps} steps" if count else ""


@register("mujoco, converged")
class MujocoConverged(Mujoco):
    """MuJoCo's flex with as many iterations as its linear solve needs."""

    settings = "flex, discrete, 1000 iterations"
    iterations = 1000
    chunk = SWING


def mujoco_model(iterations: int) -> Any:
    """The cantilever as a flex; masses of vertices by the volumes around them, as in ours, instead of all alike."""
    import mujoco

    mesh = beam.mesh()
    held = beam.clamped(mesh.nodes)
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option timestep="{beam.DT}" integrator="discrete" iterations="{iterations}" gravity="0 0 -{beam.GRAVITY}">
            <flag contact="disable"/>
          </option>
          <size memory="200M"/>
          <worldbody>
            <flexcomp name="beam" type="direct" dim="3" mass="1" radius="0.0001"
                      point="{" ".join(f"{x:.9g}" for x in mesh.nodes.ravel())}"
                      element="{" ".join(map(str, mesh.tets.ravel()))}">
              <contact selfcollide="none" contype="0" conaffinity="0"/>
              <elasticity young="{beam.YOUNGS}" poisson="{beam.NU}" damping="{beam.DAMPING}"/>
              <pin id="{" ".join(map(str, held))}"/>
            </flexcomp>
          </worldbody>
        </mujoco>""")
    masses = beam.masses(mesh)
    model.body_mass[1:] = np.delete(masses, held)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


@register("newton")
class Newton(Runner):
    """Newton's vertex block descent, Neo-Hookean; all worlds in one model, on one core (Warp's CPU launches).

    Descent that ends before it has converged leaves a body too soft, and the more so the stiffer a step is. Damping of
    the material is a stiffness of that kind, so there is none. Launches of a step are recorded.
    """

    module = package = install = "newton"
    settings = "VBD, 10 sub-steps of 10 iterations"  # as in its examples of soft bodies
    substeps, iterations = 10, 10
    steps = 2

    def __init__(self, worlds: int, cores: int) -> None:
        import newton

        super().__init__(worlds, cores)
        mesh = beam.mesh()
        self.start, self.mass = mesh.nodes, beam.masses(mesh)
        builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, -beam.GRAVITY))
        mu, lam = beam.YOUNGS / 2.0 / (1.0 + beam.NU), beam.YOUNGS * beam.NU / (1.0 + beam.NU) / (1.0 - 2.0 * beam.NU)
        for _ in range(worlds):
            first = builder.particle_count
            builder.add_soft_mesh(
                pos=wp.vec3(0.0, 0.0, 0.0),
                rot=wp.quat_identity(),
                scale=1.0,
                vel=wp.vec3(0.0, 0.0, 0.0),
                vertices=[wp.vec3(*node) for node in mesh.nodes],
                indices=mesh.tets.ravel().tolist(),
                density=beam.DENSITY,
                k_mu=mu,
                k_lambda=lam,
                k_damp=0.0,
                add_surface_mesh_edges=False,
            )
            for node in beam.clamped(mesh.nodes):
                builder.particle_mass[first + node] = 0.0
                builder.particle_flags[first + node] &= ~int(newton.ParticleFlags.ACTIVE)
        builder.color()
        self.model = builder.finalize(device="cpu")
        self.solver = newton.solvers.SolverVBD(
            self.model, iterations=self.iterations, particle_enable_self_contact=False, particle_enable_tile_solve=False
        )
        self.control = self.model.control()
        self.state, self.other = self.model.state(), self.model.state()
        self.advance()  # loads kernels, which a recording cannot
        with wp.ScopedCapture(device="cpu") as capture:
            self.advance()
        self.graph = capture.graph

    def advance(self) -> None:
        """One step; an even number of sub-steps ends in the state where it began."""
        before, after = self.state, self.other
        for _ in range(self.substeps):
            before.clear_forces()
            self.solver.step(before, after, self.control, None, beam.DT / self.substeps)
            before, after = after, before

    def let_go(self) -> None:
        """Straighten all worlds."""
        self.state.assign(self.model.state())

    def swing(self, steps: int) -> None:
        """All worlds."""
        self.let_go()
        for _ in range(steps):
            wp.capture_launch(self.graph)

    def sag(self, steps: int) -> float:
        """Of the first world, stopped whenever it becomes slower, since nothing damps it; a quarter of the steps."""
        self.let_go()
        count, last = len(self.start), 0.0
        for _ in range(steps // 4):
            wp.capture_launch(self.graph)
            velocity = self.state.particle_qd.numpy()[:count]
            energy = float(self.mass @ np.square(velocity).sum(axis=1))
            if energy < last:
                self.state.particle_qd.zero_()
                energy = 0.0
            last = energy
        return beam.sag(self.start, self.state.particle_q.numpy()[:count])


@register("newton, converged")
class NewtonConverged(Newton):
    """Newton with steps so short that vertex block descent converges."""

    settings = "VBD, 100 sub-steps of 3 iterations"  # the cheapest tried whose sag is within 1 %
    substeps, iterations = 100, 3


@register("genesis")
class Genesis(Runner):
    """Genesis' implicit finite elements.

    It makes tetrahedra of a surface; for those that all others have, the functions that do are replaced meanwhile. It
    takes as many threads as there are cores, by the only way that it offers, a variable of the environment.
    """

    module, package, install = "genesis", "genesis-world", "genesis-world"
    settings = "implicit FEM, linear corotated, 500 iterations"
    iterations = 500

    def __init__(self, worlds: int, cores: int) -> None:
        import genesis
        from genesis.utils import element

        super().__init__(worlds, cores)
        self.steps = SWING if worlds == 1 else 2
        if not genesis._initialized or os.environ.get("QD_NUM_THREADS") != str(cores):
            genesis.destroy()
            os.environ["QD_NUM_THREADS"] = str(cores)
            genesis.init(backend=genesis.cpu, precision="32", logging_level="error")
        options, mesh = genesis.options, beam.mesh()
        self.scene = genesis.Scene(
            sim_options=options.SimOptions(
                dt=beam.DT,
                gravity=(0.0, 0.0, -beam.GRAVITY),
                floor_height=-1.0,  # m; the floor at 0 would carry the beam
            ),
            fem_options=options.FEMOptions(
                use_implicit_solver=True,
                enable_vertex_constraints=True,
                n_pcg_iterations=self.iterations,
                damping_alpha=0.0,
                damping_beta=beam.DAMPING,
            ),
            show_viewer=False,
        )
        material = genesis.materials.FEM.Elastic(E=beam.YOUNGS, nu=beam.NU, rho=beam.DENSITY, model="linear_corotated")
        with (
            mock.patch.object(element, "mesh_to_elements", lambda surface, tet_cfg: (mesh.nodes, mesh.tets)),
            mock.patch.object(element, "split_all_surface_tets", lambda nodes, tets: (nodes, tets)),
        ):
            box = genesis.morphs.Box(size=beam.SIZE, pos=tuple(0.5 * edge for edge in beam.SIZE))
            self.body = self.scene.add_entity(morph=box, material=material)
        self.scene.build(n_envs=worlds)
        self.start = self.body.init_positions.cpu().numpy()
        self.nodes, self.tets = len(self.start), len(self.body.elems)
        self.body.set_vertex_constraints(beam.clamped(self.start))

    def swing(self, steps: int) -> None:
        """All worlds."""
        self.scene.reset()
        for _ in range(steps):
            self.scene.step()

    def sag(self, steps: int) -> float:
        """Of the first world."""
        self.swing(steps)
        return beam.sag(self.start, self.body.get_state().pos[0].cpu().numpy())


@register("genesis, fewer iterations")
class GenesisFewer(Genesis):
    """Genesis with as many iterations as its linear solve needs here: it launches all of them, converged or not."""

    settings = "implicit FEM, linear corotated, 160 iterations"
    iterations = 160


def main(arguments: Sequence[str]) -> int:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench peers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--filter", default="", metavar="TEXT", help="only simulators with TEXT in their names")
    parser.add_argument("--worlds", type=int, default=WORLDS, help="of the batch, on all cores")
    parser.add_argument("--cores", type=int, help="cores of the batch; all that there are if left out")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--settle", type=int, default=SETTLE, help="steps until the beam rests")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(arguments)
    names = [name for name in RUNNERS if name == "softwarp" or args.filter in name]
    absent = [name for name in names if name != "softwarp" and RUNNERS[name].missing()]
    present = [name for name in names if name not in absent]
    print(f"not installed: {', '.join(dict.fromkeys(map(advice, absent))) or 'none'}", flush=True)
    records: list[dict[str, Any]] = []
    sags: dict[str, float] = {}
    for worlds, limit in ((1, 1), (args.worlds, args.cores)):
        with limited_cores(limit) as cores:
            records += compare(present, worlds, cores, args.repeats, args.settle, sags)
        save(records, args.json)
    print(f"\n{table(records)}")
    return 0


def advice(name: str) -> str:
    """A simulator and what installs it."""
    runner = RUNNERS[name]
    return f"{runner.module} (pip install {runner.install})"


def compare(
    names: Sequence[str], worlds: int, cores: int, repeats: int, settle: int, sags: dict[str, float]
) -> list[dict[str, Any]]:
    """Build every simulator, then time them in turns; ``sags`` [m] is filled where a simulator is missing in it."""
    clock = time.process_time if cores == 1 else time.perf_counter
    runners = {name: RUNNERS[name](worlds, cores) for name in names}
    samples: dict[str, list[float]] = {name: [] for name in names}
    for repeat in range(1 + repeats):  # the first is for compilers and caches
        for name, runner in runners.items():
            if sum(samples[name]) * runner.steps > BUDGET:
                continue
            start = clock()
            runner.swing(runner.steps)
            if repeat:
                samples[name].append((clock() - start) / runner.steps)
    records = []
    for name, runner in runners.items():
        if name not in sags:
            sags[name] = runner.sag(settle)
        record: dict[str, Any] = {
            "engine": name,
            "version": runner.version(),
            "settings": runner.settings,
            "worlds": worlds,
            "nodes": runner.nodes,
            "tets": runner.tets,
        }
        record |= summary(samples[name], worlds)
        record["times_softwarp"] = record["ms_per_step"] / (1e3 * statistics.median(samples["softwarp"]))
        record["sag_mm"] = 1e3 * sags[name]
        record["note"] = runner.notes()
        record |= machine("cpu", cores) | {"cores": cores}
        print("  ".join(cells(record)), flush=True)
        records.append(record)
    return records


HEAD = (
    "simulator",
    "settings",
    "worlds",
    "cores",
    "ms per step",
    "best",
    "world-steps/s",
    "softwarp is",
    "sag",
    "note",
)


def cells(record: dict[str, Any]) -> tuple[str, ...]:
    """A row of the table."""
    return (
        f"{record['engine']} {record['version']}",
        record["settings"],
        str(record["worlds"]),
        str(record["cores"]),
        f"{record['ms_per_step']:.3g}",
        f"{record['ms_min']:.3g}",
        f"{record['world_steps_per_s']:.0f}",
        f"{record['times_softwarp']:.1f} x faster",
        f"{record['sag_mm']:.1f} mm",
        record["note"],
    )


def table(records: list[dict[str, Any]]) -> str:
    """Records as a Markdown table."""
    about = records[0]
    lines = [
        f"{about['hardware']}; commit {about['commit']}; sag of the tip: {1e3 * beam.LINEAR:.1f} mm for linear "
        f"tetrahedra on these cells, {1e3 * beam.CONVERGED:.1f} mm converged",
        "",
        "| " + " | ".join(HEAD) + " |",
        "|" + "---|" * len(HEAD),
    ]
    return "\n".join([*lines, *("| " + " | ".join(cells(record)) + " |" for record in records)])
