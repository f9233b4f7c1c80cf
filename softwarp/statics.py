"""``Simulation.solve_static``: which way a scene goes to its equilibrium, and what is told of it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from softwarp import checks, interop, notices
from softwarp.model.codes import TURNED, StaticReason, Status
from softwarp.model.model import Model
from softwarp.plan.compile import coupled
from softwarp.solvers.footprint import with_room
from softwarp.solvers.linear.cholesky import upload
from softwarp.solvers.options import Options
from softwarp.solvers.quasi_static import QuasiStatic
from softwarp.solvers.relaxation import AWAY, GOING_ON, NEWTON_ITERATIONS, STRAYED, Course, Relaxation
from softwarp.solvers.system import System
from softwarp.static_advice import advice, departure
from softwarp.threads import alone

if TYPE_CHECKING:
    import torch

CHUNK = 5  # iterations on a GPU between two looks at the residual; a CPU looks after each
STEADY = ("node_v", "frame_twist", "mode_v", "good_v", "good_twist", "good_mode_v")  # zero at rest


PLACES = ("node_x", "frame_pose")


@dataclass(frozen=True)
class StaticResult:
    """Outcome of ``Simulation.solve_static``.

    Attributes:
        residual: Shape (world,). Of soft bodies with cables: force imbalance relative to the forces that balance, plus
            constraint violation per cable length. Of other scenes, and where such worlds had to be settled: way of the
            last step per extent of the scene. It is infinite only where not one step or iterate had a finite one, as
            with the reason ``NOT_FINITE``.
        iterations: Newton iterations, and steps where worlds are settled by steps, of the slowest world.
        converged: Whether each world is in equilibrium, shape (world,): its reason is ``CONVERGED`` or ``ROUNDING``.
        reason: Why the solve let go of each world.
        advice: What keeps each world from equilibrium and the way out, in words; empty for one that is there.
    """

    residual: torch.Tensor
    iterations: int
    converged: torch.Tensor
    reason: tuple[StaticReason, ...]
    advice: tuple[str, ...]


class _Watch:
    """Tells how a solve goes from when it has taken two seconds, and when its time is up.

    Args:
        worlds: Number of worlds.
        max_seconds: Limit [s]; None has no limit.
    """

    def __init__(self, worlds: int, max_seconds: float | None) -> None:
        self.worlds, self.state = worlds, "first iteration"
        self.end = np.inf if max_seconds is None else time.monotonic() + max_seconds
        self.line = notices.Progress()

    def over(self) -> bool:
        """Whether the time is up."""
        self.line.show("solve_static", self.state)
        return time.monotonic() >= self.end

    def note(self, count: int, limit: int, done: int, residual: float) -> None:
        """What the line says from now on."""
        of = f", {done} of {self.worlds} worlds have arrived" if self.worlds > 1 else ""
        self.state = f"iteration {count} of at most {limit}{of}, residual {residual:.1e}"


@dataclass
class _Found:
    """Result on the host: see ``StaticResult``; ``departures`` tell what worlds do that nothing holds."""

    residual: np.ndarray[Any, Any]
    iterations: int
    reasons: np.ndarray[Any, Any]
    departures: dict[int, str] = field(default_factory=dict)

    def take(self, other: _Found, worlds: np.ndarray[Any, Any]) -> None:
        """What another solve has found of some worlds, shape (world,), which went on from here."""
        self.iterations += other.iterations
        self.departures |= other.departures
        self.residual[worlds], self.reasons[worlds] = other.residual[worlds], other.reasons[worlds]

    def result(self) -> StaticResult:
        """The same for users."""
        import torch

        reasons = tuple(StaticReason(int(value)) for value in self.reasons)
        told = tuple(advice(reason, self.departures.get(world)) for world, reason in enumerate(reasons))
        arrived = torch.tensor([reason.is_equilibrium for reason in reasons])
        return StaticResult(torch.from_numpy(self.residual), self.iterations, arrived, reasons, told)


class Statics:
    """Part of ``Simulation``; see there."""

    model: Model
    options: Options
    control: interop.Views
    status: torch.Tensor
    _systems: list[System]
    _bounds: list[tuple[int, int]]
    _views: dict[str, torch.Tensor]
    _exact: tuple[Model, dict[str, wp.array]] | None
    _statics: list[QuasiStatic] | None
    _relaxations: dict[bool, list[Relaxation]] | None

    def _update_outputs(self) -> None:
        raise NotImplementedError

    @alone
    def solve_static(
        self,
        tolerance: float | None = None,
        max_iterations: int = 200,
        *,
        max_seconds: float | None = None,
    ) -> StaticResult:
        """Move every world to its quasi-static equilibrium under the present commands and loads.

        Velocities become zero and time stands still. The solve follows the equilibria from the present state to the
        commands and looks for a stable one; where they end, as when a trunk folds, or where none is near, as of a body
        that has yet to swing below the node it hangs from, worlds are settled as other scenes are. A world that does
        not converge reports ``MAX_ITERATIONS`` and is left at its last iterate, or where it was in equilibrium with a
        part of the change in loads and commands; ``StaticResult.reason`` says why and ``advice`` what to do. One that
        nothing holds, so that it goes away, is put back; ``advice`` names what went and where to.

        Scenes with rods, rigid bodies, chambers, membranes or contact are settled by implicit steps without momentum;
        there the residual is the way of the last, very long step per extent of the scene, and ``tolerance``
        None takes 1e-5 in float32 and 1e-8 in float64. Where rounding keeps ways above that, the world has arrived
        once they have stopped falling within 2e-4 (float64: 1e-7), with a force imbalance within 5e-3 (1e-7): its
        reason is ``ROUNDING``, and ``residual`` says how far it still moves.

        A solve that takes more than two seconds tells how far it is. An interrupt (Ctrl-C) leaves every world in a
        state that it had at the end of an iteration or, where a path is followed, at the start.

        Args:
            tolerance: Relative residual; None takes 1e-4 in float32 and 1e-9 in float64. A converged world is also
                within 5e-4 of the scene's size, by the length of the Newton step. In float32 that alone decides where
                the rounding of coordinates stops the residual below 5e-3.
            max_iterations: Limit of Newton iterations, and of steps.
            max_seconds: Time [s] after which worlds that are still under way are left as at ``max_iterations``.

        Raises:
            ValueError: For a limit outside its range; the message names it.
            MemoryError: If there is no room on the device for the workspace that the solve needs besides.
        """
        follows = self._systems[0].follows_paths
        return self._settle(tolerance, max_iterations, max_seconds, follows=follows)

    @alone
    def follow_static(self, tolerance: float | None = None, max_iterations: int = 200) -> StaticResult:
        """``solve_static`` that follows paths with chambers and cables that stretch, too.

        Faster and more exact from near equilibria, as of gradients. Arguments, result and errors are those of
        ``solve_static``, with the tolerances of paths.
        """
        return self._settle(tolerance, max_iterations, None, follows=self._systems[0].has_exact_tangent)

    def _settle(
        self, tolerance: float | None, max_iterations: int, max_seconds: float | None, *, follows: bool
    ) -> StaticResult:
        if tolerance is not None:
            checks.number(tolerance, "solve_static: tolerance", above=0.0)
        if max_seconds is not None:
            checks.number(max_seconds, "solve_static: max_seconds [s]", above=0.0)
        checks.count(max_iterations, "solve_static: max_iterations")
        watch = _Watch(self.model.num_worlds, max_seconds)
        everything = np.ones(self.model.num_worlds, dtype=bool)
        try:
            if not follows:
                found = self._relax(tolerance, max_iterations, watch, everything)
                if self._systems[0].has_exact_tangent:
                    self._leave_saddles(found, tolerance, max_iterations, watch)
            else:
                found = self._follow(tolerance, max_iterations, watch)
                lost = found.reasons == StaticReason.NO_EQUILIBRIUM
                if lost.any() and not watch.over():
                    found.take(self._relax(tolerance, max_iterations, watch, lost), lost)
            return found.result()
        finally:
            watch.line.end()

    def _follow(self, tolerance: float | None, max_iterations: int, watch: _Watch) -> _Found:
        """``solve_static`` along the path of equilibria."""
        limit = (1e-9 if self.model.precision == "float64" else 1e-4) if tolerance is None else tolerance
        statics = self._paths()
        chunk = CHUNK if self.model.device.startswith("cuda") else 1
        iterations, late = 0, False
        with interop.on_torch_stream(self.model.device):
            for static in statics:
                static.start()
            moving = statics
            while moving and iterations < max_iterations and not late:
                count = min(chunk, max_iterations - iterations)
                for _ in range(count):
                    for static in moving:
                        static.iterate(limit)
                        late = watch.over() or late
                iterations += count
                merits, frozen = (np.concatenate(part) for part in zip(*(s.verdict() for s in statics), strict=True))
                watch.note(iterations, max_iterations, int(frozen.sum()), float(np.max(merits)))
                if iterations == count:
                    broken = ~np.isfinite(merits)  # at its start already: nothing can be found there
                over = frozen | broken
                moving = [s for s, (begin, end) in zip(statics, self._bounds, strict=True) if not over[begin:end].all()]
            lost = np.concatenate([static.lost() for static in statics])
            for static in statics:
                static.finish()
            self._update_outputs()
        self._forget()
        merits, frozen = (np.concatenate(part) for part in zip(*(s.verdict() for s in statics), strict=True))
        statuses = self.status.cpu().numpy().reshape(-1)
        stopped = StaticReason.TIME_LIMIT if late else StaticReason.ITERATION_LIMIT
        reasons = np.where(lost, StaticReason.NO_EQUILIBRIUM, stopped)
        reasons[frozen] = np.where(merits <= limit, StaticReason.CONVERGED, StaticReason.ROUNDING)[frozen]
        reasons[statuses > Status.NONFINITE] = StaticReason.NO_EQUILIBRIUM  # it went away, as what nothing holds
        reasons[(statuses == Status.NONFINITE) | ~np.isfinite(merits)] = StaticReason.NOT_FINITE
        return _Found(np.where(np.isfinite(merits), merits, np.inf), iterations, reasons)

    def _paths(self) -> list[QuasiStatic]:
        """Solvers that follow paths; made once."""
        if self._statics is None:
            exact = replace(self.options, project_tangent=False)
            model, index = self._coupled()

            def make() -> list[QuasiStatic]:
                return [QuasiStatic(s.with_options(exact, model, index, exact=True)) for s in self._systems]

            self._statics = with_room(make, "solve_static", model, interop.empty_cache)
        return self._statics

    def _leave_saddles(self, found: _Found, tolerance: float | None, max_iterations: int, watch: _Watch) -> None:
        """Worlds that steps have led to unstable equilibria, or to none, go on along a path if it ends in a stable one.

        Tangents of steps leave out what softens a body under compression, so that steps creep about the straight shape
        of a column that should have buckled, or call it an equilibrium. What is near an equilibrium that only seems
        unstable, as one of a body that nothing holds, stays where it is.
        """
        try:
            statics = self._paths()
        except MemoryError:  # no room to look
            return
        with interop.on_torch_stream(self.model.device):
            unstable = np.concatenate([static.saddles() for static in statics])
        arrived = found.reasons <= StaticReason.ROUNDING
        lost = np.isin(found.reasons, (StaticReason.NO_EQUILIBRIUM, StaticReason.ITERATION_LIMIT))
        lost[list(found.departures)] = False
        wanted = (arrived & unstable) | lost
        if not wanted.any() or watch.over():
            return
        before = {name: view.clone() for name, view in self._views.items() if view.numel()}
        other = self._follow(None, max_iterations, watch)
        way = np.concatenate([self._ways(before, begin, end) for begin, end in self._bounds])
        taken = wanted & (other.reasons <= StaticReason.ROUNDING) & (lost | (way > STRAYED))
        with interop.on_torch_stream(self.model.device):
            self._put_back(before, taken)
            self._update_outputs()
        if taken.any():
            found.take(self._relax(tolerance, max_iterations, watch, taken), taken)

    def _relax(
        self, tolerance: float | None, max_iterations: int, watch: _Watch, wanted: np.ndarray[Any, Any]
    ) -> _Found:
        """``solve_static`` by steps without momentum, for scenes and worlds to which path following knows no way."""
        has_exact = self._has_exact_tangent()
        if self._relaxations is None or (has_exact.any() and True not in self._relaxations):
            options = replace(self.options, newton_iterations=NEWTON_ITERATIONS, pressure_tangent=True)
            turns = any(law in TURNED for law in self._laws())
            exact = replace(options, project_tangent=False, turning_tangent=turns)

            def make() -> dict[bool, list[Relaxation]]:
                kinds = {False: options, True: exact} if has_exact.any() else {False: options}
                return {
                    key: [Relaxation(system.with_options(o, exact=o.turning_tangent)) for system in self._systems]
                    for key, o in kinds.items()
                }

            self._relaxations = with_room(make, "solve_static", self.model, interop.empty_cache)
        precision = self.model.precision
        limit = (1e-8 if precision == "float64" else 1e-5) if tolerance is None else tolerance
        settled = np.concatenate([relaxation.settled for relaxation in self._relaxations[False]])
        first = self._relaxations[False][0]
        course = Course(settled, precision, limit, len(first.rounds), first.longest, has_exact)
        course.reason[~wanted] = StaticReason.CONVERGED  # as good as there
        start = {name: view.clone() for name, view in self._views.items() if view.numel()}
        arrived = {name: view.clone() for name, view in start.items()} if has_exact.any() else {}
        iterations, late = 0, False
        with interop.on_torch_stream(self.model.device), self._standing():
            while iterations < max_iterations and not late and (course.reason == GOING_ON).any():
                for h, level, is_exact, group in course.groups():
                    stepper = self._relaxations[is_exact]
                    late = late or self._advance_group(course, stepper, h, level, group, start, watch)
                iterations += 1
                self._remember(arrived, course.has_arrived())
                over = course.reason != GOING_ON
                watch.note(iterations, max_iterations, int(over.sum()), float(course.way[wanted].max()))
            gone = course.gone > AWAY
            places = [{n: v[n].double().cpu().numpy() for n in PLACES if n in v} for v in (start, self._views)]
            told = {
                int(world): departure(self.model, *({n: v[world] for n, v in place.items()} for place in places))
                for world in np.flatnonzero(gone)
            }
            if gone.any():
                self._put_back(start, ~gone)
            if course.called_back.any():
                self._put_back(arrived, ~course.called_back)
            self._update_outputs()
        self._forget()
        stopped = StaticReason.TIME_LIMIT if late else StaticReason.ITERATION_LIMIT
        reasons = np.where(course.reason == GOING_ON, stopped, course.reason)
        reasons[~np.isfinite(course.way) & (reasons != stopped)] = StaticReason.NOT_FINITE
        for (begin, end), relaxation in zip(self._bounds, self._relaxations[False], strict=True):
            relaxation.settled[:] = np.where(
                reasons[begin:end] <= StaticReason.ROUNDING, course.longest[begin:end], 0.0
            )
        return _Found(course.way.copy(), iterations, reasons, told)

    def _coupled(self) -> tuple[Model, dict[str, wp.array]]:
        """The scene with room in A for the exact tangent, and its structure on the device; found once."""
        if self._exact is None:
            model = coupled(self.model)
            self._exact = model, upload(model.symbolic, model.device)
        return self._exact

    def _has_exact_tangent(self) -> np.ndarray[Any, Any]:
        """Worlds whose steps can take an exact tangent that differs from the usual one, shape (world,).

        Rods have one, and soft bodies. What cables compress would be held by the stiffness of their tension, which A
        lacks here: they must lie on other parts. Moments whose axes stand in space have no symmetric tangent. Where
        ``_leave_saddles`` looks, elements that turn need not be looked at here.
        """
        m = self.model
        looks_later = self._systems[0].has_exact_tangent
        has_solids = any(law not in TURNED or not looks_later for law in self._laws())
        has_solids = has_solids and m.membranes is None and m.reduction is None
        is_pulled = m.cable_count > 0 and (m.segment_count == 0 or m.point_node.numpy().max() >= m.own_node_count)
        if is_pulled or not (m.segment_count or has_solids):
            return np.zeros(self.model.num_worlds, dtype=bool)
        moments = [force[..., 3:].flatten(1).any(dim=1) for force in (self.control.body_force, self.control.rod_force)]
        return np.asarray(~(moments[0] | moments[1]).cpu().numpy())

    def _laws(self) -> set[str]:
        """Laws of soft bodies, by element."""
        quadratic = self.model.quadratic
        return {*self.model.law_tets, *(() if quadratic is None else quadratic.law_points)}

    def _advance_group(
        self,
        course: Course,
        stepper: list[Relaxation],
        h: float,
        level: int,
        group: np.ndarray[Any, Any],
        start: dict[str, torch.Tensor],
        watch: _Watch,
    ) -> bool:
        """One step of the worlds of a group, all others stay; whether time ran out meanwhile."""
        before = {name: view.clone() for name, view in self._views.items() if view.numel()}
        kept = np.zeros(len(group), dtype=bool)
        late = False
        try:
            self._push(course.push * group / h)
            for (begin, end), relaxation in zip(self._bounds, stepper, strict=True):
                wanted = group[begin:end]
                if not wanted.any() or late:
                    continue
                taken = relaxation.step(h, level, wanted, watch.over)
                late = watch.over()
                frozen, merits = relaxation.balanced(), relaxation.merit()
                indefinite = relaxation.indefinite()
                ways, gone = self._ways(before, begin, end), self._ways(start, begin, end)
                statuses = self._views["status"][begin:end].cpu().numpy().reshape(-1)
                for i in np.flatnonzero(wanted & (frozen | (not late))):
                    told = (int(statuses[i]), bool(frozen[i]), taken, float(ways[i]), float(merits[i]))
                    kept[begin + i] = course.judge(begin + int(i), *told, bool(indefinite[i]), float(gone[i]))
        finally:  # also on an interrupt
            self._put_back(before, kept)
        return late

    def _push(self, speed: np.ndarray[Any, Any]) -> None:
        """Velocities that differ from node to node, and not from world to world: ``speed`` [extent/s], shape (world,).

        An unstable equilibrium stays one without them, as the straight shape of a column that should have buckled.
        """
        if not speed.any():
            return
        import torch

        for name, size in (("node_v", self.model.extent), ("frame_twist", 1.0)):
            view = self._views[name]
            if view.numel():
                noise = np.random.default_rng(0).standard_normal(view.shape[1:])
                if name == "frame_twist" and self.model.frames is not None:
                    noise[:, :3] *= self.model.extent
                    noise[: self.model.rigid_count][self.model.frames.is_kinematic] = 0.0
                by_world = torch.from_numpy(speed * size).reshape(-1, *[1] * (view.ndim - 1)).to(view)
                view.add_(by_world * torch.from_numpy(noise).to(view))

    def _ways(self, before: dict[str, torch.Tensor], begin: int, end: int) -> np.ndarray[Any, Any]:
        """Largest change of a coordinate since ``before`` per extent of the scene, shape (world,)."""
        way = np.zeros(end - begin)
        for name in PLACES:
            if name in before:
                change = (self._views[name][begin:end] - before[name][begin:end]).abs().flatten(1)
                way = np.maximum(way, change.amax(dim=1).cpu().numpy())
        return way / self.model.extent

    def _put_back(self, before: dict[str, torch.Tensor], kept: np.ndarray[Any, Any]) -> None:
        """State of before for all worlds but those ``kept``, which come to rest; time stands still."""
        import torch

        device = self._views["time"].device
        stays = torch.from_numpy(kept).to(device)
        for name, old in before.items():
            view = self._views[name]
            if name == "time":
                view.copy_(old)
            elif not kept.all():
                torch.where(stays.reshape(-1, *[1] * (view.ndim - 1)), view, old, out=view)
            if name in STEADY:
                view[stays] = 0.0

    def _remember(self, places: dict[str, torch.Tensor], worlds: np.ndarray[Any, Any]) -> None:
        """Copy the state of some worlds."""
        import torch

        if places and worlds.any():
            chosen = torch.from_numpy(worlds).to(self._views["time"].device)
            for name, kept in places.items():
                torch.where(chosen.reshape(-1, *[1] * (kept.ndim - 1)), self._views[name], kept, out=kept)

    @contextmanager
    def _standing(self) -> Iterator[None]:
        """Meanwhile no speed is commanded: a very long step would carry kinematic bodies and motors far away."""
        velocity, joint, driven = self.control.body_velocity, self.control.joint_target, self._velocity_joints()
        commanded, speeds = velocity.clone(), joint[:, driven]
        velocity.zero_()
        joint[:, driven] = 0.0
        try:
            yield
        finally:
            velocity.copy_(commanded)
            joint[:, driven] = speeds

    def _velocity_joints(self) -> list[int]:
        return [] if self.model.joints is None else np.flatnonzero(self.model.joints.velocity_controlled).tolist()

    def _forget(self) -> None:
        """Bodies at rest remember no motion."""
        for name in ("node_memory", "frame_memory"):
            self._views[name].zero_()
