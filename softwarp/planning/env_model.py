"""A ``SoftEnv`` as a planning model: a fixed pool of worlds of its own, and the states of the tree beside it.

The pool is made once, with the options of the environment that asks, and used again for every plan; the asking
environment is read once per plan (``snapshot``) and never stepped. Everything that the future depends on is in the
snapshot, random counters included, so the pool sees what the asking environment would see, with the same bits as long
as both use the same solver path.

On several devices each has a part of the pool. Sequences from the root are divided among them and run side by side,
with the results of one device; a tree grows on the first.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from softwarp.envs.base import SoftEnv
from softwarp.envs.snapshot import EnvSnapshot
from softwarp.planning.model import Bools, Floats, Ints, Rollouts, Transitions
from softwarp.planning.objective import Objective
from softwarp.planning.options import ModelConfig
from softwarp.planning.state_store import StateStore
from softwarp.snapshot import Snapshot
from softwarp.threads import Workers

MAX_CHOICES = 256  # discrete choices made of continuous actions


@dataclass
class _Held:
    """Outcome of an action held for some steps, one entry per pool world; ``early`` are states of worlds that ended."""

    rewards: Floats
    ended: Bools
    rest: Floats
    success: Bools
    distance: Floats
    early: dict[int, EnvSnapshot]


class EnvModel:
    """Planning model of an environment.

    Args:
        env: The environment that asks; it is not changed.
        config: Actions, rewards and memory.
        worlds: Size of the pool; a batch of a planner fills it once or several times.
        solver_path: Of the pool on a CPU; None takes that of ``env``, which makes predictions exact to the bit. An
            environment of fewer than four worlds takes the slow scalar path unless it is made with
            ``solver_path="lanes"``.
        devices: That share the worlds, such as ``["cuda:0", "cuda:1"]``; None: that of ``env``.

    Raises:
        ValueError: If the environment's room for contacts grows, or there are more devices than worlds.
    """

    def __init__(
        self,
        env: SoftEnv,
        config: ModelConfig | None = None,
        *,
        worlds: int,
        solver_path: str | None = None,
        devices: Sequence[str] | None = None,
    ) -> None:
        first, *further = devices or [str(env.device)]
        if 1 + len(further) > worlds:
            raise ValueError(f"devices: {1 + len(further)} for {worlds} worlds; give each a world at least")
        self.config = config or ModelConfig()
        if env.config.contact_growth:
            raise ValueError(
                f"planning: states are kept in rows of one length, and {type(env).__name__} has contact_growth=True; "
                "make it with the contact_capacity that it needs instead"
            )
        on_cpu = env.device is not None and env.device.type == "cpu" and torch.device(first).type == "cpu"
        path = solver_path or (env.sim.variant.name if on_cpu else "auto")
        pool_config = dataclasses.replace(env.config, solver_path=path, check_actions=False)
        share = -(-worlds // (1 + len(further)))
        self.pool = type(env)(pool_config, num_worlds=share, device=first, seed=0)
        self.others = [
            EnvModel(env, self.config, worlds=share, solver_path=solver_path, devices=[device]) for device in further
        ]
        self._workers = Workers(1 + len(self.others))
        self.choices = _choices(self.pool, self.config.levels)
        self._store: StateStore | None = None
        self._blank = torch.zeros(self.pool.action_spec.shape, dtype=self.pool.action_spec.dtype)

    @property
    def action_count(self) -> int:
        """Discrete actions: the environment's own, or combinations of levels of its continuous action, each per stride.

        Action a of n is the choice a % n, held for stride a // n.
        """
        return self._base * len(self.config.strides)

    @property
    def _base(self) -> int:
        """Discrete choices, whatever their strides."""
        return self.pool.action_count or len(self.choices)

    @property
    def action_size(self) -> int:
        """Length of the environment's continuous action, 0 if it has discrete ones."""
        return self.pool.action_size

    @property
    def worlds(self) -> int:
        """Size of the pool, on all devices."""
        return self.pool.num_worlds * (1 + len(self.others))

    @property
    def root(self) -> int:
        """The state given to ``start``."""
        return 0

    @property
    def state_bytes(self) -> int:
        """Bytes that a kept state takes; known after ``start``."""
        return self._started().row_bytes

    def start(self, root: EnvSnapshot) -> None:
        """Plan from a snapshot of one world from now on; states of earlier plans are forgotten.

        Raises:
            ValueError: If the snapshot holds several worlds, or its episode is over.
        """
        if root.num_worlds != 1:
            raise ValueError(f"root: must be a snapshot of one world, got {root.num_worlds}; use env.snapshot(world)")
        if bool(root.tensors["terminated"]) or int(root.tensors["step_count"]) >= self.pool.max_episode_steps:
            raise ValueError("root: the world's episode is over, there is nothing to plan; reset the world first")
        root = _on(root, torch.device(self.pool.device or "cpu"))
        if self._store is not None and self._store.fits(root):
            self._store.set_root(root)
        else:
            memory = round(self.config.memory * 2**20)
            self._store = StateStore(root, memory=memory, least=self.worlds + 1)
        self.snapshot = root
        for other in self.others:
            other.start(root)
        bounds = tuple(self.config.reward_range or self.pool.reward_range)
        distance = float(root.tensors["distance"])
        self.objective = Objective.of(self.config.objective, (bounds[0], bounds[1]), distance)
        left = self.pool.max_episode_steps - int(root.tensors["step_count"])
        self.horizon = math.ceil(left / self.config.hold)
        self.transitions = 0
        self._parent, self._action, self._row = [-1], [-1], [0]

    def step_many(self, states: Ints, actions: Ints) -> Transitions:
        """Take action i in state i and keep the states reached; actions of equal stride are taken together."""
        size = self.pool.num_worlds
        stride = np.asarray(actions) // max(self._base, 1)
        order = np.argsort(stride, kind="stable")
        groups = [order[stride[order] == one] for one in range(len(self.config.strides))]
        chunks = [group[i : i + size] for group in groups for i in range(0, len(group), size)]
        joined = _joined([self._step(states[chunk], actions[chunk]) for chunk in chunks])
        back = np.argsort(order, kind="stable")
        return Transitions(*(column[back] for column in joined))

    def roll_out(self, states: Ints, actions: Ints | Floats) -> Rollouts:
        """Take a sequence of actions from each state.

        Raises:
            ValueError: If actions may be held for several strides.
        """
        if len(self.config.strides) > 1:
            raise ValueError(
                f"strides: are for planner opd, which steps trees; others take one, not {self.config.strides}"
            )
        size = self.pool.num_worlds
        if self.others and not np.any(states != self.root):
            return self._roll_out_together(states, actions)
        parts = [self._roll_out(states[i : i + size], actions[i : i + size]) for i in range(0, len(states), size)]
        return Rollouts(*_joined(parts))

    def _roll_out_together(self, states: Ints, actions: Ints | Floats) -> Rollouts:
        """Sequences from the root, a part of them on each device."""
        count = 1 + len(self.others)
        parts: list[Rollouts | None] = [None] * count
        rows = [part for part in np.array_split(np.arange(len(states)), count) if len(part)]
        before = [other.transitions for other in self.others]

        def work(device: int) -> None:
            chosen = rows[device]
            if device:
                parts[device] = self.others[device - 1].roll_out(states[chosen], actions[chosen])
                return
            size = self.pool.num_worlds
            own = [chosen[i : i + size] for i in range(0, len(chosen), size)]
            parts[0] = Rollouts(*_joined([self._roll_out(states[part], actions[part]) for part in own]))

        self._workers.run(work, range(len(rows)), helping=True)
        self.transitions += sum(other.transitions - old for other, old in zip(self.others, before, strict=True))
        return Rollouts(*_joined([part for part in parts if part is not None]))

    def state(self, state: int) -> EnvSnapshot:
        """A state of the tree as a snapshot of one world."""
        self._place(np.array([state]))
        return self.pool.snapshot([0])

    def commands(self, actions: Ints | Floats) -> Tensor:
        """Actions of a plan as the environment takes them, shape (n,) or (n, action_size)."""
        given = np.asarray(actions)
        if self.pool.action_count:
            return torch.as_tensor(given % self._base, dtype=torch.int64)
        if np.issubdtype(given.dtype, np.integer):
            return self.choices[torch.as_tensor(given % self._base)]
        return torch.as_tensor(given, dtype=torch.float32).clamp(-1.0, 1.0)

    def schedule(self, actions: Ints | Floats) -> Tensor:
        """Actions of a plan step by step, each as often as it is held, shape (n,) or (n, action_size)."""
        return self.commands(actions).repeat_interleave(torch.as_tensor(self._lasts(actions)), dim=0)

    def _lasts(self, actions: Ints | Floats) -> Ints:
        """Environment steps that each action of a plan is held for."""
        given = np.asarray(actions)
        is_chosen = np.issubdtype(given.dtype, np.integer)
        stride = given // self._base if is_chosen else np.zeros(len(given), dtype=np.int64)
        lasts: Ints = self.config.hold * np.array(self.config.strides)[stride]
        return lasts

    def _started(self) -> StateStore:
        if self._store is None:
            raise RuntimeError("planning model: call start(env.snapshot(world)) first")
        return self._store

    def _step(self, states: Ints, actions: Ints) -> Transitions:
        store, count = self._started(), len(states)
        self._place(states)
        self._keep(states)
        held = self._hold(actions, count, int(self._lasts(actions[:1])[0]), keep=True)
        self.transitions += count
        names = list(range(len(self._parent), len(self._parent) + count))
        self._parent.extend(map(int, states))
        self._action.extend(map(int, actions))
        self._row.extend([-1] * count)
        rows = self._take(names)
        for world, snapshot in held.early.items():
            store.save([rows[world]], snapshot)
        going = [world for world in range(count) if world not in held.early]
        if going:
            store.save([rows[world] for world in going], self.pool.snapshot(going))
        cut = slice(count)
        told = (held.rewards[cut], held.ended[cut], held.rest[cut], held.success[cut], held.distance[cut])
        return Transitions(np.array(names), *told, self._likeness(count))

    def _likeness(self, count: int) -> Ints:
        """What the task tells of the states in the first worlds of the pool."""
        rows = self.pool.likeness()
        return np.zeros((count, 0), dtype=np.int64) if rows is None else rows[:count].cpu().numpy().copy()

    def _keep(self, states: Ints) -> None:
        """Keep the states in the first worlds of the pool, as others will be reached from them."""
        store = self._started()
        world_of = {state: world for world, state in enumerate(map(int, states))}
        lost = [state for state in world_of if self._row[state] < 0]
        if lost:
            store.save(self._take(lost), self.pool.snapshot([world_of[state] for state in lost]))
        store.keep([self._row[state] for state in world_of])

    def _take(self, states: list[int]) -> list[int]:
        """Rows for states, those of older ones if need be."""
        rows, lost = self._started().take(states)
        for state in lost:
            self._row[state] = -1
        for state, row in zip(states, rows, strict=True):
            self._row[state] = row
        return rows

    def _roll_out(self, states: Ints, actions: Ints | Floats) -> Rollouts:
        count, horizon = actions.shape[:2]
        self._place(states)
        rewards = np.zeros((count, horizon))
        lengths = np.full(count, horizon)
        ended, success = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        rest, distance = np.zeros(count), np.zeros(count)
        for step in range(horizon):
            going = ~ended
            held = self._hold(actions[:, step], count, int(self._lasts(actions[:1, step])[0]), keep=False)
            self.transitions += int(going.sum())
            rewards[:, step] = np.where(going, held.rewards[:count], rest)
            for kept, new in ((rest, held.rest), (success, held.success), (distance, held.distance)):
                kept[going] = new[:count][going]
            lengths[going & held.ended[:count]] = step + 1
            ended |= held.ended[:count]
            if ended.all():
                rewards[:, step + 1 :] = rest[:, None]
                break
        return Rollouts(rewards, lengths, ended, rest, success, distance)

    def _place(self, states: Ints) -> None:
        """Put states into the first worlds of the pool; those not kept are reached again from an ancestor."""
        store = self._started()
        origins: list[int] = []
        chains: list[list[int]] = []
        for state in map(int, states):
            chain: list[int] = []
            while self._row[state] < 0:
                chosen = np.array([self._action[state]])
                chain.extend((chosen % self._base).tolist() * (int(self._lasts(chosen)[0]) // self.config.hold))
                state = self._parent[state]
            origins.append(self._row[state])
            chains.append(chain)  # last action first
        for left in range(max(map(len, chains), default=0), -1, -1):
            worlds = [world for world, chain in enumerate(chains) if len(chain) == left]
            if worlds:
                self.pool.restore(store.load([origins[world] for world in worlds]), worlds)
            if left == 0:
                break
            running = [len(chain) >= left for chain in chains]
            actions = [chain[left - 1] if runs else 0 for chain, runs in zip(chains, running, strict=True)]
            self._hold(np.array(actions), len(actions), self.config.hold, keep=False)
            self.transitions += sum(running)

    def _hold(self, actions: Ints | Floats, count: int, lasts: int, *, keep: bool) -> _Held:
        """Hold an action in each of the first worlds of the pool for as many steps."""
        given = self._blank.clone()
        given[:count] = self.commands(actions)
        batch = TensorDict({"action": given.to(self.pool.device)}, batch_size=self.pool.batch_size)
        held, was_over = self._outcome(self.pool.step(batch)["next"]), np.zeros(self.worlds, dtype=np.bool_)
        for left in range(lasts - 1, -1, -1):
            if keep:
                for world in np.flatnonzero((held.ended & ~was_over)[:count]).tolist():
                    held.early[world] = self.pool.snapshot([world])
            if left == 0 or held.ended[:count].all():
                held.rewards += left * held.rest
                break
            was_over = held.ended
            held = _after(held, self._outcome(self.pool.step(batch)["next"]))
        held.rewards /= lasts
        return held

    def _outcome(self, data: TensorDictBase) -> _Held:
        """Outcome of an environment step on the host."""

        def host(values: Tensor) -> Any:
            return values.cpu().numpy().copy()

        return _Held(
            host(self.objective.rewards(data)),
            host(data["done"][:, 0]),
            host(self.objective.rest(data)),
            host(data["success"][:, 0]),
            host(data["distance"][:, 0].double()),
            {},
        )


def _joined(parts: Sequence[Transitions] | Sequence[Rollouts]) -> list[Any]:
    """Fields of outcomes of parts of a batch, each as one array."""
    names = [field.name for field in dataclasses.fields(parts[0])]
    return [np.concatenate([getattr(part, name) for part in parts]) for name in names]


def _after(held: _Held, now: _Held) -> _Held:
    """A held action and its next step as one; worlds that had ended earn their rest."""
    old = held.ended
    return _Held(
        held.rewards + np.where(old, held.rest, now.rewards),
        old | now.ended,
        np.where(old, held.rest, now.rest),
        np.where(old, held.success, now.success),
        np.where(old, held.distance, now.distance),
        held.early,
    )


def choice_count(env: SoftEnv, levels: int) -> int:
    """Discrete actions of an environment, or combinations of levels of its continuous one; 0 if there are too many."""
    count = env.action_count or levels**env.action_size
    return count if env.action_count or count <= MAX_CHOICES else 0


def _choices(env: SoftEnv, levels: int) -> Tensor:
    """Continuous actions that a planner of discrete ones chooses from, shape (choice, action_size)."""
    if env.action_count or not choice_count(env, levels):
        return torch.zeros((0, env.action_size))
    values = torch.linspace(-1.0, 1.0, levels).tolist()
    return torch.tensor(list(itertools.product(values, repeat=env.action_size)))


def _on(root: EnvSnapshot, device: torch.device) -> EnvSnapshot:
    """A snapshot on a device."""
    if next(iter(root.tensors.values())).device == device:
        return root
    arrays = {name: array.to(device) for name, array in root.sim.arrays.items()}
    tensors = {name: tensor.to(device) for name, tensor in root.tensors.items()}
    return EnvSnapshot(root.env, Snapshot(root.sim.fingerprint, root.sim.precision, arrays), tensors)
