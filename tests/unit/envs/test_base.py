"""SoftEnv on a fake simulator: counting, resets, failed worlds, actions, branching, logging."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import RewardSum, StepCounter, TransformedEnv
from torchrl.envs.transforms import Compose
from torchrl.envs.utils import check_env_specs

from tests.unit.envs.fake import PointConfig, PointEnv

N = 4


def make(num_worlds=N, seed=3, **options):
    return PointEnv(PointConfig(**options), num_worlds=num_worlds, seed=seed)


def act(env, action=None):
    """Step with one action for all worlds, or random ones; the "next" part."""
    action = env.action_spec.rand() if action is None else action.expand(env.action_spec.shape).clone()
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("transformed", [False, True])
def test_specs(discrete, transformed):
    env = make(discrete=discrete)
    if transformed:
        env = TransformedEnv(env, Compose(StepCounter(), RewardSum()))
    check_env_specs(env, break_when_any_done="both")


def test_substeps_are_exact():
    """Every action takes exactly action_repeat sub-steps, numbered from 0, however many actions there are."""
    env = make(action_repeat=3)
    settling = env.sim.steps
    env.reset()
    for _ in range(50):
        act(env)
    assert env.sim.steps - settling == 150
    assert env.seen_substeps == [0, 1, 2] * 50


def test_truncates_at_exactly_max_episode_steps():
    env = make(max_episode_steps=8)
    env.reset()
    flags = [act(env)["truncated"].all().item() for _ in range(8)]
    assert flags == [False] * 7 + [True]
    data = env.reset()
    assert not data["done"].any() and not env.step_count.any()


def test_settles_once_and_returns_there():
    """The settled state, 0.25 in the fake, is the start of every episode and the same in all worlds."""
    env = make()
    for _ in range(2):
        assert torch.equal(env.reset()["observation"][:, :2], torch.full((N, 2), 0.25))
        act(env)
    assert torch.equal(make(settle=False).reset()["observation"][:, :2], torch.zeros(N, 2))


def test_masked_reset_leaves_the_others_bit_equal():
    env, untouched = make(), make()
    for e in (env, untouched):
        e.reset()
        for k in range(3):
            act(e, torch.tensor([0.1 * k, -0.2]))
    before = {name: tensor.clone() for name, tensor in env.world_state.items()}
    mask = torch.tensor([False, True, False, True])
    data = env.reset(TensorDict({"_reset": mask[:, None], "done": torch.zeros(N, 1, dtype=torch.bool)}, [N]))
    for name, tensor in env.world_state.items():
        assert torch.equal(tensor[~mask], before[name][~mask]), name
    assert (env.step_count[mask] == 0).all() and (env.episode_sums["progress"][mask] == 0).all()
    assert not torch.equal(data["observation"][mask], before["last_observation"][mask])
    a, b = act(env, torch.tensor([0.5, 0.5])), act(untouched, torch.tensor([0.5, 0.5]))
    for key in ("observation", "reward", "distance"):
        assert torch.equal(a[key][~mask], b[key][~mask])


def test_same_seed_same_bits_and_next_seed_differs():
    first, again, other = (make(seed=s).reset()["observation"] for s in (5, 5, 6))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    env = make(seed=6)
    env.reset()
    env.set_seed(5)
    assert torch.equal(env.reset()["observation"], first)


def test_goals_do_not_depend_on_batch_or_neighbours():
    """World i in its third episode has the same goal alone, in a batch, and whatever the others did before."""
    small, large = make(num_worlds=2), make(num_worlds=6)
    small.reset(), large.reset()
    for _ in range(2):
        small.reset()
        large.reset_where(torch.tensor([False, True, False, True, False, False]))
    assert torch.equal(small.goal[1], large.goal[1])
    assert not torch.equal(small.goal[0], large.goal[0])


def test_seed_worlds_equals_single_environments():
    env = make(num_worlds=2)
    env.seed_worlds([11, 12])
    env.reset()
    for world, seed in enumerate((11, 12)):
        single = make(num_worlds=1)
        single.seed_worlds([seed])
        single.reset()
        assert torch.equal(env.goal[world], single.goal[0])


def test_seeds_are_checked():
    env = make()
    with pytest.raises(ValueError, match="one seed for each of 4 worlds, got"):
        env.seed_worlds([1, 2])
    with pytest.raises(ValueError, match="seed must be an integer that lies in"):
        env.set_seed(-1, static_seed=True)
    assert make(seed=None).seed != make(seed=None).seed


def test_values_do_not_alias():
    """What step and reset return keeps its value when the environment goes on."""
    env = make()
    kept = env.reset()
    first = {key: value.clone() for key, value in kept.items()}
    step = act(env, torch.tensor([1.0, 0.0]))
    stepped = {key: value.clone() for key, value in step.items()}
    for _ in range(3):
        act(env)
    assert all(torch.equal(kept[key], first[key]) for key in first)
    assert all(torch.equal(step[key], stepped[key]) for key in stepped)


def test_terminal_observation_is_the_last_of_the_episode():
    """A rollout with automatic reset stores under "next" where the step led, not the new start."""
    env = make(max_episode_steps=4)
    data = env.rollout(9, break_when_any_done=False)
    ends = data["next", "done"][..., 0]
    assert ends.sum() == 2 * N
    assert (data["next", "observation"][ends][:, :2] != 0.25).all()
    starts = data["observation"][:, [0, 4, 8], :2]
    assert (starts == 0.25).all()


def test_failed_world_ends_alone_and_finite():
    """World 2 is commanded to 1000 m: it is reported and ends with its last good observation; others do not notice."""
    env, healthy = make(check_actions=False), make()
    for e in (env, healthy):
        e.reset()
        act(e, torch.tensor([0.5, 0.5]))
    last = env.world_state["last_observation"].clone()
    action = torch.full((N, 2), 0.75)
    expected = act(healthy, action)
    action[2] = 1000.0
    data = act(env, action)
    others = [0, 1, 3]
    assert data["world_status"].flatten().tolist() == [0, 0, 3, 0]
    assert data["terminated"].flatten().tolist() == [False, False, True, False]
    assert torch.equal(data["observation"][2], last[2])
    assert data["reward"][2].item() == -1.0
    for key in ("observation", "reward", "distance"):
        assert torch.isfinite(data[key]).all()
        assert torch.equal(data[key][others], expected[key][others])


def test_inverted_elements_end_or_cost_where_asked():
    """By default they are told only; world 2 has some."""
    told, asked = make(), make(end_on_inversion=True, inversion_penalty=0.5)
    rewards = []
    for env in (told, asked):
        env.reset()
        env.sim.inverted_count[2] = 7
        data = act(env, torch.tensor([0.5, 0.5]))
        assert data["terminated"].flatten().tolist() == [False, False, env is asked, False]
        rewards.append(data["reward"].flatten())
    assert torch.allclose(rewards[0] - rewards[1], torch.tensor([0.0, 0.0, 0.5, 0.0]))
    assert asked.episode_sums["inversion"].tolist() == [0.0, 0.0, -0.5, 0.0] and "inversion" not in told.episode_sums


def test_silent_nan_is_caught():
    """A state that is NaN although the simulator reports no fault: same treatment, status NONFINITE."""
    env = make()
    start = env.reset()
    env.sim.corrupt[1] = True
    data = act(env, torch.tensor([0.5, 0.5]))
    assert data["world_status"].flatten().tolist() == [0, 3, 0, 0]
    assert data["terminated"][1] and not data["success"][1]
    assert torch.isfinite(data["observation"]).all() and torch.isfinite(data["reward"]).all()
    assert torch.equal(data["observation"][1], start["observation"][1])
    healed = env.reset_where(torch.tensor([False, True, False, False]))
    assert torch.isfinite(healed["observation"]).all()
    assert act(env)["world_status"].sum() == 0


def test_observation_is_clipped_to_its_bounds():
    env = make(limits=[-0.1, 0.1])
    data = env.rollout(5)
    assert data["observation"].abs().max() == pytest.approx(0.1)
    assert env.observation_spec["observation"].is_in(data["observation"][:, 0])


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.zeros(N, 3), r"action must have shape \(4, 2\), got \(4, 3\)"),
        (torch.zeros(N, 2, dtype=torch.float64), "action must be torch.float32, got torch.float64"),
        (torch.zeros(N, 2, dtype=torch.int64), "action must be torch.float32, got torch.int64"),
        (torch.tensor([[0.0, 0.0], [torch.nan, 0.0], [0.0, 0.0], [0.0, torch.inf]]), "must be finite; world 1, 3 got"),
    ],
)
def test_bad_continuous_action(action, message):
    """Refused before anything moves."""
    env = make(settle=False)
    env.reset()
    with pytest.raises(ValueError, match=message):
        env.step(TensorDict({"action": action}, batch_size=[N]))
    assert env.sim.steps == 0


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.tensor([0, 4, 1, -1]), r"must lie in \[0, 3\]; world 1, 3 got something else, for example 4"),
        (torch.zeros(N), "action must be torch.int64, got torch.float32"),
        (torch.zeros(N, 1, dtype=torch.int64), r"action must have shape \(4,\)"),
    ],
)
def test_bad_discrete_action(action, message):
    env = make(discrete=True)
    env.reset()
    with pytest.raises(ValueError, match=message):
        env.step(TensorDict({"action": action}, batch_size=[N]))


def test_end_on_success():
    """Standing on the goal ends the episode only if asked."""
    for wanted in (False, True):
        env = make(end_on_success=wanted)
        env.reset()
        env.goal.copy_(env.sim.x)
        data = act(env, torch.tensor([0.25, 0.25]))
        assert data["success"].all()
        assert data["terminated"].all().item() is wanted


def test_snapshot_replays_the_same_bits():
    """State, goals, timers and future draws: 20 random steps with resets, twice."""
    env = make(max_episode_steps=5)
    env.reset()
    act(env)
    saved = env.snapshot()
    actions = [env.action_spec.rand() for _ in range(20)]

    def replay():
        history = []
        for action in actions:
            data = act(env, action)
            history.append({key: value.clone() for key, value in data.items()})
            if data["done"].any():
                history.append({"observation": env.reset_where(data["done"].flatten())["observation"]})
        return history

    first = replay()
    env.restore(saved)
    for one, two in zip(first, replay(), strict=True):
        assert all(torch.equal(one[key], two[key]) for key in one)


def test_snapshot_survives_a_file(tmp_path):
    """As plain tensors and text, which loading without pickled code accepts."""
    env = make()
    env.reset()
    act(env, torch.tensor([0.5, -0.5]))
    torch.save(env.snapshot().state_dict(), tmp_path / "env.pt")
    expected = act(env, torch.tensor([0.1, 0.2]))
    other = make(seed=99)
    other.restore(torch.load(tmp_path / "env.pt", weights_only=True))
    data = act(other, torch.tensor([0.1, 0.2]))
    assert all(torch.equal(data[key], expected[key]) for key in ("observation", "reward", "distance"))


def test_branch_one_world_into_many():
    env = make()
    env.reset()
    act(env, torch.tensor([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6], [0.7, 0.8]]))
    env.restore(env.snapshot([2]), [0, 3])
    assert torch.equal(env.sim.x[[0, 3]], env.sim.x[[2, 2]])
    assert torch.equal(env.goal[[0, 3]], env.goal[[2, 2]])
    env.reset()
    assert torch.equal(env.goal[0], env.goal[3])  # the copies go on as their origin would
    env.restore(env.snapshot(0), [1, 2, 3], keep_streams=True)
    env.reset()
    assert not torch.equal(env.goal[1], env.goal[2])


def test_foreign_snapshot_is_refused():
    class OtherEnv(PointEnv):
        pass

    env = make()
    with pytest.raises(ValueError, match="snapshot of OtherEnv does not fit this PointEnv"):
        env.restore(OtherEnv(PointConfig(), num_worlds=N).snapshot())
    with pytest.raises(ValueError, match="holds 2 worlds, cannot fill 4"):
        env.restore(env.snapshot([0, 1]))
    with pytest.raises(ValueError, match=r"worlds must lie in \[0, 3\], got \[4\]"):
        env.snapshot([4])


def test_partial_step_leaves_idle_worlds():
    """TorchRL's "_step" mask: worlds that are not stepped keep every bit."""
    env = make()
    env.reset()
    act(env, torch.tensor([0.3, 0.3]))
    before = {name: tensor.clone() for name, tensor in env.world_state.items()}
    x = env.sim.x.clone()
    active = torch.tensor([True, False, True, False])
    data = env.step(TensorDict({"action": torch.full((N, 2), 0.9), "_step": active}, batch_size=[N]))["next"]
    for name, tensor in env.world_state.items():
        assert torch.equal(tensor[~active], before[name][~active]), name
    assert torch.equal(env.sim.x[~active], x[~active]) and not torch.equal(env.sim.x[active], x[active])
    assert (data["reward"][~active] == 0).all()
    assert env.step_count.tolist() == [2, 1, 2, 1]


