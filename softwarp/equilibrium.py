"""``Simulation.solve_static``: equilibria of all worlds, and why a world stopped. Theory: docs/theory/statics.md."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from softwarp import checks, interop, notices
from softwarp.model.codes import StaticEnd, Status
from softwarp.model.model import Model
from softwarp.plan.compile import coupled
from softwarp.solvers.footprint import with_room
from softwarp.solvers.linear.cholesky import upload
from softwarp.solvers.options import Options
from softwarp.solvers.quasi_static import QuasiStatic
from softwarp.solvers.relaxation import NEWTON_ITERATIONS, Relaxation
from softwarp.solvers.system import System
from softwarp.threads import alone

if TYPE_CHECKING:
    import torch

CHUNK = 5  # iterations along a path between two looks at the residual
TASK = "solve_static"


@dataclass(frozen=True)
class StaticResult:
    """Outcome of ``Simulation.solve_static``.

    Attributes:
        residual: Relative force imbalance plus constraint violation per cable length, or, where the scene was settled
            by steps, the way of the last one per extent of the scene; infinite where that failed; shape (world,).
        iterations: Newton iterations, or steps, taken by the slowest world.
        converged: Whether each world is in equilibrium, to the tolerance or to rounding, bool (world,).
        end: Why each world stopped, ``StaticEnd``, int (world,).
    """

    residual: torch.Tensor
    iterations: int
    converged: torch.Tensor
    end: torch.Tensor

    @property
    def reasons(self) -> list[str]:
        """Names of ``end``, one for every world."""
        return [StaticEnd(value).name for value in self.end.tolist()]


class Statics:
    """Part of ``Simulation``; see there."""

    model: Model
    options: Options
    status: torch.Tensor
    control: interop.Views
    _systems: list[System]
    _views: dict[str, torch.Tensor]
    _statics: list[QuasiStatic] | None
    _relaxation: Relaxation | None

    @property
    def device(self) -> str:
        """See ``Simulation``."""
        raise NotImplementedError

    def _update_outputs(self) -> None:
        raise NotImplementedError

    @alone
    def solve_static(self, tolerance: float | None = None, max_iterations: int = 200) -> StaticResult:
        """Move every world to its quasi-static equilibrium under the present commands and loads.

        Velocities become zero and time stands still. The solve follows the equilibria from the present state to the
        commands and looks for a stable one; where they end, as when a trunk folds, it may fail. A world that does not
        converge reports ``MAX_ITERATIONS`` and is left at its last iterate, or where it was in equilibrium with a part
        of the change in loads and commands; the result's ``end`` says why.

        Scenes with rods, rigid bodies, chambers, membranes or contact are settled by implicit steps without momentum
        instead; there the residual is the way of the last, very long step per extent of the scene, and ``tolerance``
        None takes 1e-5 in float32 and 1e-8 in float64. Where rounding keeps ways above it, as friction does in float32,
        a world ends once they have stopped falling below 5e-4 (float64: 1e-7).

        Args:
            tolerance: Relative residual; None takes 1e-4 in float32 and 1e-9 in float64. A converged world is also
                within 5e-4 of the scene's size, by the length of the Newton step. In float32 that alone decides where
                the rounding of coordinates stops the residual below 5e-3.
            max_iterations: Limit of Newton iterations, or of steps.

        Raises:
            ValueError: If the tolerance is not positive, or the limit is no count.
            MemoryError: If the solve finds no room on the device.
        """
        if tolerance is not None:
            checks.number(tolerance, "solve_static: tolerance", above=0.0)
        checks.count(max_iterations, "solve_static: max_iterations")
        is_double = self.model.precision == "float64"
        try:
            if self._systems[0].follows_paths:
                return self._follow((1e-9 if is_double else 1e-4) if tolerance is None else tolerance, max_iterations)
            return self._relax((1e-8 if is_double else 1e-5) if tolerance is None else tolerance, max_iterations)
        finally:
            notices.progress_ends()

    def _follow(self, limit: float, max_iterations: int) -> StaticResult:
        """Newton's method along paths of equilibria."""
        import torch

        if self._statics is None:
            exact = replace(self.options, project_tangent=False)
            model = coupled(self.model)
            index = upload(model.symbolic, model.device)

            def make() -> list[QuasiStatic]:
                return [QuasiStatic(s.with_options(exact, model, index, exact=True)) for s in self._systems]

            self._statics = with_room(make, TASK, model, interop.empty_cache)
        statics, iterations = self._statics, 0
        with interop.on_torch_stream(self.device):
            for static in statics:
                static.start()
            while iterations < max_iterations:
                count = min(CHUNK, max_iterations - iterations)
                for _ in range(count):
                    for static in statics:
                        static.iterate(limit)
                iterations += count
                frozen = np.concatenate([static.verdict()[1] for static in statics])
                if frozen.all():
                    break
                _tell(iterations, max_iterations, frozen)
            is_lost = np.concatenate([static.is_lost() for static in statics])
            for static in statics:
                static.finish()
            self._update_outputs()
        self._forget()
        verdicts = [static.verdict() for static in statics]
        merit, frozen = (np.concatenate(part) for part in zip(*verdicts, strict=True))
        status = self.status.cpu().numpy()
        end = np.where(merit <= limit, StaticEnd.CONVERGED, StaticEnd.ROUNDING)
        end = np.where(frozen, end, np.where(is_lost, StaticEnd.NO_PATH, StaticEnd.ITERATIONS))
        end[status >= Status.NONFINITE] = StaticEnd.FAILED
        converged = frozen & (status <= Status.OK)
        return StaticResult(torch.from_numpy(merit), iterations, torch.from_numpy(converged), torch.from_numpy(end))

    def _relax(self, limit: float, max_iterations: int) -> StaticResult:
        """Steps without momentum, for scenes that path following does not know."""
        import torch

        if self._relaxation is None:
            options = replace(self.options, newton_iterations=NEWTON_ITERATIONS, pressure_tangent=True)

            def make() -> Relaxation:
                return Relaxation([system.with_options(options) for system in self._systems])

            self._relaxation = with_room(make, TASK, self.model, interop.empty_cache)
        relaxation, iterations = self._relaxation, 0
        relaxation.start()
        with interop.on_torch_stream(self.device), self._standing():
            while iterations < max_iterations:
                relaxation.iterate(limit * self.model.extent)
                iterations += 1
                is_over = relaxation.ends <= StaticEnd.ROUNDING
                if is_over.all():
                    break
                _tell(iterations, max_iterations, is_over)
            self._update_outputs()
        self._forget()
        residual, end = torch.from_numpy(relaxation.ways / self.model.extent), torch.from_numpy(relaxation.ends.copy())
        converged, status = end <= StaticEnd.ROUNDING, self.status
        there = converged.to(status.device)
        status[there & (status == Status.MAX_ITERATIONS)] = int(Status.OK)  # of Newton's method in the last step
        status[~there & (status == Status.OK)] = int(Status.MAX_ITERATIONS)
        return StaticResult(residual, iterations, converged, end)

    @contextmanager
    def _standing(self) -> Iterator[None]:
        """Meanwhile kinematic bodies and motors have no speed: a very long step would carry them far away."""
        joints = self.model.joints
        driven = [] if joints is None else np.flatnonzero(joints.velocity_controlled).tolist()
        velocity, target = self.control.body_velocity, self.control.joint_target
        commanded, speeds = velocity.clone(), target[:, driven]
        velocity.zero_()
        target[:, driven] = 0.0
        try:
            yield
        finally:
            velocity.copy_(commanded)
            target[:, driven] = speeds

    def _forget(self) -> None:
        """Bodies at rest remember no motion."""
        for name in ("node_memory", "frame_memory"):
            self._views[name].zero_()


def _tell(iterations: int, limit: int, is_over: Any) -> None:
    notices.progress(
        TASK, f"iteration {iterations} of at most {limit}, {int(is_over.sum())} of {is_over.size} worlds done"
    )
