"""Steps of environments as functions that torch differentiates: differences in float64, resets, refusals."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import softwarp as sw
from softwarp.envs.gradients import EnvSteps
from softwarp.envs.tasks.bubble_motion import BubbleMotion

STEPS = 2  # actions
TOLERANCE = 1e-6  # relative, of a directional derivative


@pytest.mark.parametrize(("name", "factors"), [("Trunk", False), ("Diamond", True)])
def test_gradients_of_rewards_and_observations_are_those_of_differences(name: str, factors: bool) -> None:
    """Central differences of fourth order along a random direction of all actions, from a moving start."""
    env = sw.make(name, num_worlds=2, seed=0, precision="float64", mesh="coarse")
    env.reset()
    generator = torch.Generator().manual_seed(0)
    env.step_and_reset(0.5 * torch.rand((2, env.action_size), generator=generator))
    start, steps = env.snapshot(), EnvSteps(env, factors=factors)
    actions = 0.1 + 0.6 * torch.rand((STEPS, 2, env.action_size), generator=generator).double()
    weight = 0.1 * torch.randn(env.observation_spec["observation"].shape, generator=generator).double()
    change = 1e-4 * torch.randn(actions.shape, generator=generator).double()

    def total(given: torch.Tensor) -> torch.Tensor:
        env.restore(start)
        steps.begin()
        led_to = [steps.step(action) for action in given]
        return sum(step.reward.sum() + (step.observation * weight).sum() for step in led_to)

    given = actions.clone().requires_grad_()
    total(given).backward()
    derivative = float((given.grad * change).sum())
    with torch.no_grad():
        at = [float(total(actions + factor * change)) for factor in (1.0, -1.0, 2.0, -2.0)]
    expected = (8.0 * (at[0] - at[1]) - (at[2] - at[3])) / 12.0
    scale = float((given.grad * change).abs().sum())
    assert abs(derivative - expected) <= TOLERANCE * max(abs(expected), 0.1 * scale)
    env.restore(start)
    steps.begin()
    mine = steps.step(actions[0])
    env.restore(start)
    after, _ = env.step_and_reset(actions[0].float())
    torch.testing.assert_close(mine.reward.float(), after["reward"].squeeze(-1), rtol=0, atol=5e-6)
    torch.testing.assert_close(mine.observation.float(), after["observation"], rtol=0, atol=5e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("factors", "passes"), [(False, 0), (True, 0), (True, None)])
def test_gradients_through_a_ball_that_rolls_on_a_soft_floor(
    factors: bool | None, passes: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """BubbleMotion by pressures: one action of 20 sub-steps with sticking contacts, and agreement with plain steps."""
    monkeypatch.setattr(BubbleMotion, "sweep_tolerance", 1e-15)
    env = sw.make("BubbleMotion", num_worlds=2, seed=0, precision="float64", contact_passes=passes)
    env.reset()
    start, steps = env.snapshot(), EnvSteps(env, factors=factors)
    generator = torch.Generator().manual_seed(0)
    action = torch.rand((2, 9), generator=generator).double() - 0.5
    weight, change = (torch.randn(size, generator=generator).double() for size in ((2, 19), (2, 9)))

    def total(given: torch.Tensor) -> torch.Tensor:
        env.restore(start)
        steps.begin()
        led_to = steps.step(given)
        return led_to.reward.sum() + (led_to.observation * weight).sum()

    given = action.clone().requires_grad_()
    total(given).backward()
    derivative = float((given.grad * change).sum())
    with torch.no_grad():
        expected = float(total(action + 1e-5 * change) - total(action - 1e-5 * change)) / 2e-5
    assert derivative == pytest.approx(expected, rel=1e-6)
    assert abs(derivative) > 1e-3
    env.restore(start)
    steps.begin()
    mine = steps.step(action)
    env.restore(start)
    after, _ = env.step_and_reset(action.float())
    torch.testing.assert_close(mine.reward.float(), after["reward"].squeeze(-1), rtol=0, atol=5e-6)
    torch.testing.assert_close(mine.observation.float(), after["observation"], rtol=0, atol=5e-6)


def test_no_gradient_passes_a_reset() -> None:
    """World 0 begins an episode with its first action: later rewards of it do not depend on that action."""
    env = sw.make("Diamond", num_worlds=2, seed=0, mesh="coarse")
    env.reset()
    steps = EnvSteps(env)
    first = torch.full((2, 4), 0.5, requires_grad=True)
    led_to = steps.step(first, torch.tensor([True, False]))
    assert led_to.after["done"].flatten().tolist() == [True, False]
    later = steps.step(torch.zeros(2, 4))
    assert torch.equal(led_to.now[1], led_to.observation[1])
    assert not torch.equal(led_to.now[0], led_to.observation[0])
    (gradient,) = torch.autograd.grad(later.reward.sum(), first)
    assert torch.equal(gradient[0], torch.zeros(4))
    assert (gradient[1] != 0.0).any()


def test_steps_of_one_environment_keep_what_each_is_told_to(monkeypatch: pytest.MonkeyPatch) -> None:
    """Captured steps too: the second one's are not those that were captured for the first, which kept no factors."""
    env = sw.make("Diamond", num_worlds=1, seed=0, mesh="coarse")
    env.captures.are_on = True
    env.reset()
    start, kept, found = env.snapshot(), [], []
    for factors in (False, True, False):
        env.restore(start)
        steps = EnvSteps(env, factors=factors)
        pull = steps.worlds.pull

        def noted(solution: object, *, parameters: bool, pull: object = pull) -> None:
            kept.append(solution is not None)
            pull(solution, parameters=parameters)

        monkeypatch.setattr(steps.worlds, "pull", noted)
        action = torch.full((1, 4), 0.5, requires_grad=True)
        found += torch.autograd.grad(steps.step(action).reward.sum(), action)
    assert kept == [False] * env.action_repeat + [True] * env.action_repeat + [False] * env.action_repeat
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("CartPole", {}, "CartPole: steps of this environment have no gradient"),
        ("Diamond", {"action_kind": "discrete"}, "Diamond: discrete actions have no gradient; take action_kind="),
        ("Diamond", {"reward": "paper"}, "Diamond: reward='paper' has no gradient"),
        ("Diamond", {"inversion_penalty": 1.0}, "Diamond: inversion_penalty has no gradient"),
        ("Diamond", {"integrator": "bdf2"}, "Diamond: steps of integrator 'bdf2' have no gradient"),
        (
            "Diamond",
            {"newton_iterations": 5},
            "Diamond: steps with newton_iterations=5 have no gradient in environments",
        ),
    ],
)
def test_what_has_no_gradient_is_refused_by_name(name: str, options: dict[str, object], message: str) -> None:
    """The message also says that other algorithms need none."""
    coarse = {"mesh": "coarse"} if name == "Diamond" else {}
    env = sw.make(name, num_worlds=1, seed=0, **coarse, **options)
    with pytest.raises(ValueError, match=message) as refused:
        EnvSteps(env)
    assert "algo=ppo" in str(refused.value)