def test_reward_is_the_sum_of_logged_terms():
    """Returns by hand equal episode_sums and, at the end of the episodes, the log's means."""
    env = make(max_episode_steps=6)
    assert env.reward_names == ("progress", "precision", "failure")
    env.reset()
    total = torch.zeros(N)
    for _ in range(6):
        total += act(env)["reward"].flatten()
    torch.testing.assert_close(sum(env.episode_sums.values()), total)
    log = env.pop_episode_log()
    assert log["episodes"] == N and log["length"] == 6.0 and log["failed"] == 0.0
    assert log["return"] == pytest.approx(total.mean().item(), rel=1e-5)
    assert log["distance"] == pytest.approx(env.distance.mean().item(), rel=1e-5)
    assert sum(value for key, value in log.items() if key.startswith("reward/")) == pytest.approx(
        log["return"], rel=1e-5
    )
    assert env.pop_episode_log() == {"episodes": 0.0}


def test_device_move_is_refused():
    env = make()
    assert env.to("cpu") is env
    with pytest.raises(ValueError, match="lives on cpu and cannot move to meta"):
        env.to("meta")


@pytest.mark.parametrize(("option", "value"), [("dt", 0.0), ("action_repeat", 0), ("precision", "half")])
def test_options_are_checked(option, value):
    with pytest.raises(ValueError, match=rf"PointConfig: (unknown )?{option} .*{value}"):
        PointConfig(**{option: value})


