"""A tapered silicone tentacle with two tendons: one modulus, and how the base stands, from eight settled poses.

Measurements: SoRoMoX (tud-phi/soromox, MIT), section Va. The model is a rod that hangs down, with the section of the
tentacle in every segment, and tendons through its sections at a constant depth of 4 mm below the surface. Two tendons
leave the base towards 30 and 150 degrees and end at 0.305 m; a drum turns the commanded torque into tension. Density
and Poisson's ratio are those of silicone. What is fitted: the modulus, three small rotations of the base in the frame
of the motion capture (which knows only the base's position), and where along the tentacle the first marker's stem is.

A pose is a world, and so is a candidate's: all poses of all columns of a Jacobian are one simulation. Worlds settle by
long damped steps from rest.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import softwarp as sw
from softwarp.identification import Differentiable, Fit, Parameter, Worlds, fit, leave_out, side_by_side
from softwarp.io.atomic import atomic_path

from . import tentacle_gradient
from .real import Outcome, Row, measured

Floats = NDArray[np.float64]

LENGTHS = (0.305, 0.055)  # m, of the two cones
RADII = (0.01541, 0.00642, 0.00480)  # m, at their ends
DIRECTIONS = np.radians([30.0, 150.0])  # of the tendons around the axis, from y towards x
OFFSET, SLOPE = 0.0114, -0.0295  # m and m/m, of a tendon from the axis: it follows the surface, 4 mm below
SEGMENTS = (24, 5)
MARKERS = (0.1291, 0.2195, 0.28, 0.36)  # m, arc length
STEMS = np.array([[0.025, 0, 0], [-0.021, 0, 0], [0.020, 0, 0], [0, 0, 0.008]])  # m, in the section's axes
DENSITY, NU = 1080.0, 0.49  # kg/m^3; silicones have 1070 to 1100
DT, STEPS, DAMPING = 0.05, 100, 4.0  # s, and 1/s: after 5 s the tip moves by less than 0.1 mm
SAMPLES = 64
EXACT_TOLERANCE = 1.0e-5  # of the fit with exact derivatives: float32 rounds the sum of squares by as much
BAR = "mean error of the published identified rod model over all its poses"

YOUNGS = Parameter("youngs", 1e5, 1e6, scale="log", unit="Pa", target="rod_youngs", item=0)
PARAMETERS = [
    YOUNGS,
    Parameter("roll", -0.15, 0.15, unit="rad"),
    Parameter("pitch", -0.15, 0.15, unit="rad"),
    Parameter("yaw", -0.15, 0.15, unit="rad"),
    Parameter("marker 1", -0.02, 0.02, unit="m"),
]


class Tentacle:
    """The tentacle in as many worlds as candidates times poses.

    Args:
        tension: Of both tendons in every pose [N], shape (pose, 2).
        parameters: ``YOUNGS`` or all of ``PARAMETERS``.
        candidates: Parameter sets that are settled together.
        segments: Of both cones.
        device: Where they are settled.
    """

    def __init__(
        self,
        tension: Floats,
        parameters: Sequence[Parameter] = tuple(PARAMETERS),
        *,
        candidates: int = 1,
        segments: tuple[int, int] = SEGMENTS,
        device: str = "cpu",
    ) -> None:
        s = np.concatenate([[0.0], *(_cone(cone, count) for cone, count in enumerate(segments))])
        middle = 0.5 * (s[1:] + s[:-1])
        ends = np.cumsum([0.0, *LENGTHS])
        points = s[:, None] * (0.0, 0.0, -1.0)
        builder = sw.ModelBuilder()
        rod = builder.add_rod(
            points,
            radius=np.interp(middle, ends, RADII),
            youngs=4e5,
            nu=NU,
            density=DENSITY,
            normal=(1, 0, 0),
            rayleigh=(DAMPING, 0.0),
        )
        builder.fix(rod, nodes=[0])
        routed = s <= LENGTHS[0] + 1e-9
        for angle in DIRECTIONS:
            outward = (np.sin(angle), np.cos(angle), 0.0)
            path = points[routed] + np.outer(OFFSET + SLOPE * s[routed], outward)
            builder.add_cable(rod, path, control="force")
        self.arc = s
        self.sim = sw.Simulation(builder.finalize(candidates * len(tension), device), dt=DT)
        self.worlds = Worlds(self.sim, parameters, experiments=len(tension))
        self.tension = torch.from_numpy(self.worlds.commands(tension)).to(device)

    def column(self, values: Floats, name: str) -> Floats:
        """A parameter in every world, zero where it is not fitted."""
        if name in self.worlds.space.names:
            return self.worlds.column(values, name)
        return np.zeros(self.sim.num_worlds)

    def markers(self, values: Floats) -> Floats:
        """Settled markers in the frame of the motion capture.

        Args:
            values: Shape (candidate, parameter).

        Returns:
            Positions [mm], shape (candidate, pose * marker * 3); nan where the simulation failed.
        """
        base = Rotation.from_euler("xyz", np.stack([self.column(values, n) for n in ("roll", "pitch", "yaw")], axis=1))
        self.sim.reset()
        self.worlds.write(values)
        self.sim.params.gravity[...] = torch.from_numpy(base.inv().apply((0.0, 0.0, -9.81)))
        self.sim.control.cable_tension[...] = self.tension
        self.sim.step(STEPS)
        x, q = (np.asarray(view.cpu().numpy(), dtype=np.float64) for view in (self.sim.rod_x, self.sim.rod_q))
        found = [self.at(place, x, q) for place in MARKERS]
        for k, (place, frame) in enumerate(found):
            stem = np.repeat(STEMS[k][None], len(place), axis=0)
            stem[:, 2] += self.column(values, f"marker {k + 1}")
            found[k] = (base.apply(place + frame.apply(stem)), frame)
        return self.worlds.gather(1e3 * np.stack([place for place, _ in found], axis=1))

    def at(self, place: float, x: Floats, q: Floats) -> tuple[Floats, Rotation]:
        """Centre line and frame at an arc length [m]: a cubic through the ends of a segment with their tangents.

        Args:
            place: Arc length at rest [m].
            x: Nodes [m], shape (world, node, 3).
            q: Their frames, (x, y, z, w), shape (world, node, 4).
        """
        i, t = self.between(place)
        first, last = Rotation.from_quat(q[:, i - 1]), Rotation.from_quat(q[:, i])
        length = np.linalg.norm(x[:, i] - x[:, i - 1], axis=1, keepdims=True)
        tangents = [length * frame.as_matrix()[:, :, 2] for frame in (first, last)]
        weights = self.cubic(t)
        points = (x[:, i - 1], tangents[0], x[:, i], tangents[1])
        line = sum(weight * point for weight, point in zip(weights, points, strict=True))
        return np.asarray(line), first * Rotation.from_rotvec(t * (first.inv() * last).as_rotvec())

    def between(self, place: float) -> tuple[int, float]:
        """The node behind an arc length [m] at rest, and the part of the segment before it."""
        i = int(np.clip(np.searchsorted(self.arc, place), 1, len(self.arc) - 1))
        return i, float((place - self.arc[i - 1]) / (self.arc[i] - self.arc[i - 1]))

    @staticmethod
    def cubic(t: float) -> tuple[float, float, float, float]:
        """Weights of the ends of a segment and their tangents: first place, first tangent, last place, last tangent."""
        return (2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t, 3 * t**2 - 2 * t**3, t**3 - t**2)


def _cone(cone: int, count: int) -> Floats:
    """Nodes along a cone after its first, arc length [m]."""
    begin = sum(LENGTHS[:cone])
    return np.linspace(begin, begin + LENGTHS[cone], count + 1)[1:]


class Case:
    """The measured poses and the fit to those with one tendon.

    Args:
        extra: File with further poses, see ``real.measured``.
    """

    def __init__(self, extra: Path | None = None) -> None:
        self.data = measured("tentacle", extra)
        poses = self.data["poses"]
        self.names = list(poses)
        self.fitted = [self.names.index(name) for name in self.data["fitted"]]
        self.tension = np.array([poses[name]["torque"] for name in self.names]) / self.data["drum_radius"]
        self.markers = np.array([poses[name]["markers"] for name in self.names])  # mm, (pose, marker, 3)

    def fit(
        self, parameters: Sequence[Parameter], *, devices: Sequence[str] = ("cpu",), **options: Any
    ) -> tuple[Fit, Tentacle]:
        """Fit to the single-tendon poses; the error of all others is told as held out.

        Args:
            parameters: What is fitted.
            devices: That share the candidates.
            **options: Further ones of ``fit``.
        """
        held_out = np.setdiff1d(np.arange(self.markers.size), self.measurements(self.fitted))
        if options.get("method") == "gradient":
            if tuple(devices) != ("cpu",):
                raise ValueError("devices: --method gradient has one candidate at a time; leave --devices out")
            return self._fit_exactly(parameters, **{**options, "method": "least_squares"})
        candidates = 2 * len(parameters) + 1
        shares = [len(part) for part in np.array_split(np.arange(candidates), len(devices))]
        if 0 in shares:
            raise ValueError(f"devices: {len(devices)} for {candidates} candidates; give each a candidate at least")
        models = [
            Tentacle(self.tension, parameters, candidates=share, device=device)
            for share, device in zip(shares, devices, strict=True)
        ]
        target = self.markers.reshape(1, -1)

        def residuals(model: Tentacle) -> Callable[[Floats], Floats]:
            return lambda values: model.markers(values) - target

        together, batch = side_by_side([(residuals(model), model.worlds.candidates) for model in models])
        return fit(
            parameters,
            together,
            batch=batch,
            held_out=held_out,
            **{"samples": SAMPLES, **options},
        ), models[0]

    def _fit_exactly(self, parameters: Sequence[Parameter], **options: Any) -> tuple[Fit, Tentacle]:
        """The same with exact derivatives: of the fitted poses alone, whose equilibria follow from those before."""
        options.setdefault("tolerance", EXACT_TOLERANCE)
        others = np.setdiff1d(np.arange(len(self.names)), self.fitted)
        model, beside = Tentacle(self.tension[self.fitted], parameters), Tentacle(self.tension[others], parameters)
        unseen = self.markers[others].reshape(1, -1)
        found = fit(
            parameters,
            self.differentiable(model),
            held_out=lambda values: beside.markers(values) - unseen,
            **options,
        )
        return found, model

    def differentiable(self, model: Tentacle) -> Differentiable:
        """Residuals of the fitted poses with gradients, of a tentacle with a single candidate."""
        markers = tentacle_gradient.Markers(model, MARKERS, STEMS)
        return tentacle_gradient.residuals(markers, self.markers[self.fitted])

    def measurements(self, poses: Sequence[int]) -> NDArray[np.int64]:
        """Indices of the measurements of some poses."""
        return np.concatenate([np.arange(12 * pose, 12 * pose + 12) for pose in poses])

    def left_out(self, parameters: Sequence[Parameter], start: dict[str, float]) -> float:
        """RMS error [mm per coordinate] of each of the eight poses, predicted by a fit to the other seven."""
        model = Tentacle(self.tension[self.fitted], parameters, candidates=2 * len(parameters) + 1)
        target = self.markers[self.fitted].reshape(1, -1)
        return leave_out(
            parameters,
            lambda values: model.markers(values) - target,
            [self.measurements([pose]) for pose in range(len(self.fitted))],
            batch=model.worlds.candidates,
            start=start,
        ).total

    def errors(self, found: Fit) -> Floats:
        """Distances between predicted and measured markers [mm], shape (pose, marker)."""
        return np.asarray(np.linalg.norm(found.residuals.reshape(-1, 4, 3), axis=2))


def identify(extra: Path | None = None, **options: Any) -> Fit:
    """Fit modulus, rotations of the base and place of the first marker."""
    return Case(extra).fit(PARAMETERS, **options)[0]


def run(extra: Path | None = None) -> Outcome:
    """Fit with one parameter and with all, and compare all poses with the published model."""
    begun = time.monotonic()
    case = Case(extra)
    alone, _ = case.fit([YOUNGS])
    found, model = case.fit(PARAMETERS, start=alone.values, samples=0)
    seconds = time.monotonic() - begun
    errors, of_alone = case.errors(found), case.errors(alone)
    others = np.setdiff1d(np.arange(len(case.names)), case.fitted)
    rows = []
    for what, values, bar in (("modulus alone", of_alone, True), ("all parameters", errors, True)):
        for k, published in enumerate(case.data["published_mean"]):
            limit = published if bar else None
            rows.append(
                Row(f"marker {k + 1}, {what}, mean error", "mm", float(values[:, k].mean()), None, published, limit)
            )
    for k, published in enumerate(case.data["published_fit_rmse"]):
        rms = float(np.sqrt((errors[case.fitted, k] ** 2).mean()))
        rows.append(Row(f"marker {k + 1}, RMS over the fitted poses", "mm", rms, None, published))
    for k in range(4):
        rows.append(Row(f"marker {k + 1}, mean over poses that were not fitted", "mm", float(errors[others, k].mean())))
    left = {len(p): case.left_out(p, f.values) for p, f in (([YOUNGS], alone), (PARAMETERS, found))}
    return Outcome(
        title="Tendon-driven tentacle",
        source=case.data["source"],
        rows=rows,
        fit=found,
        seconds=seconds,
        more=pose_table(case, found),
        notes=(
            f"With the modulus alone: {alone.values['youngs'] / 1e3:.0f} kPa. Leaving out one of the eight poses at a "
            f"time, its coordinates are predicted to {left[1]:.1f} mm RMS by the modulus alone and to "
            f"{left[len(PARAMETERS)]:.1f} mm by all parameters.",
            f"Fitted: {len(PARAMETERS)} parameters to {12 * len(case.fitted)} coordinates. Given: density "
            f"{DENSITY:.0f} kg/m³, Poisson's ratio {NU}, radii, lengths and routing.",
        ),
        draw=lambda path: draw(case, found, model, path),
        details={
            "youngs_alone": alone.as_dict(),
            "left_out_rms": left,
            "errors": dict(zip(case.names, errors.round(2).tolist(), strict=True)),
        },
    )


def pose_table(case: Case, found: Fit) -> str:
    """Tips and errors of all markers, pose by pose, as Markdown."""
    lines = ["| pose | | tip, measured [mm] | tip, softwarp [mm] | errors of markers 1 to 4 [mm] |", "|" + "---|" * 5]
    predicted = found.residuals.reshape(case.markers.shape) + case.markers
    for i, (name, row) in enumerate(zip(case.names, case.errors(found), strict=True)):
        tips = (" ".join(f"{value:.0f}" for value in tip) for tip in (case.markers[i, 3], predicted[i, 3]))
        kind = "fitted" if i in case.fitted else "predicted"
        lines.append(f"| {name} | {kind} | {' | '.join(tips)} | {' '.join(f'{value:.1f}' for value in row)} |")
    return "\n".join(lines)


def draw(case: Case, found: Fit, model: Tentacle, path: Path) -> None:
    """Settled centre lines and markers beside the measured markers, seen from in front and from the side."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    values = np.tile(list(found.values.values()), (model.worlds.candidates, 1))
    ours = model.markers(values)[0].reshape(-1, 4, 3)
    base = Rotation.from_euler("xyz", [found.values[name] for name in ("roll", "pitch", "yaw")])
    lines = 1e3 * base.apply(model.sim.rod_x[: len(case.names)].cpu().numpy().reshape(-1, 3)).reshape(
        len(case.names), -1, 3
    )
    both = [i for i, name in enumerate(case.names) if i not in case.fitted]
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, poses, across, title in zip(
        figure.subplots(1, 3, sharey=True),
        (case.fitted[:4] + case.fitted[4:], both, both),
        (1, 1, 0),
        ("fitted, from in front", "predicted, from in front", "predicted, from the side"),
        strict=True,
    ):
        for i, pose in enumerate(poses):
            colour = f"C{i % 10}"
            axes.plot(lines[pose, :, across], lines[pose, :, 2], color=colour, label=case.names[pose])
            axes.plot(*ours[pose][:, [across, 2]].T, "+", color=colour, markersize=5)
            axes.plot(*case.markers[pose][:, [across, 2]].T, "o", color=colour, markersize=5, fillstyle="none")
        axes.set(xlabel=f"{'xy'[across]} [mm]", title=title, aspect="equal", xlim=(-185, 205), ylim=(-480, 15))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7, loc="lower center", ncols=2)
    figure.axes[0].set_ylabel("z [mm]")
    figure.suptitle("tentacle: circles measured, crosses and lines softwarp", fontsize="medium")
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=100)
