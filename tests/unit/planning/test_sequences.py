"""CEM and MPPI: known optima, weights, noise, repeatability."""

import math

import numpy as np
import pytest

from softwarp.planning.cem import CEM, CEMConfig, correlated_noise
from softwarp.planning.model import Rollouts
from softwarp.planning.mppi import MPPI, MPPIConfig, path_weights
from softwarp.planning.planners import PLANNERS, make_planner, pool_size
from tests.planning_cases import DoubleIntegrator, PointModel, TreeModel, scattered

TARGET = np.array([[0.8, -0.5], [0.1, 0.9], [-0.7, 0.0], [1.0, -1.0]])


@pytest.mark.parametrize(
    "planner",
    [CEM(CEMConfig(least_spread=1e-3, persistence=0.0)), MPPI(MPPIConfig(persistence=0.0, decay=0.9))],
    ids=["cem", "mppi"],
)
def test_finds_the_best_sequence(planner):
    """The reward's only maximum is the target, also at the edge of the range; value sum of gamma^t at most."""
    planner.config.expansions = 20_000
    found = planner.plan(PointModel(TARGET))
    np.testing.assert_allclose(found.actions, TARGET, atol=0.06)
    best = sum(planner.config.gamma**t for t in range(4))
    assert best - 0.01 < found.value <= best
    assert [entry["best"] for entry in found.history] == sorted(entry["best"] for entry in found.history)
    again = type(planner)(planner.config).plan(PointModel(TARGET))
    np.testing.assert_array_equal(again.actions, found.actions)


@pytest.mark.parametrize(
    "planner", [CEM(CEMConfig(expansions=60_000)), MPPI(MPPIConfig(expansions=60_000, decay=0.95))]
)
def test_linear_quadratic_control(planner):
    """A double integrator, 20 steps: discounted cost at most 5 % above the optimum, by linear least squares."""
    model, gamma = DoubleIntegrator(), planner.config.gamma
    found = planner.plan(model)
    unit = np.eye(20)[:, :, None]
    weight = np.sqrt(gamma ** np.arange(20))

    def parts(actions):
        place, speed, rows = np.ones(len(actions)), np.zeros(len(actions)), []
        for step, action in enumerate(actions[:, :, 0].T):
            place, speed = place + 0.25 * speed, speed + 0.25 * action
            rows += [weight[step] * place, weight[step] * speed, weight[step] * action]
        return np.stack(rows, axis=1)

    offset = parts(np.zeros((1, 20, 1)))[0]
    best = np.linalg.lstsq((parts(unit) - offset).T, -offset, rcond=None)[0]
    assert np.abs(best).max() < 1.0  # so that bounds do not matter
    least = model.costs(best[None, :, None])[0] @ weight**2
    cost = model.costs(found.actions[None])[0] @ weight**2
    assert least <= cost <= 1.05 * least
    assert found.value == pytest.approx((weight**2).sum() - cost / 8.0)


def test_budget_success_and_shift():
    """Rounds stop at the budget and at the first success on request; after acting, the mean moves on."""
    planner = CEM(CEMConfig(expansions=300, population=32))
    found = planner.plan(PointModel(TARGET))
    assert found.expansions == 3 * 32 * 4 or found.expansions <= 300
    planner = CEM(CEMConfig(expansions=100_000, until_success=True, least_spread=1e-3, persistence=0.0))
    model = PointModel(TARGET)
    found = planner.plan(model)
    assert found.success
    assert found.expansions < 100_000
    planner.advance(1)
    shifted = planner.plan(PointModel(TARGET[1:]))
    assert len(shifted.history) <= len(found.history)
    planner.forget()
    assert planner.plan(PointModel(TARGET)).history == found.history