def test_the_task_ends_a_world():
    """``is_terminated`` ends single worlds, whose last step counts; reset starts them anew."""
    env = make(edge=0.5, end_on_success=False)
    env.reset()
    action = torch.tensor([[0.0, 0.0], [2.0, 0.0], [0.0, 0.0], [0.0, -3.0]])
    data = act(env, action)
    assert data["terminated"].flatten().tolist() == [False, True, False, True]
    assert (data["world_status"] == 0).all() and (data["reward"] != 0).all()
    assert not env.reset()["terminated"].any()


class LostStart(PointEnv):
    """Its resets put a start that is not finite into some worlds."""

    where = "position"

    def reset_worlds(self, mask):
        super().reset_worlds(mask)
        lost = mask & torch.tensor([False, True, False, True])
        target = self.sim.x if self.where == "position" else self.goal
        target.masked_fill_(lost[:, None], torch.inf)


@pytest.mark.parametrize("where", ["position", "goal"])
@pytest.mark.parametrize("captured", [False, True])
def test_a_start_that_is_not_finite_is_told(where, captured):
    """The reset reports NONFINITE and its last good numbers; the neighbours keep the bits that they have elsewhere."""
    env, healthy = LostStart(PointConfig(), num_worlds=N, seed=3), make()
    env.where, env.captures.are_on = where, captured
    data, good = env.reset(), healthy.reset()
    assert data["world_status"].flatten().tolist() == [0, 3, 0, 3]
    for key in ("observation", "distance"):
        assert torch.isfinite(data[key]).all()
        assert torch.equal(data[key][::2], good[key][::2])
    assert not data["success"][1::2].any() and not data["done"].any()
    data, good = act(env, torch.zeros(2)), act(healthy, torch.zeros(2))
    assert all(torch.isfinite(data[key]).all() for key in ("observation", "distance", "reward"))
    for key in ("observation", "distance", "reward", "terminated", "world_status"):
        assert torch.equal(data[key][::2], good[key][::2])
    if where == "goal":  # which the simulation does not know, so that every step finds it anew
        assert data["world_status"].flatten().tolist() == [0, 3, 0, 3] and data["terminated"][1::2].all()


