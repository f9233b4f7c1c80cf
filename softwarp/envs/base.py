"""SoftEnv: a batch of simulated worlds as one TorchRL environment.

The base class owns what every task needs: specs, seeds, integer counting of steps and sub-steps, truncation, masked
reset, failed worlds, reward sums, snapshots and pictures. A task fills in the hooks of ``hooks.py``.

Key in the TensorDict  Shape        Meaning
observation            (world, k)   float32, inside the declared finite bounds
action                 (world, k)   float32, or (world,) int64 for discrete actions
reward                 (world, 1)   float32, sum of the named terms
terminated             (world, 1)   the task ended, or the world's simulation failed
truncated              (world, 1)   ``max_episode_steps`` reached
success                (world, 1)   the goal is met now
distance               (world, 1)   float32 [m], to the goal
<sensor>               (world, k)   float32, one key for every name in ``EnvConfig.sensors`` (sensors.py)
action_mask            (world, k)   bool, discrete actions that are legal now, where a task has illegal ones
world_status           (world, 1)   int32, worst ``softwarp.Status`` of the action's sub-steps
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self, cast

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data.tensor_specs import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs.common import EnvBase
from torchrl.envs.utils import step_mdp

from softwarp import checks, interop, notices
from softwarp.builder import ModelBuilder, Precision
from softwarp.envs import randomization
from softwarp.envs.actions import ActionGuard
from softwarp.envs.answers import Answers, check_class
from softwarp.envs.capture import Captures, Function
from softwarp.envs.episode_log import EpisodeLog
from softwarp.envs.hooks import Hooks
from softwarp.envs.options.base import EnvConfig
from softwarp.envs.pictures import LivePictures
from softwarp.envs.placement import place_frames
from softwarp.envs.reduced import reduce_body
from softwarp.envs.rest import bring_to_rest
from softwarp.envs.sensors import Sensors, readable
from softwarp.envs.snapshot import EnvSnapshot, Worlds, world_index
from softwarp.envs.soundness import inversion_term, is_finite_state, is_inverted
from softwarp.envs.sums import in_order
from softwarp.model.codes import Status
from softwarp.simulation import Simulation
from softwarp.solvers.options import Integrator
from softwarp.solvers.partition import SolverPath
from softwarp.unpicklable import Unpicklable

_AFTER = "after "  # begins the keys of what a step led to, where a reset has followed it
_FAILED = int(Status.NONFINITE)  # from here on the simulator has rolled the world back


class SoftEnv(Hooks, Unpicklable, EnvBase):
    """Batch-locked TorchRL environment around a ``Simulation``.

    A task implements ``build_scene``, ``action_size`` or ``action_count``, ``apply_action``, ``observation_bounds``,
    ``observe``, ``measure_distance`` and ``reward_terms``, and where needed ``setup``, ``reset_worlds``,
    ``is_success``, ``is_terminated``, ``shown_region`` and ``viewed_from``. Per-world tensors that the future depends
    on are made with ``add_world_state``; snapshots hold them. What the hooks of steps and resets do is recorded once on
    CUDA (capture.py): they neither read the device back nor make tensors of Python's numbers.

    Args:
        config: Options; see the task's dataclass.
        num_worlds: Worlds that step together.
        device: ``"cpu"`` or ``"cuda:<index>"``.
        seed: Seed of all draws; None takes one from the operating system.
    """

    batch_locked = True
    holds_commands: ClassVar[bool] = False  # ``apply_action`` is called for sub-step 0 only: commands stay as they are
    sweep_tolerance: ClassVar[float | None] = None  # ``gauss_seidel_tolerance`` of the simulation
    reward_range: tuple[float, float] = (-1.0, 1.0)  # of a step, failures apart; planners scale rewards by it
    _has_frame_skip = True  # sub-steps are taken here, TorchRL must not repeat actions on top
    policies: ClassVar[Mapping[str, Callable[[Any], Any]]] = {}  # hand-written: name -> what makes it for an env
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}
    goal_radius: ClassVar[float | None] = None  # m, of goals in pictures; None: by the size of what moves
    _is_whole: ClassVar[bool]  # of a class that was looked at
    viewed_from: ClassVar[tuple[float, float, float] | None] = None  # direction to the eye of pictures; None: in front

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Refuse a class that lacks hooks before anything is made."""
        if "_is_whole" not in vars(cls):
            check_class(cls, SoftEnv)
            cls._is_whole = True
        made: Self = super().__new__(cls, *args, **kwargs)
        return made

    def __init__(self, config: EnvConfig, *, num_worlds: int = 1, device: str = "cpu", seed: int | None = None) -> None:
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_worlds]))
        self.config = config
        self.num_worlds = num_worlds
        self.first_world = 0  # number of world 0 among those of all parts, where others have the rest (split.py)
        self.action_repeat = config.action_repeat
        self.control_dt = config.action_repeat * config.dt
        self.max_episode_steps = config.max_episode_steps
        wanted = False if config.contact_growth else config.capture  # growing waits for the device
        if wanted is None and self.repeat_swing < float("inf"):
            wanted = False  # a recording of Torch cannot branch, and would repeat every step of all worlds
        self.captures = Captures(type(self).__name__, self.device, wanted)
        self.watcher: Callable[[], None] | None = None  # called after each sub-step that is not captured
        self.world_state: dict[str, Tensor] = {}
        self._answers = Answers(self, num_worlds, self.device)
        self._heard: set[str] = set()  # captured functions whose first answers were looked at
        self.sim = self.make_simulation(num_worlds)
        if config.settle:
            self._settle()
        self._allocate()
        if not bool(is_finite_state(self.sim).all()):
            raise ValueError(f"{type(self).__name__}: the scene's initial state is not finite; check its measures")
        self.setup()
        self._answers.actions(self.action_size, self.action_count)
        bounds = self.observation_bounds()
        self._answers.bounds(bounds)
        self._sensors = Sensors(type(self).__name__, self.sim, config.sensors, taken=bounds)
        self._make_specs()
        self._set_seed(seed)
        self._pictures = LivePictures(self)

    @property
    def contact_passes(self) -> int | None:
        """Looks of the simulation at contacts where a step leads to; None for its own choice."""
        return None

    @property
    def repeat_swing(self) -> float:
        """Swing [rad] of a line beyond which the simulation takes a step again."""
        return float("inf")

    def make_simulation(self, num_worlds: int) -> Simulation:
        """A simulation of the scene with the options of ``config``."""
        with notices.working(f"building the scene of {type(self).__name__}"):
            builder = ModelBuilder(gravity=self.gravity)
            self.build_scene(builder)
            if self.reduced_file is not None:
                reduce_body(builder, self.reduced_file, turning=self.turns)
            capacity = self.config.contact_capacity or self.contact_capacity
            model = builder.finalize(num_worlds, str(self.device), cast("Precision", self.config.precision), capacity)
            return Simulation(
                model,
                self.config.dt,
                self.config.newton_iterations,
                integrator=cast("Integrator", self.config.integrator),
                solver_path=cast("SolverPath", self.config.solver_path),
                contact_growth=self.config.contact_growth,
                gauss_seidel_tolerance=self.sweep_tolerance,
                contact_passes=self.contact_passes,
                repeat_swing=self.repeat_swing,
            )

    def hold_up(self, sim: Simulation, body: int, mass: float) -> None:
        """Let a rigid body of some mass [kg] hover, by a force that ``setup`` takes away when the rest has settled."""
        hover = sim.control.body_force[:, body, :3]
        hover.copy_(hover.new_tensor(self.gravity) * -mass)

    def add_world_state(self, name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Zeros of shape (world, *shape) that snapshots save; change them in place only."""
        if name in self.world_state:
            raise ValueError(f"world state {name!r} exists already; choose another name")
        tensor = torch.zeros((self.num_worlds, *shape), dtype=dtype, device=self.device)
        self.world_state[name] = tensor
        return tensor

    def draw(self, stream: int, count: int) -> Tensor:
        """Uniform numbers in [0, 1) of the running episode, shape (world, count); same stream, same numbers."""
        return randomization.uniform(self._seeds, self._streams, self._episode, stream, count)

    def place_frames(self, poses: Tensor, mask: Tensor, twists: Tensor | None = None) -> Tensor:
        """Start the episodes of some worlds with rigid bodies and rod nodes elsewhere; for ``reset_worlds``.

        Args:
            poses: Position [m] and quaternion x y z w of all rigid bodies, then of all rod nodes, (world, frame, 7);
                what is attached must lie where its carrier takes it.
            mask: Worlds that are reset, bool (world,).
            twists: Velocity [m/s] and angular velocity [rad/s] of the same frames, (world, frame, 6); None leaves the
                scene's.

        Returns:
            Worlds that were placed, bool (world,). One whose poses or twists are not finite stays in the scene's
            initial state, and its reset reports ``Status.NONFINITE``.
        """
        is_placed = place_frames(self.sim, poses, mask, twists)
        self._status.masked_fill_(mask > is_placed, _FAILED)
        return is_placed

    def _settle(self) -> None:
        """Make the state at rest the one that a reset returns to, the same bits whatever the batch size."""
        single = self.sim if self.num_worlds == 1 else self.make_simulation(1)
        bring_to_rest(type(self).__name__, single, self.config.dt)
        if single is not self.sim:
            self.sim.restore(single.snapshot(), worlds=range(self.num_worlds))
        self.sim.set_initial()

    def _allocate(self) -> None:
        self._seeds = self.add_world_state("seed", dtype=torch.int64)
        self._streams = self.add_world_state("stream", dtype=torch.int64)
        self._episode = self.add_world_state("episode", dtype=torch.int64)
        self.step_count = self.add_world_state("step_count", dtype=torch.int64)
        self.distance = self.add_world_state("distance")
        self._success = self.add_world_state("success", dtype=torch.bool)
        self._terminated = self.add_world_state("terminated", dtype=torch.bool)
        self._status = self.add_world_state("status", dtype=torch.int32)
        self._all = torch.ones(self.num_worlds, dtype=torch.bool, device=self.device)
        self._no_cut = torch.zeros_like(self._all)

    def _make_specs(self) -> None:
        """Declare the specs; rewards are probed once for the names of their terms."""
        n, device = self.num_worlds, self.device
        self._task_bounds = self.observation_bounds()
        bounds = self._task_bounds | self._sensors.bounds()
        self._bounds = {key: (low.to(device), high.to(device)) for key, (low, high) in bounds.items()}
        observations: dict[str, TensorSpec] = {}
        for key, (low, high) in self._bounds.items():
            shape = (n, *low.shape)
            low, high = low.expand(shape).clone(), high.expand(shape).clone()
            observations[key] = Bounded(low, high, shape=shape, device=device)
            self.add_world_state(f"last_{key}", *shape[1:])
        flag = Binary(1, (n, 1), dtype=torch.bool, device=device)
        self.observation_spec = Composite(
            **observations,
            success=flag.clone(),
            distance=Unbounded((n, 1), device=device),
            world_status=Unbounded((n, 1), dtype=torch.int32, device=device),
            shape=(n,),
            device=device,
        )
        if self.action_count:
            self.action_spec = Categorical(self.action_count, (n,), dtype=torch.int64, device=device)
        else:
            self.action_spec = Bounded(-1.0, 1.0, (n, self.action_size), device=device, dtype=torch.float32)
        is_checked = self.config.check_actions
        self._guard = ActionGuard(type(self).__name__, self.action_spec, self.action_count, is_on=is_checked)
        mask = self.action_mask()
        self._answers.mask(mask, self.action_count)
        if mask is not None:
            legal = Binary(self.action_count, (n, self.action_count), dtype=torch.bool, device=device)
            self.observation_spec["action_mask"] = legal
        self.reward_spec = Unbounded((n, 1), device=device)
        self.full_done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=(n,), device=device
        )
        probe = self.reward_terms(self.action_spec.zero(), self.distance)
        self._answers.rewards(probe)
        self._task_rewards = tuple(probe)
        self.reward_names = (*probe, *inversion_term(self.sim, self.config.inversion_penalty), "failure")
        self._reward_sums = self.add_world_state("reward_sums", len(self.reward_names))
        self._failure_terms = torch.zeros((1, len(self.reward_names)), device=device)
        self._failure_terms[0, -1] = -self.config.failure_penalty
        self._no_failure = torch.zeros(n, device=device)
        self._log = EpisodeLog(self.reward_names, device)

    def _set_seed(self, seed: int | None) -> None:
        """World i draws from stream ``first_world`` + i of ``seed``; the next reset starts episode 0."""
        self.seed = secrets.randbits(62) if seed is None else checks.seed(seed)
        self._seeds.fill_(self.seed)
        self._streams.copy_(torch.arange(self.first_world, self.first_world + self.num_worlds))
        self._episode.fill_(-1)

    def seed_worlds(self, seeds: Sequence[int]) -> None:
        """Give every world its own seed: world i then draws as a one-world environment seeded ``seeds[i]`` does."""
        if not isinstance(seeds, (Sequence, np.ndarray, Tensor)) or len(seeds) != self.num_worlds:
            need = f"hold one seed for each of {self.num_worlds} worlds"
            raise ValueError(checks.refusal("seeds", need, seeds))
        self._seeds.copy_(torch.tensor([checks.seed(seed) for seed in seeds], dtype=torch.int64))
        self._streams.zero_()
        self._episode.fill_(-1)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = self._all if mask is None else mask.reshape(self.num_worlds)
        return self.reset_where(mask)

    def reset_where(self, mask: Tensor) -> TensorDict:
        """Start a new episode where ``mask``, bool (world,), holds; other worlds keep every bit.

        Returns:
            The whole batch, with first observations where the mask holds, the present ones elsewhere.
        """
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.shape != (self.num_worlds,):
            need = f"be a bool tensor of shape ({self.num_worlds},)"
            raise ValueError(checks.refusal(f"{type(self).__name__}: mask", need, mask))
        if self.captures.are_on:
            return self._batch(self._run_captured(self._captured_reset, mask))
        self._begin(mask)
        return self._collect()

    def _begin(self, mask: Tensor) -> None:
        self.sim.reset(None if mask is self._all else mask)
        self._episode.add_(mask)
        for counter in (self.step_count, self._success, self._terminated, self._status):
            counter.masked_fill_(mask, 0)
        self._reward_sums.masked_fill_(mask[:, None], 0.0)
        with self._answers.untouched(mask, self.world_state, is_watched=not self.captures.are_on):
            self.reset_worlds(mask)
        distance, observation = self._checked_distance(), self._checked_observation()
        good = self._screen("reset", distance, {}, observation)
        self._status.masked_fill_(mask > good, _FAILED)  # what it tells stays as it was
        good &= mask
        torch.where(good, distance, self.distance, out=self.distance)
        success = self._answers.flags("is_success", self.is_success(distance))
        torch.where(good, success, self._success, out=self._success)
        self._keep_observations(good, observation)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        self._guard.check_form(action)
        active = tensordict.get("_step", None)
        if active is None and self.captures.are_on:
            return self._batch(self._run_captured(self._captured_step, action))
        action = self._guard.admit(action)
        if active is None or bool(active.all()):
            return self._collect(self._advance(action))
        # TorchRL steps some worlds only: let all advance, then put the idle ones back.
        idle = torch.nonzero(~active.reshape(self.num_worlds)).flatten().tolist()
        saved = self.snapshot(idle)
        reward = self._advance(action)
        self.restore(saved, idle)
        reward[idle] = 0.0
        return self._collect(reward)

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """What TorchRL's collectors and rollouts call: ``step_and_reset`` where steps are captured."""
        if not self.captures.are_on or not {"_step", "next"}.isdisjoint(tensordict.keys()):
            both: tuple[TensorDictBase, TensorDictBase] = super().step_and_maybe_reset(tensordict)
            return both
        tensordict = tensordict if tensordict.device == self.device else tensordict.to(self.device)
        after, now = self.step_and_reset(tensordict.get("action"))
        tensordict.set("next", after)
        return tensordict, step_mdp(tensordict, exclude_action=False).update(now)

    def step_and_reset(self, action: Tensor, cut: Tensor | None = None) -> tuple[TensorDict, TensorDict]:
        """One action in all worlds, then a new episode where one has ended; captured, it never waits for the device.

        Args:
            action: Of the action space.
            cut: Worlds whose episode ends with this step in any case, as truncated, bool (world,); None cuts none.

        Returns:
            Where the step led, as ``step`` has it under ``next``, and what the next action starts from.

        Raises:
            ValueError: If an action is refused; captured, by this call or one of the next.
        """
        self._guard.check_form(action)
        cut = self._no_cut if cut is None else cut
        if self.captures.are_on:
            parts = self._run_captured(self._captured_step_and_reset, action, cut)
            led_to = {key.removeprefix(_AFTER): parts.pop(key) for key in tuple(parts) if key.startswith(_AFTER)}
            return self._batch(led_to), self._batch(parts)
        action = self._guard.admit(action)
        after = self._cut_episodes(self._advance(action), cut)
        ended = after["done"].squeeze(-1)
        if bool(ended.any()):
            self._begin(ended)
        return self._batch(after), self._collect()

    def _advance(self, action: Tensor) -> Tensor:
        """Simulate one action in all worlds and update the buffers; reward (world, 1)."""
        with interop.single_thread(self.device):
            self._simulate(action)
            return self._account(action)

    def _account(self, action: Tensor) -> Tensor:
        """Update the buffers after an action's sub-steps; reward (world, 1)."""
        self.step_count.add_(1)

        distance = self._checked_distance()
        rewards = self._checked_rewards(action, distance)
        terms = torch.stack((*rewards.values(), self._no_failure), dim=1)
        observation = self._checked_observation()
        good = self._screen("step", distance, rewards, observation)
        # A world that is not finite although the simulator saw nothing is reported all the same.
        self._status.masked_fill_(~good & (self._status < _FAILED), _FAILED)

        torch.where(good, distance, self.distance, out=self.distance)
        torch.logical_and(good, self._answers.flags("is_success", self.is_success(distance)), out=self._success)
        ended = self._answers.flags("is_terminated", self.is_terminated(distance))
        torch.logical_or(~good, ended, out=self._terminated)
        if self.config.end_on_success:
            self._terminated.logical_or_(self._success)
        if self.config.end_on_inversion:
            self._terminated.logical_or_(is_inverted(self.sim))
        self._keep_observations(good, observation)
        terms = torch.where(good[:, None], terms, self._failure_terms)
        self._reward_sums.add_(terms)
        self._log_finished()
        return in_order(terms.unbind(dim=1))[:, None]

    def _checked_distance(self) -> Tensor:
        distance = self.measure_distance()
        self._answers.distance(distance)
        return distance

    def _checked_observation(self) -> dict[str, Tensor]:
        observation = self.observe()
        self._answers.observation(observation, self._task_bounds)
        return observation | self._sensors.read()

    def _checked_rewards(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        terms = self.reward_terms(action, distance)
        self._answers.rewards(terms, self._task_rewards)
        return terms | inversion_term(self.sim, self.config.inversion_penalty)

    def _screen(self, stage: str, distance: Tensor, terms: dict[str, Tensor], seen: dict[str, Tensor]) -> Tensor:
        """Worlds that the simulator has kept and for which all hooks have said finite numbers, bool (world,)."""
        at_once = not self.captures.are_on
        good = self._answers.screen(stage, self._status, distance, terms, seen, at_once=at_once)
        if at_once:
            self._answers.hear_news(self.sim)
        return good

    def _simulate(self, action: Tensor) -> None:
        """The sub-steps of an action; ``_status`` then holds their worst result."""
        if self.holds_commands and self.watcher is None:
            self.apply_action(action, 0)
            self.sim.step(self.action_repeat)
            self._status.copy_(self.sim.status)
            return
        told = []
        for substep in range(self.action_repeat):
            if substep == 0 or not self.holds_commands:
                self.apply_action(action, substep)
            self.sim.step()
            told.append(self.sim.status.clone())
            if self.watcher is not None:
                self.watcher()
        self._status.copy_(interop.worst_of(told))

    def _keep_observations(self, mask: Tensor, observation: dict[str, Tensor]) -> None:
        """Clip and store observations where ``mask`` holds; elsewhere the last good ones stay."""
        for key, value in observation.items():
            low, high = self._bounds[key]
            last = self.world_state[f"last_{key}"]
            torch.where(mask[:, None], value.clamp(low, high), last, out=last)

    def _present(self, reward: Tensor | None = None) -> dict[str, Tensor]:
        """What a step or a reset tells, by key; most of it are the buffers themselves."""
        terminated = self._terminated[:, None]
        truncated = (self.step_count >= self.max_episode_steps)[:, None]
        data = {key: self.world_state[f"last_{key}"] for key in self._bounds}
        data |= {"success": self._success[:, None], "distance": self.distance[:, None]}
        data |= {"world_status": self._status[:, None], "terminated": terminated, "truncated": truncated}
        data["done"] = terminated | truncated
        if (legal := self.action_mask()) is not None:
            data["action_mask"] = legal
        return data if reward is None else data | {"reward": reward}

    def _collect(self, reward: Tensor | None = None) -> TensorDict:
        """The present as a new TensorDict; nothing in it is shared with the buffers."""
        return self._batch({key: value.clone() for key, value in self._present(reward).items()})

    def _batch(self, parts: dict[str, Tensor]) -> TensorDict:
        return TensorDict(parts, batch_size=self.batch_size, device=self.device)

    def _cut_episodes(self, reward: Tensor, cut: Tensor) -> dict[str, Tensor]:
        """Copies of what a step tells, with the episodes of some worlds cut short."""
        after = {key: value.clone() for key, value in self._present(reward).items()}
        after["truncated"] = after["truncated"] | (cut[:, None] & ~after["done"])
        after["done"] = after["done"] | cut[:, None]
        return after

    def _captured_reset(self, mask: Tensor) -> dict[str, Tensor]:
        self._begin(mask)
        return self._present()

    def _captured_step(self, action: Tensor) -> dict[str, Tensor]:
        return self._present(self._advance(self._guard.screen(action)))

    def _captured_step_and_reset(self, action: Tensor, cut: Tensor) -> dict[str, Tensor]:
        after = self._cut_episodes(self._advance(self._guard.screen(action)), cut)
        self._begin(after["done"].squeeze(-1))
        return {f"{_AFTER}{key}": value for key, value in after.items()} | self._present()

    def _run_captured(self, function: Function, *arguments: Tensor) -> dict[str, Tensor]:
        """Results of a function that is replayed as a graph, recorded anew where options have changed since."""
        self._guard.raise_noted()
        options = (self.sim.revision, self.action_repeat, self.max_episode_steps, dict(vars(self.config)))
        results = self.captures.run(function, *arguments, given=options)
        if function.__name__ not in self._heard:  # after its first call only: it waits for the device
            self._heard.add(function.__name__)
            self._answers.hear(self.sim)
        self._guard.publish()
        return results

    def raise_refused_actions(self) -> None:
        """Wait for the device and raise the error of actions that captured steps have refused.

        Warns of hooks whose answers were not finite (answers.py).

        Raises:
            ValueError: Naming the worlds. Steps and resets raise it by themselves as soon as they hear of it.
        """
        self._guard.raise_noted(wait=True)
        self._answers.hear(self.sim)

    @property
    def episode_sums(self) -> dict[str, Tensor]:
        """Sum of every reward term since each world's last reset, name -> (world,)."""
        return dict(zip(self.reward_names, self._reward_sums.clone().unbind(dim=1), strict=True))

    def _log_finished(self) -> None:
        done = self._terminated | (self.step_count >= self.max_episode_steps)
        if self.captures.are_on or bool(done.any()):
            failed, overflowed = self._status >= _FAILED, self.sim.contact_overflow > 0  # the latter since the reset
            columns = (self.step_count, self._success, self.distance, failed, overflowed)
            self._log.add(done, self._reward_sums, columns)

    def pop_episode_log(self) -> dict[str, float]:
        """Means over the episodes that ended since the last call.

        Returns:
            ``episodes`` (a count), and when it is not 0 also ``return``, ``length``, ``success``, ``failed`` and
            ``overflowed`` (fractions; the last of episodes in which a contact found no place), ``distance`` (last one
            [m]) and ``reward/<term>`` (sums over an episode).
        """
        self.raise_refused_actions()
        return self._log.pop()

    def readings(self) -> dict[str, Callable[[], Tensor]]:
        """What can be measured in the scene now, by names of sensors, (world, k, ...); ``softwarp view`` plots it."""
        return readable(self.sim)

    def snapshot(self, worlds: Worlds = None) -> EnvSnapshot:
        """Save worlds completely; all of them if ``worlds`` is None."""
        index = world_index(worlds, self._all)
        self._guard.raise_noted(wait=True)
        tensors = {name: tensor[index].clone() for name, tensor in self.world_state.items()}
        return EnvSnapshot(type(self).__name__, self.sim.snapshot(index.tolist()), tensors)

    def restore(
        self, snapshot: EnvSnapshot | Mapping[str, Any], worlds: Worlds = None, *, keep_streams: bool = False
    ) -> None:
        """Continue saved worlds in the given ones: same actions then give the same bits.

        Args:
            snapshot: Of this environment or of one with the same scene, or its ``state_dict``; one world, or as many
                as ``worlds``.
            worlds: Where to; None means all. A snapshot of one world is copied into each.
            keep_streams: Let the worlds keep their own random streams, so that copies of one world draw different
                goals when they are reset; otherwise they go on exactly as the saved world would have.

        Raises:
            ValueError: If the snapshot belongs to another task or the number of worlds does not fit.
        """
        index = world_index(worlds, self._all)
        if not isinstance(snapshot, EnvSnapshot):
            snapshot = EnvSnapshot.from_state_dict(snapshot)
        snapshot.check_fit(type(self).__name__, self.world_state, len(index))
        self.sim.restore(snapshot.sim, index.tolist())
        for name, saved in snapshot.tensors.items():
            if not (keep_streams and name in ("seed", "stream", "episode")):
                self.world_state[name][index] = saved.to(self.device)

    def render(self, worlds: Worlds = None, **shown: bool) -> NDArray[np.uint8]:
        """Pictures of worlds (all if None), uint8 (n, height, width, 3); ``shown`` as of ``RayCaster.draw``."""
        return self._pictures.draw(world_index(worlds, self._all), **shown)

    def way_out(self) -> str:
        """How an environment like this one is made elsewhere."""
        kind = type(self)
        name = kind.__name__ if kind.__module__.startswith("softwarp.") else f"{kind.__module__}:{kind.__qualname__}"
        return (
            f"send env.config, and make one there: softwarp.make({name!r}, num_worlds={self.num_worlds}, "
            "config=config); env.snapshot() holds its state for env.restore, and both can be pickled"
        )

    def to(self, device: Any) -> SoftEnv:
        """The environment itself if it lives on ``device``; a running simulation cannot move."""
        if torch.empty(0, device=device).device != self.device:
            raise ValueError(f"{type(self).__name__} lives on {self.device} and cannot move to {device}; make it there")
        return self
