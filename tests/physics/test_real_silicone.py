"""Simulations beside measured silicone: figures, sources and licences are in experiments/measured_silicone.json."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from experiments import real, real_beam, real_segment, real_tentacle, segment_gradient, tentacle_gradient, validate
from softwarp import cli


def test_measurements_have_sources():
    """Every case names where its figures come from and under which licence."""
    cases = json.loads(real.MEASURED.read_text())
    assert set(cases) >= {"tentacle", "segment"}
    assert all(case["source"] and "MIT" in case["licence"] for case in cases.values())


def test_further_measurements_are_added(tmp_path):
    extra = tmp_path / "more.json"
    extra.write_text(json.dumps({"segment": {"displacement": {"275": 12.5}}}))
    assert real.measured("segment", extra)["displacement"].keys() >= {"100", "275"}
    extra.write_text("[")
    with pytest.raises(ValueError, match=r"more\.json: must be JSON of the form of measured_silicone\.json"):
        real.measured("segment", extra)
    with pytest.raises(ValueError, match="no measurements of 'tentacl'; did you mean 'tentacle'"):
        real.measured("tentacl")


def test_tentacle_without_load_hangs_straight():
    """Without tension and at a right base it hangs along z, stretched by its weight: rho g L^2 / 2 E of a cylinder.

    A cone that gets thinner carries less below: with radii r0 > r1 it stretches by less than that, and by more than a
    third.
    """
    model = real_tentacle.Tentacle(np.zeros((1, 2)), [real_tentacle.YOUNGS])
    tip = model.markers(np.array([[4e5]])).reshape(4, 3)[3]
    stretch = -tip[2] - 368.0
    bound = 1e3 * real_tentacle.DENSITY * 9.81 * 0.36**2 / (2 * 4e5)
    np.testing.assert_allclose(tip[:2], 0.0, atol=1e-3)
    assert bound / 3 < stretch < bound


def test_tentacle_turns_with_its_base():
    """Yaw turns every marker about z, as gravity has no part in it; the first marker's place moves it along."""
    tension = np.array([[4.0, 1.0]])
    model = real_tentacle.Tentacle(tension, candidates=3)
    values = np.array([[4e5, 0, 0, 0, 0], [4e5, 0, 0, 0.1, 0], [4e5, 0, 0, 0, 0.005]])
    straight, turned, moved = model.markers(values).reshape(3, 4, 3)
    turn = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    np.testing.assert_allclose(turned[:, :2], straight[:, :2] @ turn.T, atol=0.01)
    np.testing.assert_allclose(turned[:, 2], straight[:, 2], atol=0.01)
    assert np.linalg.norm(moved[0] - straight[0]) == pytest.approx(5.0, abs=1e-3)
    np.testing.assert_allclose(moved[1:], straight[1:], atol=1e-3)


def test_turns_of_the_differentiated_tentacle():
    """Products, parts and vectors of turns are SciPy's."""
    one, other = Rotation.random(4, random_state=1), Rotation.random(4, random_state=2)
    a, b = (torch.tensor(each.as_quat()) for each in (one, other))
    v = torch.tensor(np.random.default_rng(0).standard_normal((4, 3)))
    found = Rotation.from_quat(tentacle_gradient.product(a, b).numpy())
    assert (found * (one * other).inv()).magnitude().max() < 1e-12
    np.testing.assert_allclose(tentacle_gradient.turned(a, v), one.apply(v.numpy()), rtol=0, atol=1e-12)
    part = Rotation.from_quat(tentacle_gradient.power(torch.where(a[:, 3:] < 0, -a, a), 0.3).numpy())
    assert (part * Rotation.from_rotvec(0.3 * one.as_rotvec()).inv()).magnitude().max() < 1e-12
    angles = np.random.default_rng(3).uniform(-1.0, 1.0, (4, 3))
    base = Rotation.from_quat(tentacle_gradient.base_turn(*torch.tensor(angles).T).numpy())
    assert (base * Rotation.from_euler("xyz", angles).inv()).magnitude().max() < 1e-12