def test_a_scene_that_starts_nowhere_is_refused():
    """At construction, before any world is stepped."""

    class Nowhere(PointEnv):
        def make_simulation(self, num_worlds):
            sim = super().make_simulation(num_worlds)
            sim.x.fill_(torch.nan)
            return sim

    with pytest.raises(ValueError, match="Nowhere: the scene's initial state is not finite"):
        Nowhere(PointConfig(settle=False), num_worlds=2, seed=0)


@pytest.mark.parametrize(
    ("dt", "status", "message"),
    [
        (100.0, 3, r"Restless: the start state fails \(NONFINITE\) while it comes to rest; check .* 100 s"),
        (100.0, 0, "Restless: the start state still moves at 1 m/s after 60 s"),
        (0.5, 0, "Restless: the start state still moves at 1 m/s after 60 s"),
    ],
)
def test_what_does_not_come_to_rest_is_refused(dt, status, message):
    """Also where one look at the speed takes longer than all the time there is."""

    class Restless(PointEnv):
        def make_simulation(self, num_worlds):
            sim = super().make_simulation(num_worlds)
            sim.node_v.fill_(1.0)
            sim.step = lambda: sim.status.fill_(status)
            return sim

    with pytest.raises(ValueError, match=message):
        Restless(PointConfig(dt=dt), num_worlds=2, seed=0)


def test_choices_out_of_range_are_told_although_nobody_checks():
    """check_actions=False: the world acts with 0, the others as ever, and the next call names it, once."""
    env, healthy = make(discrete=True, check_actions=False), make(discrete=True, check_actions=False)
    for e in (env, healthy):
        e.reset()
    data = env.step(TensorDict({"action": torch.tensor([1, 4, -1, 3])}, batch_size=[N]))["next"]
    same = healthy.step(TensorDict({"action": torch.tensor([1, 0, 0, 3])}, batch_size=[N]))["next"]
    for key in ("observation", "reward", "distance"):
        assert torch.equal(data[key], same[key])
    told = r"lie in \[0, 3\]; world 1, 2 got something else, for example 4. Actions are not checked.*acted with 0"
    with pytest.raises(ValueError, match=told):
        act(env, torch.tensor(0))
    act(env, torch.tensor(0))


def test_episodes_with_contacts_without_a_place_are_counted():
    """As a fraction of the episodes that ended, beside those that failed."""
    env = make()
    env.reset()
    env.sim.contact_overflow[1] = 2
    for _ in range(8):
        act(env, torch.zeros(2))
    log = env.pop_episode_log()
    assert log["overflowed"] == 1 / N and log["failed"] == 0.0