def test_cem_fits_its_elites(rng):
    """By hand: 10 % of the old mean and deviation, 90 % of those of the best 3 of 5, which run again; floor 0.25."""
    planner = CEM(CEMConfig(population=8, elites=3, spread=0.5, least_spread=0.25, persistence=0.0))
    planner.begin(np.array([[0.2]]))
    samples = np.array([0.9, -0.6, 0.6, -0.9, 0.3])[:, None, None]
    mean = planner.refine(samples, np.array([3.0, 0.0, 2.0, -1.0, 1.0]))
    assert mean.item() == pytest.approx(0.1 * 0.2 + 0.9 * 0.6)
    fresh = planner.sample(20_003, rng)[:, 0, 0]
    np.testing.assert_array_equal(fresh[:3], [0.9, 0.6, 0.3])
    spread = 0.1 * 0.5 + 0.9 * 0.3 * np.sqrt(2.0 / 3.0)
    middle = fresh[3:][np.abs(fresh[3:] - 0.56) < 0.4]  # within the range; a normal cut at 0.4 is known by its tails
    assert len(middle) / 20_000 == pytest.approx(math.erf(0.4 / spread / np.sqrt(2.0)), abs=0.015)
    planner.refine(np.full((5, 1, 1), 0.1), np.zeros(5))
    planner.refine(np.full((5, 1, 1), 0.1), np.zeros(5))
    assert planner.sample(5_000, rng)[5:, 0, 0].std() == pytest.approx(0.25, rel=0.05)


def test_mppi_runs_its_mean_and_shrinks_its_noise(rng):
    """The first sample is the mean; the deviation is that of the settings, then 0.8 of it."""
    planner = MPPI(MPPIConfig(spread=0.2, persistence=0.0))
    planner.begin(np.array([[0.3]]))
    for spread in (0.2, 0.16):
        samples = planner.sample(5_000, rng)
        assert samples[0].item() == 0.3
        assert samples.std() == pytest.approx(spread, rel=0.05)
        planner.refine(samples[:1], np.zeros(1))


def test_weights_leave_the_part_effective_that_was_asked_for():
    """1 / sum w^2 over n, by the definition; equal values weigh equally."""
    values = np.linspace(0.0, 3.0, 50) ** 2
    for part in (0.05, 0.2, 0.6):
        weights = path_weights(values, part)
        assert weights.sum() == pytest.approx(1.0)
        assert 1.0 / np.square(weights).sum() / 50 == pytest.approx(part, rel=1e-3)
        assert (np.diff(weights) >= 0.0).all()
    np.testing.assert_allclose(path_weights(np.ones(8), 0.1), 1.0 / 8.0)


def test_noise_has_the_correlation_that_was_asked_for(rng):
    noise = correlated_noise(rng, (20_000, 6, 1), 0.8)[..., 0]
    np.testing.assert_allclose(noise.std(axis=0), 1.0, atol=0.03)
    np.testing.assert_allclose(np.corrcoef(noise.T)[0], 0.8 ** np.arange(6), atol=0.03)


def test_a_round_is_made_whatever_the_time_and_none_at_the_end_of_an_episode():
    """No time at all: one round all the same. No actions left: an empty plan of value 0, and nothing to go on from."""
    planner = CEM(CEMConfig(seconds=1e-9))
    found = planner.plan(PointModel(TARGET))
    assert (len(found.history), found.actions.shape) == (1, (4, 2))
    planner.forget()
    over = planner.plan(PointModel(TARGET[:0]))
    assert (over.value, over.success, over.actions.shape) == (0.0, None, (0, 2))
    planner.advance(1)
    assert planner.plan(PointModel(TARGET)).history == found.history


def test_needs_continuous_actions():
    with pytest.raises(ValueError, match="cem: needs continuous actions, the model has 2 discrete ones"):
        CEM().plan(TreeModel(scattered))


def test_every_planner_of_the_table_can_be_made():
    """By its settings alone; an unknown name lists the valid ones. 8 expansions of 7 actions are 56 worlds."""
    rounds = {"opd": 56, "uct": 8, "olop": 8, "kl_olop": 8, "cem": 64, "mppi": 64}
    for name, (config_class, planner_class) in PLANNERS.items():
        config = config_class()
        assert config.name == name
        assert isinstance(make_planner(config), planner_class)
        assert pool_size(config, 7) == rounds[name]
    config.name = "opt"
    with pytest.raises(ValueError, match="'opt' is unknown; choose from opd, uct, olop, kl_olop, cem, mppi"):
        make_planner(config)