@pytest.mark.slow
def test_tentacle_by_gradient(monkeypatch):
    """Residuals at rest are those of worlds that settle for long, to rounding in float32; the same optimum to 1e-4."""
    case = real_tentacle.Case()
    values = np.array([[4.1e5, -0.03, 0.01, 0.02, 0.008]])
    tension, measured = case.tension[case.fitted], case.markers[case.fitted].ravel()
    found = case.differentiable(real_tentacle.Tentacle(tension))(values)[0]
    for steps, near in ((real_tentacle.STEPS, 0.1), (1000, 5e-3)):  # mm
        monkeypatch.setattr(real_tentacle, "STEPS", steps)
        settled = real_tentacle.Tentacle(tension).markers(values)[0] - measured
        np.testing.assert_allclose(found, settled, rtol=0, atol=near)
    monkeypatch.undo()
    found = [case.fit(real_tentacle.PARAMETERS, samples=0, method=m)[0] for m in ("gradient", "least_squares")]
    assert found[0].values["youngs"] == pytest.approx(found[1].values["youngs"], rel=1e-4)
    assert found[0].rmse == pytest.approx(found[1].rmse, rel=1e-5)


@pytest.mark.slow
def test_beam_by_gradient():
    """Residuals are those of worlds simulated without gradients; the optimum is an evolution's, RMS 0.8366."""
    case = real_beam.Case()
    values = np.array([[2.5e5, -0.005, 0.22, 0.022]])
    found = case.differentiable()(values)[0]
    plain = case.simulate(case.beam(case.fitted, 1), case.fitted, values)[0]
    np.testing.assert_allclose(found, case._residuals(plain), rtol=0, atol=0.05)  # of what measurements may be off
    fit = case.fit(method="gradient")
    assert fit.converged
    assert fit.values["youngs"] == pytest.approx(249.6e3, rel=1e-3)
    assert fit.values["ratio"] == pytest.approx(0.2241, abs=1e-3)
    assert fit.values["time"] == pytest.approx(22.4e-3, rel=0.01)
    assert fit.rmse < 1.005 * 0.8366


@pytest.mark.slow
def test_tentacle_by_its_modulus_alone():
    """Mean error of every marker over all poses given, below the published identified model: 11.9 10.8 12.0 28.4 mm."""
    case = real_tentacle.Case()
    found, _ = case.fit([real_tentacle.YOUNGS], samples=0)
    assert (case.errors(found).mean(axis=0) < [11.9, 10.8, 12.0, 28.4]).all()
    assert found.values["youngs"] == pytest.approx(4.07e5, rel=0.02)
    assert found.held_out_rmse < 1.25 * found.rmse


@pytest.mark.slow
def test_tentacle():
    """All figures are met with all parameters, in under 60 s of two cores, and what was not fitted is not worse."""
    outcome = real_tentacle.run()
    assert all(row.passed for row in outcome.rows)
    assert outcome.seconds < 60.0
    assert outcome.fit.held_out_rmse < 1.25 * outcome.fit.rmse
    assert not outcome.fit.at_bound


def test_segment_mesh():
    """Volume of the solid: the polygons of its outline minus the hole, and minus four chambers between the ends."""
    corners = real_segment.section()
    hole, inside, outside, skin = (area(level) for level in corners)
    chambers = 4 * area(np.concatenate([corners[1, : real_segment.CELLS + 1], corners[2, real_segment.CELLS :: -1]]))
    height = real_segment.LENGTH - real_segment.BOTTOM - real_segment.TOP
    assert real_segment.mesh().volume == pytest.approx((skin - hole) * real_segment.LENGTH - chambers * height)
    assert chambers < outside - inside
    np.testing.assert_allclose(np.linalg.norm(corners[3], axis=1), real_segment.RADIUS)


def area(polygon):
    """Area inside corners in counter-clockwise order; the absolute value for either order."""
    x, y = polygon.T
    return 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


@pytest.mark.slow
def test_segment():
    """Fitted to 100, 150 and 200 mbar; 11.0 mm at 250 and 14.7 at 300 mbar are predicted within 2 mm (Dubied 2022)."""
    outcome = real_segment.run()
    assert all(row.passed for row in outcome.rows)
    assert max(row.error for row in outcome.rows if row.note == "fitted") < 0.4
    assert not outcome.fit.at_bound


