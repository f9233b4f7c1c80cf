"""``Simulation``: a batch of worlds of one scene, stepped together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import warp as wp

from softwarp import checks, compiling, growth, interop
from softwarp.measures import Measures
from softwarp.model import memory
from softwarp.model.model import Model
from softwarp.model.state import Control, Parameters, State, create, create_parameters, worlds_slice
from softwarp.scene import Handle
from softwarp.snapshot import Snapshot
from softwarp.solvers.footprint import require_room, with_room
from softwarp.solvers.linear.cholesky import upload
from softwarp.solvers.looks import chosen_looks
from softwarp.solvers.options import Integrator, Options
from softwarp.solvers.outputs import update_outputs
from softwarp.solvers.partition import GPU_PATHS, SolverPath, choose_variant, free_ranges, thread_count
from softwarp.solvers.quasi_static import QuasiStatic
from softwarp.solvers.relaxation import Relaxation
from softwarp.solvers.repeats import repeats_steps
from softwarp.solvers.second_order import stepper
from softwarp.solvers.system import System
from softwarp.statics import StaticResult as StaticResult
from softwarp.statics import Statics
from softwarp.threads import Workers, alone
from softwarp.unpicklable import Unpicklable

if TYPE_CHECKING:
    import torch

Item = TypeVar("Item")
Made = TypeVar("Made")

LONGEST = 1.0e6  # s, of a step
TOLD = 64  # statuses of steps that are kept before they are made one


class Simulation(
    Measures, Statics, Unpicklable, instead="send sim.snapshot() and the ModelBuilder of its model, and make it there"
):
    """Worlds of one model, advanced by backward Euler.

    All views are torch tensors that share memory with the simulator and stay valid for its life; clone what should
    survive the next step. Worlds never influence each other, and a world whose step fails is put back to its state
    before that step and reports it in ``status``. Threads may make and step simulations at the same time, each its own.

    Args:
        model: Scene, from ``ModelBuilder.finalize``.
        dt: Time step [s].
        newton_iterations: 1 linearises once per step; more solve the nonlinear equations to ``newton_tolerance``.
        integrator: ``euler``, backward Euler: one solve a step, first order, damps by half of omega dt; ``bdf2``, of
            second order in two solves (three in scenes with contact): at dt of a thirteenth of a period, it slows
            motion by 1 % and damps by a ratio of 4e-4, and first order only in worlds while they touch something;
            ``trapezoidal``, also in two, damps nothing, and is ``bdf2`` in scenes with cables, chambers, joints or
            contact, whose forces would ring.
        newton_tolerance: Relative force imbalance; None takes 1e-3 in float32 and 1e-9 in float64.
        refinement: Iterative refinement passes of every linear solve; None takes 1 in float32 and 0 in float64.
        contact_passes: Times that a step measures its contacts anew where it leads to and corrects itself; bodies that
            spin by half a radian in a step need 2 or 3. Without effect on Newton iterations, which do more. None takes
            1, and more in worlds that still move: in scenes with telescopes, whose lines snap across a lumen in a step,
            up to 3, as long as a correction moves something by more than a tenth of the line's radius, or their sweeps
            run out; where soft bodies meet each other up to 2, beyond a quarter of an element's edge.
        most_swing: Turn or stretch [rad] of a segment of a telescope in a step of one Newton iteration, beyond which
            its world goes only that much of its way: a linearisation holds no farther, and what crumples would cross
            its vessel. Steps below it keep their bits.
        repeat_swing: Likewise, beyond which a world takes a step of one Newton iteration again, by up to 20: what turns
            by more is lengthened, and pressed into the wall in the next step. 0.1 serves long lines in narrow vessels,
            of which about one step in a hundred is taken again. Steps below it keep their bits.
        gauss_seidel_iterations: Sweeps of the multiplier solver per linear solve, at most.
        gauss_seidel_tolerance: Correction of a gap, in extents of the scene, that ends the sweeps of a world; None
            takes 1e-7 in float32 and 1e-10 in float64. Steps shorter than 10 ms reduce it.
        recovery_speed: Speed [m/s] at which what penetrates is pushed apart.
        recovery_time: Time [s] in which penetration shrinks by half or more; 0 takes all back in one step.
        bounce_speed: Approach [m/s] up to which a contact with restitution does not bounce.
        project_tangent: Use positive semidefinite element tangents for hyperelastic laws.
        pressure_tangent: Use the tangent of chamber pressures, which may be indefinite; None takes it with Newton
            iterations.
        reach: Multiple of the scene's extent that a node may travel in one step before its world is failed.
        solver_path: On a CPU, ``scalar`` (one world at a time), ``lanes`` (eight in SIMD lanes, float32) or ``auto``;
            on a GPU, ``panels`` (a thread block per world), ``levels`` (one for many, in large batches) or ``auto``.
            Results are equal to the bit for one path, and to rounding between paths. ``auto`` takes another path for
            1 to 3 worlds than for more (GPU: from 1001 on): name one where batches of different sizes must agree.
        threads: CPU threads to spread worlds over; None takes all cores.
        contact_growth: Make room for more contacts where a step finds too little, and repeat that step, as if there
            had been room from the start. Every step is copied before it, and on a GPU waited for; without, contacts
            that find no place are left out and told, see ``contact_overflow``.

    Raises:
        ValueError: For a value outside its range; the message names it.
        MemoryError: If the worlds do not fit on the device; the message tells how many do.
    """

    @alone
    def __init__(
        self,
        model: Model,
        dt: float = 0.01,
        newton_iterations: int = 1,
        *,
        integrator: Integrator = "euler",
        newton_tolerance: float | None = None,
        refinement: int | None = None,
        contact_passes: int | None = None,
        most_swing: float = 0.5,
        repeat_swing: float = float("inf"),
        gauss_seidel_iterations: int = 100,
        gauss_seidel_tolerance: float | None = None,
        recovery_speed: float = 0.5,
        recovery_time: float = 0.02,
        bounce_speed: float = 0.01,
        project_tangent: bool = True,
        pressure_tangent: bool | None = None,
        reach: float = 1.0,
        solver_path: SolverPath = "auto",
        threads: int | None = None,
        contact_growth: bool = False,
    ) -> None:
        if not isinstance(model, Model):
            raise TypeError(f"Simulation: model must be what ModelBuilder.finalize returns, got {checks.shown(model)}")
        if model.telescopes is not None and integrator != "euler":
            raise ValueError(
                f"Simulation: integrator {integrator!r} cannot advance telescopes, whose nodes slide; use 'euler'"
            )
        if model.floating_count and integrator != "euler":
            raise ValueError(
                f"Simulation: integrator {integrator!r} cannot advance reduced bodies with a floating frame; use "
                "'euler', or a reduction with frame='fixed'"
            )
        is_double = model.precision == "float64"
        self.model = model
        sweeps_end = gauss_seidel_tolerance
        is_iterated = isinstance(newton_iterations, int) and newton_iterations > 1
        looks = chosen_looks(model) if contact_passes is None else {"contact_passes": contact_passes}
        self.options = Options(
            integrator=integrator,
            newton_iterations=newton_iterations,
            newton_tolerance=(1e-9 if is_double else 1e-3) if newton_tolerance is None else newton_tolerance,
            refinement=(0 if is_double else 1) if refinement is None else refinement,
            most_swing=most_swing,
            repeat_swing=repeat_swing,
            gauss_seidel_iterations=gauss_seidel_iterations,
            gauss_seidel_tolerance=(1e-10 if is_double else 1e-7) if sweeps_end is None else sweeps_end,
            recovery_speed=recovery_speed,
            recovery_time=recovery_time,
            bounce_speed=bounce_speed,
            project_tangent=project_tangent,
            pressure_tangent=is_iterated if pressure_tangent is None else pressure_tangent,
            reach=reach,
            gpu_path=solver_path if solver_path in GPU_PATHS else "auto",
            **looks,
        )
        require_room(model, solver_path, threads, self.options, reclaim=interop.empty_cache)
        self.variant = choose_variant(model, solver_path)
        self._state = create(State, model)
        self._control = create(Control, model)
        self._parameters = create_parameters(model)
        self._views = interop.views(self._state, model)
        self._aliases = interop.frame_aliases(self._views, model, "frame_pose", "frame_twist")
        control = interop.views(self._control, model)
        self.control = interop.Views("sim.control", control, interop.force_aliases(control, model))
        self.params = interop.Views("sim.params", interop.views(self._parameters, model))
        self._index = upload(model.symbolic, model.device)
        uneven = repeats_steps(model, self.options)
        self._bounds, is_free = free_ranges(self.variant, model, threads, uneven)
        self._shares_workspaces = not is_free
        self._turns = min(thread_count(threads), len(self._bounds))  # shards side by side; others wait for theirs
        self._systems = self._make_shards(model, self._state)
        self._contact_growth = checks.flag(contact_growth, "Simulation: contact_growth") and model.contact is not None
        self._workers = Workers(self._turns) if self._turns > 1 else None
        self._exact: tuple[Model, dict[str, wp.array]] | None = None
        self._statics: list[QuasiStatic] | None = None
        self._relaxations: dict[bool, list[Relaxation]] | None = None
        self._initial: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}  # view and what reset writes into it
        self.revision = 0  # counts the changes that a graph with steps or resets in it would not notice
        self.dt = dt
        self._set_rest()
        launching = [*(s.refresh for s in self._systems), self._update_outputs, *(s.step for s in self._steppers)]
        compiling.ahead(launching, self.device, interop.capturing(self.device))
        self.refresh()
        self.set_initial()

    def _make_shards(
        self, model: Model, state: State, control: Control | None = None, parameters: Parameters | None = None
    ) -> list[System]:
        """Systems for the worlds of each shard, with the room for contacts that ``model`` has.

        Those of other worlds, with commands of their own, have workspaces of their own.
        """

        def make(bounds: tuple[int, int]) -> System:
            return System(
                model,
                self._index,
                self.variant,
                worlds_slice(state, *bounds),
                worlds_slice(control or self._control, *bounds),
                worlds_slice(parameters or self._parameters, *bounds),
                self.options,
            )

        return self._in_turns(make, self._bounds) if control is None else [make(bounds) for bounds in self._bounds]

    def _in_turns(self, make: Callable[[Item], Made], items: Sequence[Item]) -> list[Made]:
        """What ``make`` makes for every shard, in the same memory for shards that one thread steps in turns.

        A step finds and leaves nothing in its workspace, and a core's cache holds one, not those of a batch.
        """
        if not self._shares_workspaces:
            return [make(item) for item in items]
        pools, made = [memory.Pool() for _ in range(self._turns)], []
        for number, item in enumerate(items):
            with memory.pooled(pools[number % self._turns]):
                made.append(make(item))
        return made

    def _set_rest(self) -> None:
        """Positions and poses of the builder into the state, poses of rigid bodies also into their commands."""
        import torch

        model, views = self.model, self._views
        rest = {"node_x": model.node_rest, "good_x": model.node_rest}
        if model.frames is not None:
            f, rigid = model.frames, slice(model.rigid_count)
            rest |= {"frame_pose": f.rest_pose, "good_pose": f.rest_pose}
            rest |= {"frame_twist": f.rest_twist, "good_twist": f.rest_twist}
            rest |= {"held_pose": f.rest_pose[rigid], "seen_pose": f.rest_pose[rigid]}
        if model.floating_count:
            rest |= {"mode_turn": model.turn_rest, "good_mode_turn": model.turn_rest}
        if model.telescopes is not None:
            t = model.telescopes
            rest |= {"tube_length": t.start_length, "tube_angle": t.start_angle}
            rest |= {"base_angle": t.start_base, "windup": t.start_windup}
            rest |= {f"good_{name.split('_')[-1]}": rest[name] for name in ("tube_length", "tube_angle", "windup")}
            rest["good_base"] = t.start_base
        commands = self.control.tensors()
        for target, values in ((views, rest), (commands, model.start_commands())):
            for name, value in values.items():
                target[name].copy_(torch.as_tensor(value))

    @property
    def num_worlds(self) -> int:
        """Worlds in the batch."""
        return self.model.num_worlds

    @property
    def systems(self) -> tuple[System, ...]:
        """The linearised systems of the shards; those that a thread steps in turns share a workspace."""
        return tuple(self._systems)

    @alone
    def keep_solutions(self) -> tuple[System, ...]:
        """Give every shard a workspace of its own, where the solution of its last step stays; for gradients.

        Returns:
            The linearised systems of the shards from now on.

        Raises:
            MemoryError: If there is no room for them.
        """
        if self._shares_workspaces and self._turns < len(self._bounds):
            self._shares_workspaces = False
            make = partial(self._make_shards, self.model, self._state)
            self._systems = with_room(make, "kept solutions", self.model, interop.empty_cache)
            self.dt = self._dt  # steps and their graphs anew
        return self.systems

    @property
    def device(self) -> str:
        """Warp device name."""
        return self.model.device

    @property
    def dt(self) -> float:
        """Time step [s]; may be changed between steps."""
        return self._dt

    @dt.setter
    @alone
    def dt(self, value: float) -> None:
        self._dt = checks.number(value, "dt [s]", above=0.0, high=LONGEST)
        self._steppers = self._in_turns(lambda system: stepper(system, self._dt), self._systems)
        self._graphs: list[Any] | None = None
        self._is_compiled = False
        self.revision += 1

    def __getattr__(self, name: str) -> torch.Tensor:
        held = self.__dict__
        for views in (held.get("_views", {}), held.get("_aliases", {})):
            if name in views:
                return views[name]  # type: ignore[no-any-return]
        valid = ", ".join(sorted({**held.get("_views", {}), **held.get("_aliases", {})}))
        raise AttributeError(f"Simulation has no attribute {name!r}; views are {valid}")

    def __setattr__(self, name: str, value: Any) -> None:
        interop.refuse_assignment("sim", name, value, self.__dict__.get("_views"), self.__dict__.get("_aliases"))
        super().__setattr__(name, value)

    # Advancing

    def step(self, count: int = 1) -> None:
        """Advance every world by ``dt``, in place, or by several steps under the same commands.

        Several steps at once take less time, above all in small scenes on a CPU. ``status`` tells the worst of them.

        Args:
            count: Number of steps, at least 1.
        """
        count = checks.count(count, "step: count")
        is_captured = interop.is_captured_by_torch(self.device)
        if self._contact_growth and not is_captured:
            self._advance_growing(count)
        else:
            self._advance(count, is_captured)

    def _advance(self, count: int, is_captured: bool) -> None:
        """Take steps with the present room for contacts."""
        if count > 1 and not self._is_compiled and not is_captured and interop.records(self.device):
            self._advance(1, is_captured=False)  # compiles, so that all others can be a recording
            first = self._views["status"].clone()
            self._advance(count - 1, is_captured=False)
            self._views["status"].copy_(interop.worst_of([first, self._views["status"]]))
            return
        if self._is_compiled and self._graphs is None and not is_captured and interop.records(self.device):
            self._capture()
        if self._graphs is None or is_captured:  # the first step compiles kernels, which a capture cannot
            with interop.on_torch_stream(self.device):
                for shard, stepper in enumerate(self._steppers):
                    stepper.always = is_captured  # a recording of Torch cannot branch
                    self._repeat(shard, stepper.step, count)
                    stepper.always = False
                self._update_outputs()
            self._is_compiled = True
            return
        with interop.replaying(self.device):
            self._replay(self._graphs, count)

    def _advance_growing(self, count: int) -> None:
        """Take steps, and repeat them from their start with more room where a world found no place for a contact."""
        before = {name: view.clone() for name, view in self._views.items() if view.numel()}
        self.contact_overflow.zero_()
        self._advance(count, is_captured=False)
        while missing := int(self.contact_overflow.max()):
            for name, value in before.items():
                self._views[name].copy_(value)
            self.grow_contacts(growth.more_room(self.model, missing))
            room = self.model.contact_capacity
            before |= {name: growth.fitted(name, before[name], room) for name in growth.contact_arrays()}
            self.contact_overflow.zero_()
            self._advance(count, is_captured=False)
        self.contact_overflow.copy_(before["contact_overflow"])

    def _replay(self, graphs: Sequence[Any], count: int) -> None:
        """Replay the graphs of the shards, on a CPU side by side and then that of the outputs, which is the last."""
        queue = iter(range(len(self._systems)))  # of threads whose shards have memory of their own: who is free goes on

        def run(turn: int) -> None:
            for shard in range(turn, len(self._systems), self._turns) if self._shares_workspaces else queue:
                self._repeat(shard, partial(wp.capture_launch, graphs[shard]), count)

        try:
            if self._workers is None:
                run(0)
            else:
                self._workers.run(run, range(self._turns), helping=count == 1)  # a single launch, which nothing cuts
        finally:  # also on an interrupt
            if len(graphs) > len(self._systems):
                wp.capture_launch(graphs[-1])
            else:
                self._update_outputs()

    def _repeat(self, shard: int, advance: Callable[[], None], count: int) -> None:
        """Take the worlds of a shard through ``count`` steps and keep the worst status."""
        advance()
        if count == 1:
            return
        status = self._views["status"][slice(*self._bounds[shard])]
        told = [status.clone()]
        for _ in range(count - 1):
            advance()
            told.append(status.clone())
            if len(told) == TOLD:
                told = [interop.worst_of(told)]
        status.copy_(interop.worst_of(told))

    def refresh(self) -> None:
        """Recompute markers, cable points and lengths after ``node_x`` or ``node_v`` was written by hand."""
        with interop.on_torch_stream(self.device):
            for system in self._systems:
                system.refresh()
            self._update_outputs()

    def contact_force(self, a: Handle | int, b: Handle | int) -> torch.Tensor:
        """Force that part b exerted on part a in the last step, summed over their contacts [N], shape (world, 3).

        Raises:
            ValueError: If the parts are no contact pair. A plain index means a soft body.
        """
        if self.model.contact is None:
            raise ValueError("the scene has no contact pairs; use ModelBuilder.add_contact")
        pair, sign = self.model.contact.find(a, b)
        force: torch.Tensor = sign * self._views["pair_force"][:, pair]
        return force

    @alone
    def grow_contacts(self, capacity: int) -> None:
        """Give every world room for more contacts; state, commands and what ``reset`` returns to stay as they are.

        Views with a row for every contact (``contact_key``, ``contact_force``, ``contact_point`` ...) are new tensors
        from then on: take them from the simulation again. All others stay valid.

        Args:
            capacity: Contacts that a world can hold, at least as many as now.

        Raises:
            ValueError: For fewer than there is room for, and in scenes without contact pairs.
            MemoryError: If they do not fit on the device; nothing has changed then.
        """
        model, present = self.model.with_contact_capacity(capacity), self.model.contact_capacity
        if model.contact_capacity <= present:
            if model.contact_capacity < present:
                need = f"be at least {present}, the room that there is"
                raise ValueError(checks.refusal("grow_contacts: capacity", need, capacity))
            return
        initial = {key: value for key, (_, value) in self._initial.items()}
        state = growth.widened_state(self._state, model)
        make = partial(self._make_shards, model, state)
        self._systems = with_room(make, "room for contacts", model, interop.empty_cache)
        self.model, self._state = model, state
        self._views = interop.views(state, model)
        self._aliases = interop.frame_aliases(self._views, model, "frame_pose", "frame_twist")
        for name in growth.contact_arrays():
            initial[f"state.{name}"] = growth.fitted(name, initial[f"state.{name}"], model.contact_capacity)
        views = self._all_views()
        self._initial = {key: (views[key], value) for key, value in initial.items()}
        self._statics = self._relaxations = None
        self.dt = self._dt  # steps and their graphs anew

    def _capture(self) -> None:
        records = [stepper.step for stepper in self._steppers]
        if not self.variant.world_fastest:  # on a CPU a replay needs no turn with Warp, a launch does
            records.append(self._update_outputs)
        graphs = []
        for record in records:
            with interop.capturing(self.device) as capture:
                record()
            graphs.append(capture.graph)
        self._graphs = graphs

    def _update_outputs(self) -> None:
        update_outputs(self.model, self._state, world_fastest=self.variant.world_fastest)

    @alone
    def make_systems(self, more_sides: int, *, exact: bool = False) -> list[tuple[slice, System]]:
        """The linearised system of each shard's worlds, with a workspace of its own; for control.

        Args:
            more_sides: Right-hand sides for rows of the caller, besides those of the model.
            exact: Make room for the exact tangent, as ``solve_static`` does; for soft bodies with cables and chambers.

        Returns:
            Worlds of the batch and their system.

        Raises:
            ValueError: If the scene has parts whose exact tangent is not known.
        """
        if exact and not self._systems[0].has_exact_tangent:
            raise ValueError(
                "exact systems know soft bodies of tetrahedra, cables and chambers; this scene has other parts, do "
                "without exact, or mesh hexahedra with add_tets(mesh.linear())"
            )
        options, model, index = self.options, self.model, None
        if exact:
            options = replace(options, project_tangent=False)
            model, index = self._coupled()

        def make() -> list[System]:
            return [system.with_options(options, model, index, more_sides, exact=exact) for system in self._systems]

        systems = with_room(make, "control", model, interop.empty_cache)
        return [(slice(*bounds), system) for bounds, system in zip(self._bounds, systems, strict=True)]

    @alone
    def make_twins(self, state: State, control: Control, parameters: Parameters) -> list[tuple[slice, System]]:
        """Systems that step other worlds of this scene as this simulation would, to the bit; for gradients.

        Args:
            state: Of as many worlds.
            control: Likewise.
            parameters: Likewise.

        Returns:
            Worlds of each shard and their system, with a workspace of its own.

        Raises:
            MemoryError: If they do not fit on the device.
        """
        make = partial(self._make_shards, self.model, state, control, parameters)
        systems = with_room(make, "other worlds", self.model, interop.empty_cache)
        return [(slice(*bounds), system) for bounds, system in zip(self._bounds, systems, strict=True)]

    def law_parameter(self, body: int, name: str) -> torch.Tensor:
        """View of one parameter of a soft body's law, shape (world,); written values hold from the next step on.

        Args:
            body: From ``add_tets``.
            name: Such as ``"c10"`` of ``Yeoh``, or ``"bulk"``.

        Raises:
            ValueError: If there is no such body, or its law has no such parameter; the message lists the nearest.
        """
        values: torch.Tensor = self.params.law_parameter
        return values[:, self.model.law_row(body, name)]

    # Saving and resetting

    def _all_views(self) -> dict[str, torch.Tensor]:
        groups = {"state": self._views, "control": self.control.tensors(), "params": self.params.tensors()}
        return {f"{group}.{name}": tensor for group, tensors in groups.items() for name, tensor in tensors.items()}

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """All views of the state by name, without those that are only other names for parts of them."""
        return dict(self._views)

    def snapshot(self, worlds: Iterable[int] | torch.Tensor | None = None) -> Snapshot:
        """Copy everything that the next steps of some worlds depend on.

        Args:
            worlds: World indices; None takes all.
        """
        index = self._world_index(worlds)
        arrays = {key: value.index_select(0, index) for key, value in self._all_views().items()}
        return Snapshot(self.model.fingerprint, self.model.precision, arrays)

    def restore(self, snapshot: Snapshot, worlds: Iterable[int] | torch.Tensor | None = None) -> None:
        """Put a snapshot into some worlds; one saved world may go to many.

        Args:
            snapshot: Of this scene, taken from any batch on any device.
            worlds: World indices; None takes all.

        Raises:
            ValueError: If the snapshot belongs to another scene, precision or version, is damaged, or the numbers of
                worlds do not match; nothing has changed then.
            TypeError: If it is no snapshot.
        """
        if not isinstance(snapshot, Snapshot):
            kind = type(snapshot).__name__
            raise TypeError(f"restore takes a Snapshot, got {kind}; sim.snapshot() and Snapshot.load(path) give one")
        snapshot.check_scene(self.model.fingerprint, self.model.precision)
        needed = snapshot.contacts_held(self.model.contact_capacity)
        if needed > self.model.contact_capacity and self._contact_growth:
            self.grow_contacts(needed)
        snapshot = snapshot.with_room(self.model.contact_capacity)
        index, views = self._world_index(worlds), self._all_views()
        snapshot.check_fit(self.model.fingerprint, self.model.precision, views, len(index))
        moved = {
            key: snapshot.arrays[key].to(view.device)
            for key, view in views.items()
            if view.numel() and key in snapshot.arrays
        }
        for key, value in moved.items():
            views[key].index_copy_(0, index, value.expand(len(index), *value.shape[1:]))

    def set_initial(self) -> None:
        """Make the present state and commands of every world what ``reset`` returns to."""
        views = self._all_views().items()
        kept = {key: view for key, view in views if view.numel() and not key.startswith("params.")}
        self._initial = {key: (view, view.clone()) for key, view in kept.items()}
        self.revision += 1

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Return worlds to their initial state and commands; parameters stay.

        Args:
            mask: Worlds to reset, bool, shape (world,); None resets all.
        """
        import torch

        if mask is None:
            for view, value in self._initial.values():
                view.copy_(value)
            return
        if not isinstance(mask, torch.Tensor) or mask.dtype != torch.bool or mask.shape != (self.num_worlds,):
            need = f"be a bool tensor of shape ({self.num_worlds},)"
            raise ValueError(checks.refusal("reset mask", need, mask))
        chosen = mask.to(self._views["time"].device)
        for view, value in self._initial.values():
            torch.where(chosen.reshape(-1, *[1] * (view.ndim - 1)), value, view, out=view)

    def _world_index(self, worlds: Iterable[int] | torch.Tensor | None) -> torch.Tensor:
        return interop.world_index(worlds, self.num_worlds, self._views["time"].device)