class ShortModel(PointModel):
    """Twenty actions; a first one above 0 ends the episode, which earns 0.5 for ever, others earn 0.6 a step."""

    def __init__(self):
        super().__init__(np.zeros((20, 1)))

    def roll_out(self, states, actions):
        ended = actions[:, 0, 0] > 0.0
        rewards = np.where(ended[:, None], 0.5, np.full(actions.shape[:2], 0.6))
        lengths = np.where(ended, 1, actions.shape[1])
        return Rollouts(rewards, lengths, ended, 0.5 * ended, np.zeros_like(ended), np.full(len(ended), np.nan))


@pytest.mark.parametrize("planner", [CEM(CEMConfig(horizon=4)), MPPI(MPPIConfig(horizon=4))])
def test_an_end_counts_no_longer_than_sequences_that_go_on(planner):
    """Of four actions out of twenty 0.6 each is more than 0.5 each after an end; for ever the end would be worth 50."""
    found = planner.plan(ShortModel())
    assert found.actions[0, 0] <= 0.0
    assert found.value == pytest.approx(0.6 * (1.0 - 0.99**4) / 0.01)
    near_the_end = type(planner)(type(planner.config)(horizon=20)).plan(ShortModel())
    assert near_the_end.actions[0, 0] <= 0.0  # a horizon that is asked for is one, however much is left
    whole = type(planner)(type(planner.config)()).plan(ShortModel())
    assert whole.actions[0, 0] > 0.0  # all that the episode has left: what ends earns on, what goes on earns 0 after it


@pytest.mark.parametrize("kind", [CEM, MPPI])
def test_what_is_left_of_a_plan_is_run_again(kind):
    """A goal that a plan meets is met by the rest of it in the first round of the next one, which is not its mean."""
    planner = make_planner(kind().config)
    planner.config.until_success, planner.config.persistence, planner.config.expansions = True, 0.0, 200_000
    found = planner.plan(PointModel(TARGET))
    assert found.success and len(found.history) > 1
    planner.advance(2)
    rest = planner.plan(PointModel(TARGET[2:]))
    assert rest.success and len(rest.history) == 1
    planner.advance(2)  # all of it
    assert planner.plan(PointModel(TARGET)).history[0]["best"] < 4.0


def test_every_plan_draws_anew():
    """Other samples around the same mean in every plan; a planner that has been made to forget repeats them."""

    def rounds(planner):
        found = [planner.plan(PointModel(TARGET)).history]
        planner._last = planner._plan = None
        return [*found, planner.plan(PointModel(TARGET)).history]

    planner = MPPI(MPPIConfig(expansions=256, population=64))
    first, second = rounds(planner)
    assert first != second
    planner.forget()
    assert rounds(planner) == [first, second]


class BlindModel(PointModel):
    """Rewards that depend on the first entry of an action alone."""

    def roll_out(self, states, actions):
        blind = actions.copy()
        blind[..., 1] = self.target[: actions.shape[1], 1]
        return super().roll_out(states, blind)


@pytest.mark.parametrize("kind", [CEM, MPPI])
def test_the_nominal_action_is_kept_where_nothing_is_earned(kind):
    """An entry without effect walks at random from plan to plan; with a cost of its distance it stays there."""
    offs = []
    for cost in (0.0, 0.2):
        planner = make_planner(kind().config)
        for name, value in (("nominal", [0.0, 0.8]), ("nominal_cost", cost), ("horizon", 4), ("population", 16)):
            setattr(planner.config, name, value)
        planner.config.expansions = 16 * 4 * 4
        model, off = BlindModel(np.tile([0.5, 0.0], (60, 1))), []
        for _ in range(20):
            found = planner.plan(model)
            off.append(found.actions[:2] - [0.5, 0.8])
            planner.advance(2)
            model = BlindModel(model.target[2:])
        offs.append(np.sqrt(np.square(np.concatenate(off)).mean(axis=0)))
    free, held = offs
    assert held[1] < 0.5 * free[1]
    assert held[0] < 0.2
    with pytest.raises(ValueError, match="nominal: must hold 2 entries"):
        kind(type(planner.config)(nominal=[0.0])).plan(model)
    with pytest.raises(ValueError, match="entries in \\[-1, 1\\]"):
        type(planner.config)(nominal=[0.0, 2.0])
