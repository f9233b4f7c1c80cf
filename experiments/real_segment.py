"""A pneumatic segment of Dragon Skin 10: two parameters from three pressures, two higher pressures predicted.

Measurements: Dubied et al. (RA-L 2022), repository srl-ethz/diffPD_sim2real (MIT). Its environment for the accurate
mesh tells the radius, both wall thicknesses, the square hole and the thickness of the bottom; the mesh itself is not
published in full. Assumed here: walls between the chambers as thick as those of the square, a top as thick as the
bottom, sharp corners, and fibres wound around the chamber that is inflated. Without fibres a wall of 2 mm would blow up
like a balloon at half of the pressures, and bend less below; the measured curve is nearly straight. How stiff the
winding is, is fitted together with the modulus.

The segment hangs from its top. Quadratic tetrahedra, one across each wall; the winding is a row of elastic cables that
run around the chamber through the nodes of its wall. Every candidate is a world whose pressure is raised step by step.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import softwarp as sw
from softwarp import meshing, notices
from softwarp.identification import Fit, Parameter, Worlds, fit
from softwarp.io.atomic import atomic_path
from softwarp.meshing.prisms import cut_prisms, split_quads

from . import segment_gradient
from .real import Outcome, Row, measured

Floats = NDArray[np.float64]

RADIUS, LENGTH, WALL = 0.0222, 0.100, 0.00203  # m
HOLE, INNER, BOTTOM = 0.01011, 0.00227, 0.00693  # m: half a diagonal of the square hole, its wall, the end
BETWEEN, TOP = INNER, BOTTOM  # m, assumed
DENSITY, NU = 1070.0, 0.49  # kg/m^3
CELLS, LAYERS = 3, 5  # of a chamber: around a quarter, and along the segment
DT, RAMP, HOLD, REST = 0.3, 5, 12, 12  # s, and steps: to a pressure, at it, and before the first
DAMPING = (0.0, 0.2)  # 1/s, s: worlds settle, nothing else depends on it
CANDIDATES = 5
YOUNGS_OF_BEAM = 263.8e3  # Pa, fitted by the source to a beam of the same silicone
NOISE = 0.1  # mm: the figures are rounded to that, and repeated runs of the source's beam differ by 0.06
BAR = 2.0  # mm

PARAMETERS = [
    Parameter("youngs", 1.5e5, 8e5, scale="log", unit="Pa", target="youngs", item=0, start=YOUNGS_OF_BEAM, step=0.02),
    Parameter("winding", 5e3, 1e6, scale="log", unit="N/m²", step=0.03),
]


def section() -> Floats:
    """Corners of the section's cells [m], (4 levels, 4 (CELLS + 1), 2): hole, chamber from inside to outside, skin.

    Circles are polygons of 16 corners. Around the axis the cells of a quarter's chamber alternate with one cell of
    wall, whose sides are parallel.
    """

    def square(half: float) -> Callable[[Floats], Floats]:
        return lambda angle: half / (np.abs(np.cos(angle)) + np.abs(np.sin(angle)))

    def circle(radius: float) -> Callable[[Floats], Floats]:
        return lambda angle: np.full_like(angle, radius)

    levels = []
    for outline in (square(HOLE), square(HOLE + INNER * np.sqrt(2.0)), circle(RADIUS - WALL), circle(RADIUS)):
        edge = np.array(0.1)
        for _ in range(50):  # r(edge) sin(edge) is half of the wall between two chambers
            edge = np.arcsin(0.5 * BETWEEN / outline(edge))
        quarter = np.linspace(float(edge), 0.5 * np.pi - float(edge), CELLS + 1)
        angle = np.concatenate([quarter + 0.5 * np.pi * k for k in range(4)])
        radius = np.tile(outline(quarter), 4)
        levels.append(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1))
    return np.stack(levels)


def mesh() -> meshing.QuadraticMesh:
    """The segment from its bottom at z = 0 to its top, with four closed chambers."""
    corners = section()
    around = corners.shape[1]
    flat = corners.reshape(-1, 2)
    places = np.arange(4 * around).reshape(4, around)
    z = np.concatenate([[0.0], np.linspace(BOTTOM, LENGTH - TOP, LAYERS + 1), [LENGTH]])
    nodes = np.concatenate([np.column_stack([flat, np.full(len(flat), height)]) for height in z])
    tets = []
    for layer in range(len(z) - 1):
        quads = []
        for level in range(3):
            for i in range(around):
                is_air = level == 1 and i % (CELLS + 1) != CELLS and 0 < layer < len(z) - 2
                j = (i + 1) % around
                if not is_air:
                    quads.append((places[level, i], places[level + 1, i], places[level + 1, j], places[level, j]))
        triangles = split_quads(quads, places.ravel())
        pair = np.arange(2 * len(flat)) + layer * len(flat)
        tets.append(cut_prisms(triangles, places.ravel(), pair))
    all_tets = np.concatenate(tets)
    nodes, compacted = meshing.compact(nodes, meshing.orient(nodes, all_tets))
    return meshing.elevate(nodes, compacted, name="segment")


class Segment:
    """The segment in as many worlds as candidates.

    Args:
        candidates: Parameter sets that are inflated together.
        precision: Of the model.
    """

    def __init__(self, candidates: int = CANDIDATES, precision: str = "float32") -> None:
        solid = mesh()
        builder = sw.ModelBuilder()
        body = builder.add_tets(
            solid, material=sw.NeoHookean(YOUNGS_OF_BEAM, NU), density=DENSITY, rayleigh=DAMPING, name="segment"
        )
        builder.fix(body, box=((-1, -1, LENGTH - 1e-6), (1, 1, 1)))
        linear = solid.linear()
        walls = [meshing.compact(linear.nodes, skin) for skin in meshing.voids(linear.nodes, linear.tets)]
        vertices, triangles = max(walls, key=lambda wall: float(wall[0].mean(axis=0)[:2].sum()))
        builder.add_cavity(body, vertices, triangles, min_pressure=0.0)
        heights = np.unique(vertices[:, 2].round(7))
        self.spacing = float(np.diff(heights).mean())
        for height in heights[1:-1]:
            builder.add_cable(body, loop(vertices[np.abs(vertices[:, 2] - height) < 1e-6]), stiffness=1e3)
        self.tip = np.flatnonzero(solid.nodes[:, 2] < 1e-6)
        self.solid = solid
        self.sim = sw.Simulation(
            builder.finalize(num_worlds=candidates, precision=precision),
            dt=DT,
            pressure_tangent=True,
            solver_path="scalar",
        )
        self.worlds = Worlds(self.sim, PARAMETERS)

    def write(self, values: Floats) -> None:
        """Parameters (candidate, parameter) into the worlds, which go back to the start without pressure."""
        self.sim.reset()
        self.worlds.write(values)
        per_loop = self.worlds.column(values, "winding") * self.spacing
        self.sim.params.cable_stiffness[...] = self.sim.params.cable_stiffness.new_tensor(per_loop)[:, None]
        self.sim.control.cavity_pressure.zero_()

    def displacements(self, values: Floats, pressures: Floats) -> Floats:
        """Distance that the centre of the bottom has moved from where it hangs without pressure.

        Args:
            values: Shape (candidate, parameter).
            pressures: Rising [Pa], shape (pressure,).

        Returns:
            Displacements [mm], shape (candidate, pressure); nan from where a world failed.
        """
        self.write(values)
        self.sim.step(REST)
        rest, before = self.place(), 0.0
        found = []
        for pressure in pressures:
            notices.progress("identification", f"{len(values)} candidates at {pressure / 100.0:.0f} mbar")
            for part in range(RAMP):
                self.sim.control.cavity_pressure.fill_(before + (pressure - before) * (part + 1) / RAMP)
                self.sim.step()
            self.sim.step(HOLD)
            before = pressure
            found.append(self.worlds.gather(1e3 * np.linalg.norm(self.place() - rest, axis=1)))
        return np.concatenate(found, axis=1)

    def place(self) -> Floats:
        """Centre of the bottom's nodes [m], shape (world, 3)."""
        return np.asarray(self.sim.node_x[:, self.tip].mean(dim=1).numpy(), dtype=np.float64)


