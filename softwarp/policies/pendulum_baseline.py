"""A hand-written policy for StemPendulum: pump until a swing would just reach the top, then balance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor

Policy: TypeAlias = Callable[[TensorDictBase], TensorDictBase]  # reads "observation", writes "action"

# Linear quadratic regulator of (angle, spin, torque per largest) for actions of 0.1 s, from a least-squares fit of the
# simulated motion near the top; cost 50 angle^2 + 0.1 spin^2 + action^2. Uncontrolled, deviations triple per action.
GAINS = (6.44, 0.443, 1.32)
BALANCED = 2.0  # actions up to which the regulator's wish is listened to
NEAR = 0.7  # rad from the top
STIFFNESS = 147.0  # 1/s^2, 3 g / (2 L): of a rigid rod, spin' = this times sin(angle)
LEAD = 0.04  # s, by which pumping looks ahead, as torques grow during an action
SURPLUS = 0.15  # energy aimed at, beyond that of standing upright, in units of m g L / 2: what damping takes


def pendulum_baseline(env: Any) -> Policy:
    """The policy for StemPendulum with its default rod and motor, from its observations alone.

    It balances the rod after about half of all starts within an episode: at ten actions per second the swing that
    should end at the top is hard to dose, and it knows nothing of the spring.

    Args:
        env: A StemPendulum, bare or transformed, with ``observation="state"``.
    """
    gains = torch.tensor(GAINS)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        state = env.decode(tensordict["observation"])
        angle, spin, _ = state.unbind(dim=-1)
        balance: Tensor = -(state @ gains.to(state))
        energy = 0.5 * spin.square() / STIFFNESS + angle.cos() - 1.0
        forwards = spin + LEAD * STIFFNESS * angle.sin() >= 0.0
        pump = torch.where(forwards, 1.0, -1.0) * (SURPLUS - energy)
        is_near = (balance.abs() < BALANCED) & (angle.abs() < NEAR)
        return tensordict.set("action", torch.where(is_near, balance, pump).clamp(-1.0, 1.0)[..., None])

    return policy
