"""PPO in one file, from Gymnasium's vector environments and plain PyTorch alone, in the manner of CleanRL.

    python -m experiments.cleanrl_ppo softwarp/CartStem-v0 --steps 200000 --gamma 0.99

Nothing of softwarp is used but its Gymnasium ids, so the file can be copied and changed. Discrete and continuous
actions; the environment resets finished worlds in the same step and hands over their last observation, from which the
value of a truncated episode is bootstrapped.
"""

import argparse
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical, Independent, Normal

import softwarp.gym  # noqa: F401 - registers the ids

LAMBDA, CLIP, EPOCHS, MINIBATCHES = 0.95, 0.2, 5, 4


class Agent(nn.Module):
    """Actor, critic and the running scale of observations."""

    def __init__(self, observation_size: int, action_space: gymnasium.Space[Any]) -> None:
        super().__init__()
        self.is_discrete = isinstance(action_space, gymnasium.spaces.Discrete)
        size = int(action_space.n) if self.is_discrete else int(np.prod(action_space.shape or ()))  # type: ignore[attr-defined]
        self.actor = network(observation_size, size, 0.01)
        self.critic = network(observation_size, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((size,), -0.7))
        self.register_buffer("count", torch.tensor(1e-4, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(observation_size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(observation_size, dtype=torch.float64))

    def see(self, observation: Tensor) -> None:
        """Take observations (n, k) into the running mean and variance."""
        batch, n = observation.double(), len(observation)
        shift, total = batch.mean(0) - self.mean, self.count + n
        squares = self.var * self.count + batch.var(0, unbiased=False) * n + shift**2 * self.count * n / total
        self.mean, self.var, self.count = self.mean + shift * n / total, squares / total, total

    def scale(self, observation: Tensor) -> Tensor:
        """Observations with zero mean and unit variance, clipped."""
        scaled: Tensor = ((observation - self.mean) / self.var.sqrt().clamp_min(1e-5)).float().clamp(-10.0, 10.0)
        return scaled

    def act(self, scaled: Tensor) -> Categorical | Independent:
        """Distribution of actions."""
        if self.is_discrete:
            return Categorical(logits=self.actor(scaled))
        return Independent(Normal(self.actor(scaled), self.log_std.exp()), 1)


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Two hidden layers of 64, orthogonal weights."""
    layers = [nn.Linear(inputs, 64), nn.Linear(64, 64), nn.Linear(64, outputs)]
    for layer, factor in zip(layers, (2**0.5, 2**0.5, gain), strict=True):
        nn.init.orthogonal_(layer.weight, factor)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])


def train(args: argparse.Namespace) -> float:
    """Train for ``args.steps`` steps; returns the mean return of the last 100 episodes."""
    torch.manual_seed(args.seed)
    envs = gymnasium.make_vec(args.id, num_envs=args.worlds)
    agent = Agent(int(np.prod(envs.single_observation_space.shape or ())), envs.single_action_space)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)
    observation = torch.as_tensor(envs.reset(seed=args.seed)[0])
    agent.see(observation)
    finished: deque[float] = deque(maxlen=100)
    running, begun = np.zeros(args.worlds), time.perf_counter()
    updates = max(1, args.steps // (args.worlds * args.horizon))
    for update in range(updates):
        optimizer.param_groups[0]["lr"] = args.learning_rate * (1.0 - update / updates)
        seen, batch = [], []
        for _ in range(args.horizon):
            scaled = agent.scale(observation)
            with torch.no_grad():
                distribution = agent.act(scaled)
                action = distribution.sample()
                log_prob, value = distribution.log_prob(action), agent.critic(scaled)[:, 0]
            command = action.numpy() if agent.is_discrete else action.clamp(-1.0, 1.0).numpy()
            after, reward, terminated, truncated, info = envs.step(command)
            running += reward
            done, last = terminated | truncated, after.copy()
            for world in np.flatnonzero(done):
                last[world] = info["final_obs"][world]
                finished.append(float(running[world]))
                running[world] = 0.0
            with torch.no_grad():
                follows = agent.critic(agent.scale(torch.as_tensor(last)))[:, 0] * torch.as_tensor(~terminated)
            seen.append(observation)
            batch.append(
                (scaled, action, log_prob, value, torch.as_tensor(reward).float(), follows, torch.as_tensor(done))
            )
            observation = torch.as_tensor(after)
        learn(agent, optimizer, batch, args.gamma)
        agent.see(torch.cat(seen))
        if update % 10 == 9 or update == updates - 1:
            steps = (update + 1) * args.worlds * args.horizon
            speed = steps / (time.perf_counter() - begun)
            print(f"{steps:,} steps  {speed:,.0f}/s  return {np.mean(finished) if finished else np.nan:.2f}")
    envs.close()
    return float(np.mean(finished)) if finished else float("nan")


def learn(agent: Agent, optimizer: torch.optim.Optimizer, batch: list[tuple[Tensor, ...]], gamma: float) -> None:
    """Advantages, then epochs of minibatches."""
    scaled, action, log_prob, value, reward, follows, done = (torch.stack(part) for part in zip(*batch, strict=True))
    advantage, carried = torch.zeros_like(value), torch.zeros_like(value[0])
    for t in reversed(range(len(value))):
        error = reward[t] + gamma * follows[t] - value[t]
        carried = error + gamma * LAMBDA * ~done[t] * carried
        advantage[t] = carried
    target = (advantage + value).flatten()
    spread = target.std().clamp_min(1e-3)
    advantage = ((advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)).flatten()
    scaled, action, log_prob = scaled.flatten(0, 1), action.flatten(0, 1), log_prob.flatten()
    for _ in range(EPOCHS):
        for index in torch.randperm(len(target)).chunk(MINIBATCHES):
            distribution = agent.act(scaled[index])
            ratio = (distribution.log_prob(action[index]) - log_prob[index]).exp()
            gain = torch.minimum(ratio * advantage[index], ratio.clamp(1 - CLIP, 1 + CLIP) * advantage[index]).mean()
            error = (agent.critic(scaled[index])[:, 0] - target[index]) / spread
            optimizer.zero_grad()
            (-gain + 0.5 * error.square().mean()).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


def main(argv: Sequence[str] | None = None) -> float:
    """Read the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("id", nargs="?", default="softwarp/CartStem-v0", help="Gymnasium id")
    parser.add_argument("--steps", type=int, default=200_000, help="environment steps over all worlds")
    parser.add_argument("--worlds", type=int, default=64, help="worlds that step together")
    parser.add_argument("--horizon", type=int, default=32, help="steps per world between updates")
    parser.add_argument("--gamma", type=float, default=0.99, help="discount")
    parser.add_argument("--learning-rate", type=float, default=1e-3)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    if args.worlds * args.horizon < 2 * MINIBATCHES:
        parser.error(f"--worlds times --horizon must be at least {2 * MINIBATCHES}, got {args.worlds * args.horizon}")
    return train(args)


if __name__ == "__main__":
    main()
