"""Hand-written policies for MultiGaitFull: the gait of SofaGym's paper, and one that turns.

Turning needs left and right chambers apart. Legs that stand across from each other fill and empty together, the second
pair a quarter of a cycle behind the first: a wave that goes round the body, and turns it against the floor the way
that it goes. The centre stays empty. The other pair first turns the robot the other way.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from softwarp.policies.baselines.scripted import Policy

GAIT = (1, 0, 2, 4, 3, 5)  # fill rear, centre, front, then empty them in the same order
# Next action for what is full, 1 for the centre + 2 for the rear + 4 for the front legs; two of the eight are none of
# the gait's, and are led back to it.
NEXT = (1, 3, 0, 2, 5, 3, 0, 4)
_GROUPS = ((0,), (3, 4), (1, 2))  # chambers of centre, rear, front


# Pairs of legs across from each other, by chambers: rear right and front left, front right and rear left. In this order
# they turn the robot to the right.
PAIRS = ((4, 1), (2, 3))
MIRRORED = ((3, 2), (1, 4))  # to the left


def multi_gait_baseline(env: Any) -> Policy:
    """The gait of the paper, or with goals="headings" the one that turns; from observations alone.

    Args:
        env: A MultiGaitFull, bare or transformed, with chambers="symmetric" or goals="headings".

    Raises:
        ValueError: If its chambers are commanded one by one and it is to go forward.
    """
    config = env.config
    if config.goals == "headings":
        return _turning(env)
    if config.chambers != "symmetric":
        raise ValueError(
            f"the scripted policy of MultiGaitFull fills left and right alike, which needs chambers='symmetric', got "
            f"{config.chambers!r}; with goals='headings' it turns"
        )
    return _walking(env)


def _walking(env: Any) -> Policy:
    """Fill the rear legs, the centre, the front legs, then empty them in the same order."""
    kind = env.config.action_kind

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        share = env.decode(tensordict["observation"])["share"]
        full = torch.stack([share[..., group[0]] > 0.5 for group in _GROUPS], dim=-1).long()
        code = full[..., 0] + 2 * full[..., 1] + 4 * full[..., 2]
        choice = torch.tensor(NEXT, device=share.device)[code]
        if kind == "discrete":
            return tensordict.set("action", choice)
        group, fills = (choice % 3)[..., None], (choice < 3).long()[..., None]
        full = full.scatter(-1, group, fills)
        return tensordict.set("action", 2.0 * full.to(share.dtype) - 1.0)

    return policy


def _turning(env: Any) -> Policy:
    """Fill one pair of legs, then the other, empty the first, then the other, until half the tolerance is left to turn.

    Discrete actions fill and empty the chambers of a pair one after the other.
    """
    is_discrete, close = env.config.action_kind == "discrete", 0.5 * env.config.heading_tolerance
    orders = [_order(pairs, is_discrete) for pairs in (PAIRS, MIRRORED)]
    tables = torch.tensor([_next(len(order)) for order in orders])

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        told = env.decode(tensordict["observation"])
        share, turn = told["share"], told["turn"][..., 0]
        to_left = (turn > 0.0).long()
        full = torch.stack([(share[..., [group[0] for group in order]] > 0.5).long() for order in orders])
        code = (full * 2 ** torch.arange(full.shape[-1], device=share.device)).sum(dim=-1)
        code = torch.where(to_left > 0, code[1], code[0])
        step = tables.to(share.device)[to_left, code]  # place in the order, + its length to empty
        wait = turn.abs() <= close
        count = len(orders[0])
        if is_discrete:
            chambers = torch.tensor([[group[0] for group in order] for order in orders], device=share.device)
            chamber = chambers[to_left, step % count]
            action = chamber + torch.where(step < count, 0, share.shape[-1])
            emptied = torch.where(share[..., 0] > 0.5, 0, share.shape[-1])  # leaves the centre as it is
            return tensordict.set("action", torch.where(wait, emptied, action))
        member = torch.tensor([[[c in group for c in range(share.shape[-1])] for group in order] for order in orders])
        chosen = member.to(share.device)[to_left, step % count]
        fills = (step < count)[..., None].to(share.dtype)
        wanted = torch.where(chosen & ~wait[..., None], fills.expand_as(share), (share > 0.5).to(share.dtype))
        return tensordict.set("action", 2.0 * wanted - 1.0)

    return policy


def _order(pairs: tuple[tuple[int, ...], ...], is_discrete: bool) -> list[tuple[int, ...]]:
    """Groups of chambers that one action fills or empties, in order."""
    return [(chamber,) for pair in pairs for chamber in pair] if is_discrete else list(pairs)


def _next(count: int) -> list[int]:
    """What follows on every set of full groups, bit k for group k: k fills it, count + k empties it.

    Groups fill in order, then empty in order; any other set is emptied from its first full group on.
    """
    table = []
    for code in range(2**count):
        full = [bool(code >> k & 1) for k in range(count)]
        first = full.index(False) if False in full else count
        if first < count and not any(full[first:]):
            table.append(first)
        else:
            table.append(count + full.index(True))
    return table
