"""Implicit Q-learning from a Minari data set with TorchRL's loss: a policy from data alone, then tested.

    softwarp record minari:softwarp/stem-pendulum/scripted-v0 env=stem_pendulum episodes=400 noise=0.3
    python -m experiments.offline_iql softwarp/stem-pendulum/scripted-v0 --updates 10000

Continuous actions. Kostrikov, Nair and Levine (2022), Offline Reinforcement Learning with Implicit Q-Learning.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch
from tensordict.nn import InteractionType, TensorDictModule
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import IQLLoss, SoftUpdate

from softwarp.envs import registry
from softwarp.training.datasets import Transitions, from_minari
from softwarp.training.evaluation import run_episodes

LOSSES = ("loss_actor", "loss_qvalue", "loss_value")


def networks(data: Transitions) -> tuple[ProbabilisticActor, ValueOperator, ValueOperator]:
    """Actor, Q-function and value; the first layer of each scales observations as the data have them."""
    size, actions = data.observation.shape[-1], data.action.shape[-1]

    def body(inputs: int, outputs: int) -> MLP:
        return MLP(in_features=inputs, out_features=outputs, num_cells=[128, 128], activation_class=torch.nn.ReLU)

    head = torch.nn.Sequential(body(size, 2 * actions), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(head, in_keys=["scaled"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        default_interaction_type=InteractionType.DETERMINISTIC,
        return_log_prob=False,
    )
    q = ValueOperator(body(size + actions, 1), in_keys=["scaled", "action"], out_keys=["state_action_value"])
    return actor, q, ValueOperator(body(size, 1), in_keys=["scaled"], out_keys=["state_value"])


def train(args: argparse.Namespace) -> dict[str, float]:
    """Learn, then run episodes with the actor's mean; returns their summary."""
    torch.manual_seed(args.seed)
    data = from_minari(args.dataset)
    if not data.action.is_floating_point():
        raise ValueError(f"{args.dataset}: its actions are choices; this example is for continuous ones")
    mean, std = data.observation.mean(0), data.observation.std(0).clamp_min(1e-5)
    rows = data.tensordict()
    rows["scaled"], rows["next", "scaled"] = (data.observation - mean) / std, (data.after - mean) / std
    rows["action"] = data.action.clamp(-0.999, 0.999)  # where tanh's inverse is finite
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(data)), batch_size=args.batch)
    buffer.extend(rows)
    actor, q, value = networks(data)
    loss = IQLLoss(actor, q, value_network=value, temperature=args.temperature, expectile=args.expectile)
    loss.make_value_estimator(gamma=args.gamma)
    target = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=args.learning_rate)
    for update in range(args.updates):
        told = loss(buffer.sample())
        optimizer.zero_grad()
        sum(told[key] for key in LOSSES).backward()
        optimizer.step()
        target.step()
        if (update + 1) % max(1, args.updates // 5) == 0:
            losses = (f"{key} {float(told[key].detach()):.3g}" for key in LOSSES)
            print(f"{update + 1} updates, {', '.join(losses)}")

    def act(tensordict):  # type: ignore[no-untyped-def]
        tensordict["scaled"] = (tensordict["observation"] - mean) / std
        with torch.no_grad():
            return actor(tensordict)

    env = registry.make(**data.env, num_worlds=args.episodes, seed=args.seed)
    summary = run_episodes(env, act, seed=2_000_003).summary()
    shown = data.demonstrations()
    print(f"data: return {shown.returns.mean():.2f}, success {100.0 * shown.success.float().mean():.0f}%")
    print(f"learned: return {summary['return']:.2f}, success {100.0 * summary['success']:.0f}%")
    return summary


def main(argv: Sequence[str] | None = None) -> dict[str, float]:
    """Read the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", help="name of a Minari data set")
    parser.add_argument("--updates", type=int, default=10_000)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--gamma", type=float, default=0.97, help="discount")
    parser.add_argument("--expectile", type=float, default=0.7, help="of the value: 0.5 imitates, near 1 hopes")
    parser.add_argument("--temperature", type=float, default=3.0, help="how much better actions are preferred")
    parser.add_argument("--learning-rate", type=float, default=3e-4)
    parser.add_argument("--episodes", type=int, default=64, help="of the test")
    parser.add_argument("--seed", type=int, default=0)
    return train(parser.parse_args(argv))


if __name__ == "__main__":
    main()