@pytest.mark.slow
def test_steps_that_look_at_contacts_keep_factors() -> None:
    """With the first solution and what contacts look at: gradients are the same bits as without."""
    env = sw.make("BubbleMotion", num_worlds=2, seed=0)
    env.reset()
    start, found = env.snapshot(), []
    for factors in (False, True):
        env.restore(start)
        steps = EnvSteps(env, factors=factors)
        assert steps.factors == factors
        action = torch.full((2, 9), 0.2, requires_grad=True)
        found += torch.autograd.grad(steps.step(action).reward.sum(), action)
    assert found[0].abs().max() > 0.0
    assert torch.equal(found[0], found[1])


def test_gradients_that_are_not_unique_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worlds whose contacts repeat each other and slip have gradient 0 from there on back, others keep every bit."""
    env = sw.make("Diamond", num_worlds=2, seed=0, mesh="coarse")
    env.reset()
    start, steps = env.snapshot(), EnvSteps(env)
    actions = torch.full((STEPS, 2, env.action_size), 0.2)

    def gradient() -> torch.Tensor:
        env.restore(start)
        steps.begin()
        given = actions.clone().requires_grad_()
        for action in given:
            steps.step(action)
        steps.now["node_x"].square().sum().backward()
        assert given.grad is not None
        return given.grad

    sure = gradient()
    assert not steps.unsure.any()
    flags = torch.zeros(2, dtype=torch.int32)
    worlds = steps.worlds
    monkeypatch.setattr(worlds, "_unsure", [((0, 2), flags)])
    pull = worlds.pull

    def repeats(*arguments: Any, **options: Any) -> None:
        pull(*arguments, **options)
        flags[1] = 1

    monkeypatch.setattr(worlds, "pull", repeats)
    with pytest.warns(UserWarning, match="in world 1 and 0 others contacts that repeat each other slipped"):
        found = gradient()
    assert steps.unsure.tolist() == [False, True]
    assert torch.equal(found[:, 0], sure[:, 0])
    assert sure[:, 1].any()
    assert not found[:, 1].any()
    steps.begin()
    assert not steps.unsure.any()


def test_steps_that_were_held_back_are_told() -> None:
    """A world with elements inside out whose step is bounded has gradient 0 and is named; the other keeps every bit."""
    env = sw.make("Trunk", num_worlds=2, seed=0, mesh="coarse")
    env.reset()
    steps = EnvSteps(env)
    start = env.snapshot()
    actions = torch.full((2, env.action_size), 0.2)

    def gradient() -> torch.Tensor:
        steps.begin()
        given = actions.clone().requires_grad_()
        steps.step(given)
        steps.now["node_x"].square().sum().backward()
        assert given.grad is not None
        return given.grad

    sure = gradient()
    assert not steps.unsure.any()
    env.restore(start)
    x = env.sim.node_x[1]
    x[int((x - x.mean(dim=0)).norm(dim=1).argmin()), 0] += 0.025
    with pytest.warns(UserWarning, match="in world 1 and 0 others a step was held back"):
        found = gradient()
    assert int(env.sim.status[1]) < sw.Status.NONFINITE
    assert steps.unsure.tolist() == [False, True]
    assert sure.any(dim=1).all()
    assert torch.equal(found[0], sure[0])
    assert not found[1].any()
