"""Fits with exact derivatives: the same optimum as with differences, from fewer evaluations; what is refused."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Diverged, Equilibrium
from softwarp.identification import Differentiable, Parameter, Worlds, fit

X = torch.linspace(0.0, 1.0, 21, dtype=torch.float64)
FORCES = np.array([0.0, 0.2, 0.5])  # N, tension of a cable in every experiment
PARAMETERS = [
    Parameter("youngs", 5e4, 5e5, scale="log", unit="Pa", target="youngs"),
    Parameter("density", 500.0, 2000.0, unit="kg/m^3", target="density"),
]
TRUE = {"youngs": 1.7e5, "density": 1200.0}


def beam(num_worlds: int) -> tuple[sw.Simulation, int]:
    """A beam of quadratic elements that hangs, held at one end, with a cable above its axis."""
    builder = sw.ModelBuilder()
    mesh = meshing.elevate(meshing.box((0.1, 0.02, 0.02), (2, 1, 1)))
    body = builder.add_tets(mesh, material=sw.NeoHookean(1e5, 0.4), density=1000.0)
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    builder.add_cable(body, [(0.0, 0.01, 0.018), (0.1, 0.01, 0.018)], control="force")
    tip = builder.add_marker(body, (0.1, 0.01, 0.01))
    return sw.Simulation(builder.finalize(num_worlds=num_worlds, precision="float64")), tip


def test_poses_of_a_beam() -> None:
    """Three loads, two parameters: all ways find the values that made the measurements; derivatives are exact."""
    sim, tip = beam(3)
    equilibrium = Equilibrium(sim)
    tension = torch.tensor(FORCES)[:, None]
    solves = []

    def tips(values: torch.Tensor) -> torch.Tensor:
        solves.append(len(values))
        parameters = {"youngs": values[:, :1], "density": values[:, 1:]}
        pose = equilibrium({"cable_tension": tension}, parameters, tolerance=1e-11)
        return 1e3 * pose.marker_x[:, tip, ::2]  # mm

    measured = tips(torch.tensor([list(TRUE.values())] * 3, dtype=torch.float64))
    model = Differentiable(lambda values: tips(values) - measured, experiments=3)
    place = np.array([1.4e5, 1100.0])
    sides = model(place + np.array([[1.4, 0.0], [-1.4, 0.0], [0.0, 0.011], [0.0, -0.011]]))
    differences = np.stack([(sides[0] - sides[1]) / 2.8, (sides[2] - sides[3]) / 0.022], axis=1)
    np.testing.assert_allclose(model.jacobian(place), differences, rtol=1e-6, atol=1e-9 * np.abs(differences).max())
    by = np.arange(6.0)
    np.testing.assert_allclose(model.pull(place, by), by @ model.jacobian(place), rtol=1e-10)

    worlds = Worlds(sim, PARAMETERS, experiments=3)

    def residuals(values: np.ndarray) -> np.ndarray:
        solves.append(3)
        sim.reset()
        worlds.write(values)
        sim.control.cable_tension[...] = tension
        sim.solve_static(tolerance=1e-11)
        return worlds.gather(1e3 * sim.marker_x[:, tip, ::2]) - measured.numpy().reshape(1, -1)

    counts = {}
    for name, given, method in (
        ("differences", residuals, "least_squares"),
        ("exact", model, "least_squares"),
        ("descent", model, "gradient"),
    ):
        solves.clear()
        batch = worlds.candidates if name == "differences" else None
        found = fit(PARAMETERS, given, method=method, batch=batch, tolerance=1e-12, max_iterations=60)
        counts[name] = len(solves)
        assert found.converged
        for parameter, value in TRUE.items():
            assert found.values[parameter] == pytest.approx(value, rel=1e-5), name
    assert counts["exact"] < 0.4 * counts["differences"]


def test_descent_with_noise_bounds_and_held_out_measurements() -> None:
    """The optimum of both methods is the same, at a bound too, and held out measurements have no part in it."""
    rng = np.random.default_rng(0)
    measured = torch.tensor(2.0 * X.numpy() + 1.0 + 0.1 * rng.standard_normal(21))

    def line(values: torch.Tensor) -> torch.Tensor:
        return (values[:, :1] * X + values[:, 1:] - measured)[0][None]

    for high in (10.0, 1.8):
        parameters = [Parameter("slope", -10.0, high), Parameter("offset", -10.0, 10.0)]
        options = {"held_out": np.arange(15, 21), "noise": np.linspace(0.1, 0.2, 21), "tolerance": 1e-14}
        fits = [fit(parameters, Differentiable(line), method=m, **options) for m in ("least_squares", "gradient")]
        assert fits[0].values == pytest.approx(fits[1].values, rel=1e-5)
        assert fits[0].at_bound == fits[1].at_bound == (("slope",) if high == 1.8 else ())
        np.testing.assert_allclose(fits[0].covariance, fits[1].covariance, rtol=1e-4)
        assert fits[1].held_out_rmse > 0.0


def test_derivatives_are_taken_once_and_many_measurements_at_a_time() -> None:
    """A batched Jacobian is that of single backward passes; the search's last one serves for the intervals."""

    def curve(values: torch.Tensor) -> torch.Tensor:
        return values[:, :1] * torch.exp(values[:, 1:] * X) - 2.0 * torch.exp(-X)

    one, many = Differentiable(curve), Differentiable(curve, batched=True)
    place = np.array([1.5, -0.7])
    for model in (one, many):
        model(place[None])
    np.testing.assert_allclose(many.jacobian(place), one.jacobian(place), rtol=1e-14)
    places = []

    def told(values: np.ndarray) -> np.ndarray:
        places.append(values.tobytes())
        return many.jacobian(values)

    parameters = [Parameter("size", 0.1, 10.0), Parameter("rate", -5.0, 5.0)]
    assert fit(parameters, many, jacobian=told).values == pytest.approx({"size": 2.0, "rate": -1.0}, rel=1e-5)
    assert len(places) == len(set(places))