@pytest.mark.slow
def test_segment_by_gradient(monkeypatch):
    """At rest where long steps come to, to 0.001 mm; slopes are central differences to 1e-4."""
    pressures = np.array([1e4, 2e4])
    monkeypatch.setattr(segment_gradient, "TOLERANCE", 1e-9)  # differences want more than a fit
    single = real_segment.Segment(1, "float64")
    exact = segment_gradient.Displacements(real_segment.Segment(3, "float64"), single, pressures)
    values = torch.tensor([[4.35e5, 4.9e4]], dtype=torch.float64, requires_grad=True)
    found = exact(values)
    inflated = real_segment.Segment(1)
    for hold, near in ((real_segment.HOLD, 0.03), (40, 1e-3)):  # mm; those of a fit are not quite at rest
        monkeypatch.setattr(real_segment, "HOLD", hold)
        stepped = inflated.displacements(values.detach().numpy(), pressures)
        np.testing.assert_allclose(found.detach().numpy(), stepped, rtol=0, atol=near)
    slopes = [torch.autograd.grad(part, values, retain_graph=True)[0][0] for part in found[0]]
    for number, step in enumerate((4350.0, 490.0)):
        change = step * torch.eye(2, dtype=torch.float64)[number][None]
        sides = [exact(values.detach() + sign * change)[0] for sign in (1.0, -1.0, 2.0, -2.0)]
        expected = (8.0 * (sides[0] - sides[1]) - (sides[2] - sides[3])) / (12.0 * step)
        np.testing.assert_allclose([float(s[number]) for s in slopes], expected.detach().numpy(), rtol=1e-4)


def test_verbs_refuse_wrong_names(capsys):
    assert cli.main(["validate", "reel"]) == cli.BAD_INPUT
    assert "no kind 'reel'; did you mean 'real'" in capsys.readouterr().err
    assert cli.main(["validate", "real", "tentacl"]) == cli.BAD_INPUT
    assert "no case 'tentacl'; did you mean 'tentacle'" in capsys.readouterr().err
    assert cli.main(["identify", "segmnt"]) == cli.BAD_INPUT
    assert "no case 'segmnt'; did you mean 'segment'" in capsys.readouterr().err
    assert cli.main(["identify", "tentacle", "--samples", "-4"]) == cli.BAD_INPUT
    told = capsys.readouterr()
    assert "--samples must be an integer of at least 0, got -4" in told.err and "compil" not in told.err + told.out
    assert cli.main(["identify", "tentacle", "--seed", "-1"]) == cli.BAD_INPUT
    assert "--seed must be an integer" in capsys.readouterr().err


def test_page_and_json(tmp_path, monkeypatch, capsys):
    """Marks of a page are filled, a missed figure makes the exit code 1, JSON has no numbers that it does not know."""
    rows = [real.Row("sag", "mm", 2.0, 2.5, None, 1.0), real.Row("tip", "mm", 5.0, 2.5, 3.0, 1.0, "predicted")]
    outcome = real.Outcome(title="Beam", source="nobody", rows=rows, seconds=1.0, details={"x": float("nan")})
    monkeypatch.setattr(real_tentacle, "run", lambda extra: outcome)
    page = tmp_path / "page.md"
    page.write_text("# A\n<!-- tentacle: made by softwarp validate real -->\nold\n<!-- end tentacle -->\nend\n")
    out = tmp_path / "out.json"
    assert validate.main(["real", "tentacle", "--page", str(page), "--json", str(out)]) == 1
    assert "missed: tentacle: tip" in capsys.readouterr().err
    text = page.read_text()
    assert "| sag | 2.5 mm | 2 mm |  | 0.5 mm | 1 mm | met |" in text
    assert "| tip | 2.5 mm | 5 mm | 3 mm | 2.5 mm | 1 mm | missed predicted |" in text
    assert "old" not in text
    assert text.endswith("<!-- end tentacle -->\nend\n")
    told = json.loads(out.read_text())["tentacle"]
    assert told["x"] is None
    assert [row["passed"] for row in told["rows"]] == [True, False]
    page.write_text("nothing")
    with pytest.raises(ValueError, match="has no line"):
        validate.renew(page, {"tentacle": outcome})
