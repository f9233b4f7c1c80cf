"""A clamped beam of Dragon Skin 10, without and with a mass on its end: how far it sags, how it rings down.

Measurements: Dubied et al. (RA-L 2022), repository srl-ethz/diffPD_sim2real (MIT). Markers stand on stems beside the
end of the beam. With the mass, the marker on one side hangs 1.5 mm lower than the one on the other, so the mass hangs
beside the middle; how far is fitted. Besides there is one modulus and one Maxwell branch for all loads.

Quadratic tetrahedra, stable neo-Hookean, steps of 10 ms of second order. The ring-down starts
above, at rest, in equilibrium with a force on the end that is then taken away, so high that the first lower peak is
the measured one; the release of the real beam by hand is not known. Every candidate has two
worlds, one for each load. Relaxation is one Maxwell branch: at rest a beam of 250 kPa, which measured frequencies say
is stiffer in motion.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import softwarp as sw
from softwarp import meshing
from softwarp.identification import Differentiable, Fit, Parameter, fit
from softwarp.io.atomic import atomic_path

from . import beam_gradient
from .real import Outcome, Row, measured

Floats = NDArray[np.float64]

LENGTH, SIDE = 0.100, 0.030  # m
DENSITY, NU = 1070.0, 0.49  # kg/m^3
CELLS = (8, 2, 2)
GRAVITY = 9.807  # m/s^2
DT = 0.01  # s
NOTHING = 1.0e-6  # kg, of the mass where there is none
RADIUS_OF_GYRATION = 0.01  # m, of the mass
CANDIDATES = 5
PULL = 0.2  # N, on the end, of the shape that rings
HIGHER = 1.2  # than the first lower peak is deep, the motion starts
PERIODS = 5.9  # to look at
SLOWEST = 4.1  # Hz
STATIC_BAR, FREQUENCY_BAR, PEAK_BAR = {"none": 0.2}, 0.02, 0.05  # mm (others 0.4); parts of the figure
MARKER = 1  # the one that bars are for

PARAMETERS = [
    Parameter("youngs", 2.0e5, 3.5e5, scale="log", unit="Pa", start=2.5e5, step=0.02),
    Parameter("offset", -0.012, 0.012, unit="m", start=-0.005, step=0.05),
    Parameter("ratio", 0.05, 0.6, start=0.22, step=0.03),
    Parameter("time", 0.004, 0.04, scale="log", unit="s", start=0.022, step=0.03),
]


class Beam:
    """The beam in two worlds per candidate.

    Args:
        loads: Masses on the end [kg], one per world of a candidate.
        candidates: Parameter sets that are simulated together.
        cells: Of the mesh.
    """

    def __init__(self, loads: Floats, candidates: int = CANDIDATES, cells: tuple[int, int, int] = CELLS) -> None:
        self.mesh = meshing.elevate(meshing.box((LENGTH, SIDE, SIDE), cells))
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
        body = builder.add_tets(
            self.mesh, material=sw.StableNeoHookean(2.6e5, NU), density=DENSITY, relaxation=(0.3, 0.014)
        )
        builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0e-6, 1.0, 1.0)))
        end = np.flatnonzero(self.mesh.nodes[:, 0] > LENGTH - 1.0e-6)
        inertia = np.full(3, NOTHING * RADIUS_OF_GYRATION**2)
        plate = builder.add_rigid(mass=NOTHING, inertia=inertia, pose=(LENGTH, 0.5 * SIDE, 0.5 * SIDE), name="mass")
        builder.attach(body, nodes=end, to=plate)
        self.loads, self.candidates = np.maximum(loads, NOTHING), candidates
        self.model = builder.finalize(num_worlds=candidates * len(loads))
        self.sim = sw.Simulation(self.model, DT, integrator="bdf2")
        self.mass = np.tile(self.loads, candidates)
        self.sim.params.body_mass[:, 0] = self.sim.params.body_mass.new_tensor(self.mass)

    def write(self, values: Floats) -> None:
        """Parameters (candidate, parameter) into the worlds; all worlds back to the start."""
        sim = self.sim
        sim.reset()
        youngs, offset, ratio, duration = (np.repeat(column, len(self.loads)) for column in values.T)
        for view, column in (
            (sim.params.youngs, youngs),
            (sim.params.relaxation_ratio, ratio),
            (sim.params.relaxation_time, duration),
        ):
            view[:, 0] = view.new_tensor(column)
        self.torque = -offset * self.mass * GRAVITY
        self.pull(np.zeros(len(self.mass)))

    def pull(self, force: Floats) -> None:
        """Forces on the end, upwards [N], shape (world,), besides the moment of the mass that hangs beside it."""
        wrench = self.sim.control.body_force
        wrench.zero_()
        wrench[:, 0, 2] = wrench.new_tensor(force)
        wrench[:, 0, 3] = wrench.new_tensor(self.torque)

    def markers(self, places: Floats) -> Floats:
        """How far markers are below their places on the straight beam [mm], shape (world, marker)."""
        pose = self.sim.frame_pose[:, 0].numpy()
        x, y, z, w = pose[:, 3:].T
        turned = np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1)
        return np.asarray(1.0e3 * (pose[:, 2:3] - 0.5 * SIDE + turned @ places.T - places[:, 2]))

    def settle(self) -> None:
        """Equilibrium."""
        self.sim.solve_static()

    def ring(self, values: Floats, places: Floats, peaks: Floats, which: int) -> tuple[Floats, Floats]:
        """Positions at rest, and the marker ``which`` from its first lower peak on.

        Args:
            values: Parameters, (candidate, parameter).
            places: Of markers, from the middle of the end [m], (marker, 3).
            peaks: First lower peaks from rest, one per load, negative [mm].
            which: Marker.

        Returns:
            Markers at rest [mm], (world, marker); positions of the marker from rest [mm], (time, world).
        """
        self.write(values)
        self.settle()
        rest = self.markers(places)
        sim, views = self.sim, (self.sim.node_x, self.sim.frame_pose)
        still = [view.clone() for view in views]
        self.pull(np.full(len(self.mass), PULL))
        self.settle()
        share = -HIGHER * np.tile(peaks, self.candidates) / (self.markers(places) - rest)[:, which]
        for view, start in zip(views, still, strict=True):  # deflections of some millimetres are nearly proportional
            view.copy_(start + view.new_tensor(share)[:, None, None] * (view - start))
        quaternion = sim.frame_pose[..., 3:]
        quaternion /= quaternion.norm(dim=-1, keepdim=True)
        sim.node_v.zero_()
        sim.frame_twist.zero_()  # memories are 0 after a static solve
        sim.refresh()
        self.pull(np.zeros(len(self.mass)))
        steps = round(PERIODS / SLOWEST / DT)
        found = [self.markers(places)[:, which] - rest[:, which]]
        for _ in range(steps):
            self.sim.step()
            found.append(self.markers(places)[:, which] - rest[:, which])
        return rest, np.array(found)


def lower_peaks(positions: Floats) -> tuple[Floats, Floats]:
    """Times [s] and heights of the minima of a motion, by parabolas through three samples."""
    inner = positions[1:-1]
    at = np.flatnonzero((inner <= positions[:-2]) & (inner < positions[2:])) + 1
    below, here, above = positions[at - 1], positions[at], positions[at + 1]
    shift = 0.5 * (below - above) / (below - 2.0 * here + above)
    return (at + shift) * DT, here - 0.25 * (below - above) * shift


class Case:
    """The measured loads and the fit to those that are named for it.

    Args:
        extra: File with further loads, see ``real.measured``.
    """

    def __init__(self, extra: Path | None = None) -> None:
        self.data = measured("beam", extra)
        self.loads: dict[str, Any] = self.data["loads"]
        self.fitted = [name for name in self.loads if name in self.data["fitted"]]
        self.places = 1.0e-3 * np.array(list(self.data["markers"].values()))

    def beam(self, names: list[str], candidates: int) -> Beam:
        """The beam with some of the loads."""
        return Beam(np.array([self.loads[name]["mass"] for name in names]), candidates)

    def simulate(self, beam: Beam, names: list[str], values: Floats) -> list[list[dict[str, Any]]]:
        """What every candidate does under every load: markers at rest, positions, frequency, lower peaks."""
        first = np.array([self.loads[name]["peaks"][0] for name in names])
        rest, moving = beam.ring(values, self.places, first, MARKER)
        found = []
        for world in range(len(rest)):
            times, heights = lower_peaks(moving[:, world])
            count = min(len(self.loads[names[world % len(names)]]["peaks"]), len(times))
            frequency = (count - 1) / (times[count - 1] - times[0]) if count > 1 else np.nan
            scale = first[world % len(names)] / heights[0] if count else np.nan  # the motion is small
            found.append(
                {"rest": rest[world], "motion": scale * moving[:, world], "frequency": frequency}
                | {"peaks": scale * heights[:count], "start": times[0] if count else 0.0}
            )
        return [found[start : start + len(names)] for start in range(0, len(found), len(names))]

    def fit(self, **options: Any) -> Fit:
        """Fit the parameters to places at rest, frequencies and successive peaks of all loads at once."""
        options = {"tolerance": 1e-2, "max_iterations": 6, **options}
        if options.get("method") == "gradient":
            return fit(PARAMETERS, self.differentiable(), **{**options, "max_iterations": 30})
        beam = self.beam(self.fitted, CANDIDATES)

        def residuals(values: Floats) -> Floats:
            return np.array([self._residuals(loads) for loads in self.simulate(beam, self.fitted, values)])

        return fit(PARAMETERS, residuals, batch=CANDIDATES, **options)

    def differentiable(self) -> Differentiable:
        """Residuals of all loads that torch differentiates, of one candidate at a time."""
        steps = round(PERIODS / SLOWEST / DT)
        first = np.array([self.loads[name]["peaks"][0] for name in self.fitted])
        limits = {"side": SIDE, "gravity": GRAVITY, "pull": PULL, "higher": HIGHER}
        counts = [len(self.loads[name]["peaks"]) for name in self.fitted]
        ring = beam_gradient.Ring(self.beam(self.fitted, 1), self.places, first, MARKER, counts, steps, limits)
        return beam_gradient.residuals(ring, self._differences)

    def _differences(self, number: int, found: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """What ``_residuals`` has of one load, as torch differentiates it; nan for peaks that are missing."""
        rest, motion = found
        told = self.loads[self.fitted[number]]
        heights, known = (torch.as_tensor(values).to(rest) for values in (list(told["static"].values()), told["peaks"]))
        times, peaks = beam_gradient.lower_peaks(motion, DT)
        times, peaks = (
            torch.nn.functional.pad(v[: len(known)], (0, max(len(known) - len(v), 0)), value=torch.nan)
            for v in (times, peaks)
        )
        frequency = (len(known) - 1) / (times[-1] - times[0])
        peaks = known[0] / peaks[0] * peaks
        errors = torch.cat(
            [
                (rest - heights) / STATIC_BAR.get(self.fitted[number], 0.4),
                ((frequency / told["frequency"] - 1.0) / FREQUENCY_BAR)[None],
                ((peaks - known) / (PEAK_BAR * known))[1:],
            ]
        )
        return errors * errors.abs()

    def _residuals(self, loads: list[dict[str, Any]]) -> Floats:
        """Squares of differences in units of what they may be, with their signs.

        What is asked for are largest errors, so the fit heeds large ones more than a sum of squares would.
        """
        parts: list[Floats] = []
        for name, found in zip(self.fitted, loads, strict=True):
            told = self.loads[name]
            heights = np.array(list(told["static"].values()))
            parts.append((found["rest"] - heights) / STATIC_BAR.get(name, 0.4))
            parts.append(np.array([(found["frequency"] / told["frequency"] - 1.0) / FREQUENCY_BAR]))
            peaks, known = np.full(len(told["peaks"]), np.nan), np.array(told["peaks"])
            peaks[: len(found["peaks"])] = found["peaks"]
            parts.append(((peaks - known) / (PEAK_BAR * known))[1:])
        errors = np.concatenate(parts)
        return errors * np.abs(errors)


def identify(extra: Path | None = None, **options: Any) -> Fit:
    """Fit modulus, place of the mass and relaxation."""
    return Case(extra).fit(**options)


def run(extra: Path | None = None) -> Outcome:
    """Fit to two loads, and tell what all loads do."""
    begun = time.monotonic()
    case = Case(extra)
    found = case.fit()
    names = list(case.loads)
    values = np.array([list(found.values.values())])
    results = dict(zip(names, case.simulate(case.beam(names, 1), names, values)[0], strict=True))
    rows = []
    for name, result in results.items():
        told, note = case.loads[name], "fitted" if name in case.fitted else "predicted"
        for number, (marker, height) in enumerate(told["static"].items()):
            bar = STATIC_BAR.get(name, 0.4) if number == MARKER else None
            published = told.get("published_static") if number == MARKER else None
            here = float(result["rest"][number])
            rows.append(Row(f"{name}: marker {marker} at rest", "mm", here, height, published, bar, note))
        frequency = told["frequency"]
        rows.append(
            Row(f"{name}: frequency", "Hz", result["frequency"], frequency, None, FREQUENCY_BAR * frequency, note)
        )
        for number, (here, there) in enumerate(zip(result["peaks"], told["peaks"], strict=False)):
            if number:
                bar = PEAK_BAR * abs(there)
                rows.append(Row(f"{name}: lower peak {number + 1}", "mm", float(here), there, None, bar, note))
    return Outcome(
        title="Loaded beam",
        source=case.data["source"],
        rows=rows,
        fit=found,
        seconds=time.monotonic() - begun,
        notes=(
            "One modulus, one place of the mass and one Maxwell branch for all loads. The published figures "
            "are those of a commercial finite-element program with a modulus fitted to all loads (263.8 kPa).",
        ),
        draw=lambda path: draw(case, results, path),
        details={name: {"motion": result["motion"].tolist()} for name, result in results.items()},
    )


def draw(case: Case, results: dict[str, Any], path: Path) -> None:
    """The ring-down of every load with the measured lower peaks."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, result) in zip(figure.subplots(1, len(results)), results.items(), strict=True):
        told, motion = case.loads[name], result["motion"]
        peaks, times = np.array(told["peaks"]), DT * np.arange(len(motion))
        last = (len(peaks) - 0.5) / told["frequency"]
        times = times - result["start"]
        axes.plot(times[times < last], motion[times < last], label="softwarp, steps of 10 ms")
        axes.plot(np.arange(len(peaks)) / told["frequency"], peaks, "o", label="measured lower peaks")
        axes.set(xlabel="time [s]", ylabel="marker 2, from rest [mm]", title=f"load: {name}")
        axes.grid(alpha=0.3)
        axes.legend()
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=100)