@pytest.mark.parametrize(("count", "method"), [(64, "least_squares"), (65, "gradient")])
def test_many_measurements_are_fitted_along_gradients(count: int, method: str) -> None:
    """Where no method is given, up to 64 of an experiment have a Jacobian, as a backward pass for each is not many."""
    x = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
    noise = torch.tensor(0.1 * np.random.default_rng(0).standard_normal(count))

    def line(values: torch.Tensor) -> torch.Tensor:
        return (values[:, :1] * x + values[:, 1:] - 2.0 * x - 1.0 - noise)[0][None]

    parameters = [Parameter("slope", -10.0, 10.0), Parameter("offset", -10.0, 10.0)]
    chosen = fit(parameters, Differentiable(line))
    told = {m: fit(parameters, Differentiable(line), method=m) for m in ("least_squares", "gradient")}
    assert [m for m, found in told.items() if found.values == chosen.values] == [method]


def test_few_parameters_take_few_gradients() -> None:
    """In the metric of differences at the start a fit of two parameters takes two or three candidates more."""
    asked, pulled = [], []

    class Counted(Differentiable):
        def pull(self, values: np.ndarray, by: np.ndarray) -> np.ndarray:
            pulled.append(values)
            return super().pull(values, by)

    def decay(values: torch.Tensor) -> torch.Tensor:
        asked.append(values)
        return values[:, 1:] * torch.exp(-values[:, :1] * X) - 2.0 * torch.exp(-5.9 * X) - noise

    noise = torch.tensor(0.05 * np.random.default_rng(0).standard_normal(len(X)))
    parameters = [Parameter("rate", 1.0, 10.0, start=5.5), Parameter("size", 0.5, 4.0, start=1.8)]
    found = fit(parameters, Counted(decay), method="gradient", tolerance=1e-3)
    asked_for, gradients = len(asked), len(pulled)
    best = fit(parameters, Differentiable(decay), method="least_squares", tolerance=1e-12)
    assert found.converged
    assert found.rmse == pytest.approx(best.rmse, rel=1e-3)
    assert found.values == pytest.approx(best.values, rel=1e-2)
    assert asked_for <= 7
    assert gradients <= 4


@pytest.mark.parametrize("method", ["least_squares", "gradient"])
def test_a_model_that_diverges_on_the_way(method: str) -> None:
    """A candidate that diverges is stepped back from; one that does at the start is refused."""
    asked = []

    def decay(values: torch.Tensor) -> torch.Tensor:
        asked.append(float(values.detach()[0, 0]))
        if len(asked) == 3 or asked[0] > 40.0:  # the first step from the start, as if it had been too large
            raise Diverged("too fast")
        return torch.exp(-values[:, :1] * X) - torch.exp(-5.9 * X)

    found = fit([Parameter("rate", 0.0, 100.0, start=0.5)], Differentiable(decay), method=method, tolerance=1e-13)
    assert found.values["rate"] == pytest.approx(5.9, rel=1e-4)
    assert found.failed == 1
    assert abs(asked[3] - 0.5) < abs(asked[2] - 0.5)
    asked.clear()
    with pytest.raises(Diverged, match="too fast"):
        fit([Parameter("rate", 0.0, 100.0, start=50.0)], Differentiable(decay), method=method)


def test_what_is_refused() -> None:
    with pytest.raises(ValueError, match="be Differentiable for method='gradient'"):
        fit([Parameter("rate", 0.0, 1.0)], lambda values: values - [[0.1, 0.2]], method="gradient")
    with pytest.raises(ValueError, match=r"return a tensor of shape \(2, ...\) that carries gradients"):
        Differentiable(lambda values: values[:1], experiments=2)(np.ones((1, 1)))