def loop(points: Floats) -> Floats:
    """Points of a closed curve around a chamber, in order; the last is the first."""
    centre = 0.5 * (points[:, :2].min(axis=0) + points[:, :2].max(axis=0))
    order = np.argsort(np.arctan2(*(points[:, :2] - centre).T[::-1]))
    return np.asarray(points[np.append(order, order[0])])


class Case:
    """The measured displacements and the fit to the low pressures.

    Args:
        extra: File with further pressures, see ``real.measured``.
    """

    def __init__(self, extra: Path | None = None) -> None:
        self.data = measured("segment", extra)
        told = sorted((float(key), value) for key, value in self.data["displacement"].items())
        self.mbar = np.array([key for key, _ in told])
        self.displacement = np.array([value for _, value in told])  # mm
        self.fitted = np.isin(self.mbar, self.data["fitted"])

    def fit(self, **options: Any) -> tuple[Fit, Segment]:
        """Fit modulus and winding to the low pressures; the error at all others is told as held out."""
        last = int(np.flatnonzero(self.fitted).max()) + 1
        pressures, told = 100.0 * self.mbar[:last], self.displacement[:last]
        given = {"held_out": ~self.fitted[:last], "noise": NOISE, "tolerance": 1e-2, "max_iterations": 12, **options}
        if options.get("method") == "gradient":
            segments, model = (Segment(count, "float64") for count in (1 + last, 1))
            exact = segment_gradient.Displacements(segments, model, pressures)
            return fit(
                PARAMETERS, segment_gradient.residuals(exact, told), **{**given, "method": "least_squares"}
            ), model
        model = Segment()

        def residuals(values: Floats) -> Floats:
            return model.displacements(values, pressures) - told

        return fit(PARAMETERS, residuals, batch=CANDIDATES, **given), model


