"""A hand-written policy for StemPendulum: pump until a swing would just reach the top, then balance."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.policies.baselines.scripted import Policy

# Linear quadratic regulator of (angle, spin, torque per largest) for actions of 0.1 s, from a least-squares fit of the
# simulated motion near the top; cost 50 angle^2 + 0.1 spin^2 + action^2. Uncontrolled, deviations triple per action.
GAINS = (6.44, 0.443, 1.32)
BALANCED = 3.0  # actions up to which the regulator's wish is listened to
NEAR = 0.7  # rad from the top
STIFFNESS = 147.0  # 1/s^2, 3 g / (2 L): of a rigid rod, spin' = this times sin(angle)
WEIGHT = 0.6165  # N m, m g L / 2: half the energy between hanging and standing
LEAD = 0.03  # s, by which pumping looks ahead, as torques grow during an action
SURPLUS = 0.08  # energy aimed at, beyond that of standing upright, in units of WEIGHT: what damping takes


def pendulum_baseline(env: Any) -> Policy:
    """The policy for StemPendulum with its default rod, from its observations alone.

    It pumps in proportion to the energy that is missing, the spring's included, then balances against the spring. Of
    random starts three in four end upright: at ten actions per second the last swing is hard to dose.

    Args:
        env: A StemPendulum, bare or transformed, with ``observation="state"``.
    """
    gains = torch.tensor(GAINS)
    largest, spring = env.config.max_torque, env.config.root_stiffness

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        angle, spin, torque, moment = env.decode(tensordict["observation"]).unbind(dim=-1)
        balance: Tensor = -(torch.stack((angle, spin, torque + moment), dim=-1) @ gains.to(angle))
        is_near = (balance.abs() < BALANCED) & (angle.abs() < NEAR)
        at_top = moment + spring / largest * angle  # the spring's moment there, per largest torque
        stored = largest**2 / (2.0 * spring * WEIGHT) * (moment.square() - at_top.square())
        energy = 0.5 * spin.square() / STIFFNESS + angle.cos() - 1.0 + stored
        forwards = spin + LEAD * STIFFNESS * angle.sin() >= 0.0
        pump = torch.where(forwards, 1.0, -1.0) * (SURPLUS - energy).clamp(-1.0, 1.0)
        action = torch.where(is_near, balance - moment, pump).clamp(-1.0, 1.0)
        return tensordict.set("action", action[..., None])

    return policy
