"""Hand-written policies for MultiGaitFull: the gait of SofaGym's paper, and one that turns.

Turning needs left and right chambers apart. A wave goes round the body from leg to leg, each of which is full for half
of a cycle, a quarter after the one before: it turns the robot the way that it goes, on the spot. Of all gaits of four
actions in which every leg, and the centre or not, is full for half of them, one turns the reduced robot faster, by a
tenth: the same wave with the centre, which leads it away. Here the centre stays empty.
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


# Legs in the order in which a wave that turns the robot to the right fills them, by chambers: front left, front right,
# rear right, rear left; and to the left.
RINGS = ((1, 2, 4, 3), (2, 1, 3, 4))


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
    """Send a wave round the legs until half the tolerance is left to turn.

    Continuous actions fill a leg while they empty the one two before it, discrete ones do one after the other.
    """
    is_discrete, close = env.config.action_kind == "discrete", 0.5 * env.config.heading_tolerance
    rings = torch.tensor(RINGS)
    fills = torch.tensor([_next_legs(code) for code in range(16)])
    single = torch.tensor([_next_leg(code) for code in range(16)])

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        told = env.decode(tensordict["observation"])
        share, turn = told["share"], told["turn"][..., 0]
        device = share.device
        full = share > 0.5
        ring = rings.to(device)[(turn > 0.0).long()]  # chamber of every place
        code = (full.gather(-1, ring).long() * 2 ** torch.arange(4, device=device)).sum(dim=-1)
        wait = turn.abs() <= close
        if is_discrete:
            place, is_filled = single.to(device)[code].unbind(dim=-1)
            chamber = ring.gather(-1, place[..., None])[..., 0]
            action = torch.where(is_filled > 0, chamber, chamber + share.shape[-1])
            same = torch.where(full[..., 0], 0, share.shape[-1])  # leaves the centre as it is
            return tensordict.set("action", torch.where(wait, same, action))
        wanted = torch.zeros_like(share).scatter(-1, ring, fills.to(share)[code])
        wanted = torch.where(wait[..., None], full.to(share.dtype), wanted)
        return tensordict.set("action", 2.0 * wanted - 1.0)

    return policy


def _places(code: int) -> tuple[int, int]:
    """Last place that is full where those that are follow each other, and how many; (-1, number) for any others."""
    full = [place for place in range(4) if code >> place & 1]
    for last in range(4):
        if full in ([last], sorted(((last - 1) % 4, last))):
            return last, len(full)
    return -1, len(full)


def _next_legs(code: int) -> list[int]:
    """Which places of a ring are full after those of a code, bit k for place k: one farther; none after a muddle."""
    last, count = _places(code)
    if last < 0:
        return [int(count == 0 and place == 0) for place in range(4)]
    return [int(place in (last, (last + 1) % 4)) for place in range(4)]


def _next_leg(code: int) -> tuple[int, int]:
    """A place, and whether it is filled (1) or emptied (0), towards the same."""
    last, count = _places(code)
    if last >= 0:
        return ((last + 1) % 4, 1) if count == 1 else ((last - 1) % 4, 0)
    return (0, 1) if count == 0 else (next(place for place in range(4) if code >> place & 1), 0)