def identify(extra: Path | None = None, **options: Any) -> Fit:
    """Fit modulus and winding."""
    return Case(extra).fit(**options)[0]


def run(extra: Path | None = None) -> Outcome:
    """Fit to the low pressures, predict the others."""
    begun = time.monotonic()
    case = Case(extra)
    found, model = case.fit()
    values = np.tile(list(found.values.values()), (CANDIDATES, 1))
    ours = model.displacements(values, 100.0 * case.mbar)[0]
    rows = [
        Row(
            f"displacement at {mbar:.0f} mbar",
            "mm",
            float(here),
            float(there),
            None,
            None if is_fitted else BAR,
            "fitted" if is_fitted else "predicted",
        )
        for mbar, here, there, is_fitted in zip(case.mbar, ours, case.displacement, case.fitted, strict=True)
    ]
    return Outcome(
        title="Pneumatic segment",
        source=case.data["source"],
        rows=rows,
        fit=found,
        seconds=time.monotonic() - begun,
        notes=(
            "Dimensions of the published code: radius 22.2 mm, length 100 mm, outer wall 2.03 mm, wall of the square "
            "hole 2.27 mm, half its diagonal 10.11 mm, bottom 6.93 mm. Assumed: walls between chambers 2.27 mm, top "
            "6.93 mm, sharp corners, fibres around the inflated chamber, markers at the centre of the bottom.",
            f"The modulus of the beam is {YOUNGS_OF_BEAM / 1e3:.1f} kPa; what is found here beyond it stands for what "
            "the assumed shape lacks.",
        ),
        draw=lambda path: draw(case, found, ours, model, path),
    )


def draw(case: Case, found: Fit, ours: Floats, model: Segment, path: Path) -> None:
    """Displacement against pressure, the section, and the segment as it hangs at the highest pressure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    curve, cut, shape = figure.subplots(1, 3, width_ratios=(1.6, 1.0, 0.9))
    curve.plot([0, *case.mbar], [0, *ours], "-", label="softwarp")
    curve.plot(case.mbar[case.fitted], case.displacement[case.fitted], "o", label="measured, fitted")
    curve.plot(case.mbar[~case.fitted], case.displacement[~case.fitted], "s", label="measured, predicted")
    told = f"E = {found.values['youngs'] / 1e3:.0f} kPa, winding {found.values['winding'] / 1e3:.0f} kN/m²"
    curve.set(xlabel="pressure [mbar]", ylabel="displacement of the tip [mm]", title=told)
    curve.grid(alpha=0.3)
    curve.legend()
    faces = meshing.tet_surface(model.solid.linear().tets)
    now = 1e3 * model.sim.node_x[0].numpy()
    levels = 1e3 * section()
    cut.fill(*levels[3].T, color="C0", alpha=0.35)
    cut.fill(*levels[0].T, color="white")
    for quarter in range(4):
        span = slice(quarter * (CELLS + 1), (quarter + 1) * (CELLS + 1))
        air = np.concatenate([levels[1, span], levels[2, span][::-1]])
        cut.fill(*air.T, color="C1" if quarter == 0 else "white", alpha=0.6 if quarter == 0 else 1.0)
    cut.set(xlabel="x [mm]", ylabel="y [mm]", title="section; orange: inflated", aspect="equal")
    across = now[:, :2] @ np.full(2, np.sqrt(0.5))
    shape.triplot(across, now[:, 2], faces, color="C0", linewidth=0.2)
    shape.set(xlabel="towards the chamber [mm]", ylabel="z [mm]", title=f"{case.mbar[-1]:.0f} mbar", aspect="equal")
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=100)
