"""Bad inputs end in a sentence that names them: no raw traceback, nothing accepted silently, nothing half done.

``bad_input_cases`` lists the calls: every argument of the builder, of shapes, materials and meshes, and every option of
the solver, of each registered environment and of other public functions takes each bad value in turn. Hypothesis
draws further values, the same ones in every run.
"""

import dataclasses
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.internal.conjecture import providers

import softwarp as sw
from softwarp import checks, control, diagnostics, gradients, identification, interop, meshing, reduction
from softwarp.envs import registry
from softwarp.envs.actions import ActionGuard
from softwarp.envs.snapshot import world_index
from softwarp.model.handles import RigidBody, Rod
from softwarp.solvers.partition import thread_count
from tests.bad_input_cases import BAD, Call, judge, option_calls, scene_calls, value_calls
from tests.bad_library_cases import ELSEWHERE, RECORDS, library_calls
from tests.unit.envs.fake import PointConfig, PointEnv

LEAST = 12000  # bad inputs that the lists make; fewer means that a call has got lost

FIXED = settings(derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck))

SCENES, VALUES, OPTIONS, LIBRARY = scene_calls(), value_calls(), option_calls(), library_calls()
ALL = [*SCENES, *VALUES, *OPTIONS, *LIBRARY]


def drawn(examples: int = 100, **values: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Makes a test of a function whose arguments Hypothesis draws.

    Hypothesis would mix in constants that it reads, for four seconds, in the source of whatever is loaded: other ones
    in each process. Here it knows of none, and they are not read while tests are collected either.
    """

    def made(function: Callable[..., None]) -> Callable[..., None]:
        told = settings(FIXED, max_examples=examples)(given(**values)(function))

        def test(monkeypatch: pytest.MonkeyPatch) -> None:
            monkeypatch.setattr(providers, "_get_local_constants", lambda: providers._local_constants, raising=False)
            told()

        test.__doc__ = function.__doc__
        return test

    return made


def faults(call: Call) -> list[str]:
    """What is wrong with how a call takes its bad inputs."""
    found = [(argument, kind, judge(call, argument, kind, given)) for argument, kind, given in call.inputs()]
    return [f"{call.name}({argument}={kind}): {fault}" for argument, kind, fault in found if fault is not None]


@pytest.mark.parametrize("call", ALL, ids=lambda call: call.name)
def test_every_bad_value_of_every_argument_is_refused(call):
    """By softwarp itself, naming the argument or its object; a refused call leaves the builder's scene as it was."""
    call.function(**call.good)
    assert not faults(call)


def test_no_call_is_missing():
    """The builder's methods, the solver's options and all registered environments are among the calls."""
    named = {call.name.split()[0] for call in ALL}
    methods = {name for name in dir(sw.ModelBuilder) if name.startswith("add_")} | {"fix", "attach", "finalize"}
    assert methods | {"Options", *registry.names()} <= named
    public = {name for module in (meshing, reduction, identification, gradients, control) for name in module.__all__}
    assert public - RECORDS - ELSEWHERE <= named
    assert public >= RECORDS | ELSEWHERE
    assert sum(1 for call in ALL for _ in call.inputs()) >= LEAST


def test_refusals_are_told_from_accidents():
    """The judge finds what NumPy raises, what nobody raises, and a message that names nothing."""
    raw = Call("raw", lambda value: float(value), {"value": 1.0})
    silent = Call("silent", lambda value: value, {"value": 1.0})
    vague = Call("vague", lambda value: checks.number(value, "something"), {"value": 1.0})
    assert judge(raw, "value", "text", {"value": "a"}).startswith("raw ValueError")
    assert judge(silent, "value", "text", {"value": "a"}) == "accepted silently"
    assert judge(vague, "value", "text", {"value": "a"}).startswith("the message names none")


# Meshes: what a cast would hide


def _corner_cases() -> list[tuple[str, Any, Any]]:
    mesh = meshing.box((0.1, 0.1, 0.1), (1, 1, 1))
    x, t = mesh.nodes, mesh.tets
    far = t.astype(np.int64)
    return [
        ("tets + 2^32", x, far + 2**32),
        ("tets - 2^32", x, far - 2**32),
        ("tets of 64 bits without sign", x, far.astype(np.uint64) + np.uint64(2**63)),
        ("tets + 0.5", x, t + 0.5),
        ("tets as floats", x, t.astype(float)),
        ("tets as flags", x, t.astype(bool)),
        ("complex tets", x, t.astype(complex)),
        ("complex nodes", x.astype(complex), t),
        ("nodes as text", x.astype(str), t),
        ("nodes as objects", x.astype(object), t),
        ("nodes as flags", x.astype(bool), t),
        ("nodes with nan", np.where(x > 0.05, np.nan, x), t),
        ("nodes far away", x + 1e12, t),
        ("nodes of 1e-200 m", x * 1e-200, t),
        ("nodes of 1e200 m", x * 1e200, t),
        ("two coordinates", x[:, :2], t),
        ("three corners", x, t[:, :3]),
        ("no tets", x, t[:0]),
        ("no nodes", x[:0], t),
        ("negative corners", x, t - 1),
        ("flat rows", x, t.ravel()),
    ]


@pytest.mark.parametrize("case", _corner_cases(), ids=lambda case: case[0])
def test_mesh_arrays_are_checked_before_they_are_cast(case):
    """Wherever a mesh comes in; none of these is the box that a cast to 32-bit integers or floats would make of it."""
    _, nodes, tets = case
    material = sw.Corotational(1e5, 0.3)
    for make in (
        lambda: sw.ModelBuilder().add_tets(nodes, tets, material=material, density=1e3),
        lambda: sw.ModelBuilder().add_tets(nodes, tets, material=material, density=1e3, element="p2"),
        lambda: meshing.TetMesh(nodes, tets),
        lambda: meshing.elevate(nodes, tets),
        lambda: meshing.check_tets(nodes, tets),
    ):
        with pytest.raises(meshing.MeshError, match=r"mesh '"):
            make()


# Handles, worlds, views, seeds, actions


@pytest.mark.parametrize("handle", [RigidBody(7), Rod(7), RigidBody(-1), Rod(-1), 7, -1, True, 1.0, "cube", None])
def test_parts_that_do_not_exist_are_named(handle):
    builder = sw.ModelBuilder()
    body = builder.add_tets(meshing.box((0.1,) * 3, (1, 1, 1)), material=sw.Corotational(1e5, 0.3), density=1e3)
    calls = [
        lambda: builder.fix(handle, nodes=[0]),
        lambda: builder.attach(handle, nodes=[0], to=handle),
        lambda: builder.add_point_load(handle, [0], (0.0, 0.0, 1.0)),
        lambda: builder.add_cable(handle, [[0.05] * 3, [0.06] * 3]),
        lambda: builder.add_marker(handle, (0.05,) * 3),
        lambda: builder.add_contact(body, handle),
        lambda: builder.add_joint(handle, (handle, 0)),
    ]
    for call in calls:
        with pytest.raises(ValueError, match=r"does not exist|no soft body|must be|connects"):
            call()


WORLDS = [4, -1, 2**40, [4], [0, -1], 1.5, [0.5], "a", ["a"], [None], [[0], [1, 2]], 1j, [True, False], {"a": 1}]


@pytest.mark.parametrize("worlds", WORLDS, ids=str)
def test_worlds_that_do_not_exist_are_named(worlds):
    """Of a simulation, of an environment."""
    if not isinstance(worlds, int):
        with pytest.raises(ValueError, match="world"):
            interop.world_index(worlds, 4, torch.device("cpu"))
    with pytest.raises(ValueError, match="worlds"):
        world_index(worlds, torch.ones(4, dtype=torch.bool))


def test_views_refuse_assignment():
    """A tensor put in their place would be seen by nobody; what was written into a view may be assigned."""
    tensors = {"node_x": torch.zeros(1, 2, 3)}
    views = interop.Views("sim.control", tensors)
    views.node_x += 1.0
    assert (tensors["node_x"] == 1.0).all()
    with pytest.raises(AttributeError, match=r"sim.control.node_x is a view .* write sim.control.node_x\[...\] ="):
        views.node_x = torch.zeros(1, 2, 3)
    with pytest.raises(AttributeError, match="no 'node_y'; did you mean node_x"):
        views.node_y = torch.zeros(1, 2, 3)
    sim = object.__new__(sw.Simulation)
    sim._views, sim._aliases = tensors, {}
    sim.node_x *= 2.0
    assert (tensors["node_x"] == 2.0).all()
    with pytest.raises(AttributeError, match=r"sim.node_x is a view .* write sim.node_x\[...\] ="):
        sim.node_x = torch.zeros(1, 2, 3)


@pytest.mark.parametrize("threads", [0, -1, 1.5, True, "a", 10**9])
def test_threads_are_counted_in_whole_numbers(threads):
    with pytest.raises(ValueError, match="threads must be an integer of at least 1"):
        thread_count(threads)


@pytest.mark.parametrize("seed", [-1, 2**63, 2**70, 1.0, True, "a", 1j])
def test_seeds_fit_the_generators(seed):
    with pytest.raises(ValueError, match=r"seed must be an integer that lies in \[0, 2\^63\), got"):
        checks.seed(seed)


@pytest.mark.parametrize("seed", [1.5, "a", [0], [0, -1], [0, 1.0], {"a": 1}, True, -1])
def test_seeds_of_gymnasium_are_checked(seed):
    """One for the first world, or one for each."""
    env = object.__new__(sw.gym.VectorEnv)
    env.num_envs = 2
    with pytest.raises(ValueError, match="reset: seed must be an integer"):
        env.reset(seed=seed)
    with pytest.raises(ValueError, match="reset: options must be a dictionary"):
        env.reset(options="a")
    with pytest.raises(ValueError, match="reset: seed must be an integer"):
        object.__new__(sw.gym.SingleEnv).reset(seed=seed)


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("action", [None, 0.0, "a", [[0.0, 0.0]] * 4, np.zeros((4, 2)), torch.zeros(3, 2)], ids=str)
def test_actions_of_another_form_are_refused(discrete, action):
    env = PointEnv(PointConfig(discrete=discrete, settle=False), num_worlds=4, seed=0)
    guard = ActionGuard("Point", env.action_spec, env.action_count, is_on=False)
    with pytest.raises(ValueError, match="Point: action must"):
        guard.check_form(action)


def test_stiffness_of_rods_and_rigid_bodies_is_refused():
    """Their unknowns are no node scalars; the message says so before anything is launched."""
    builder = sw.ModelBuilder()
    builder.add_rod([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], radius=0.01, youngs=1e6)
    systems: Any = [SimpleNamespace(model=builder.finalize())]
    with pytest.raises(ValueError, match="stiffness_matrix: the scene has 1 rods and 0 rigid bodies"):
        diagnostics.stiffness_matrix(systems)
    with pytest.raises(ValueError, match="direction must be a tensor of shape"):
        diagnostics.tangent_product(systems, torch.zeros(3))
    with pytest.raises(ValueError, match="stiffness_matrix: the scene has"):
        diagnostics.tangent_product(systems, torch.zeros(1, 0, 3))


# Drawn values

ANYTHING = st.one_of(
    st.floats(),
    st.integers(),
    st.booleans(),
    st.none(),
    st.text(max_size=3),
    st.complex_numbers(),
    st.lists(st.floats(), max_size=4),
    st.lists(st.lists(st.floats(), max_size=3), max_size=3),
)


@drawn(value=ANYTHING, low=st.floats(-1e6, 1e6), width=st.floats(0.0, 1e6))
def test_a_number_is_returned_as_it_is_or_refused(value, low, width):
    """What passes is the value as a float within its limits; what does not is named with its limits."""
    try:
        found = checks.number(value, "thing: size [m]", low=low, high=low + width)
    except ValueError as error:
        assert str(error).startswith("thing: size [m] must ") and ", got " in str(error)
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        assert not (is_number and low <= value <= low + width)
    else:
        assert type(found) is float and found == value and low <= found <= low + width


@drawn(value=st.lists(st.integers(-(2**70), 2**70), min_size=1, max_size=6))
def test_integers_keep_their_values_or_are_refused(value):
    """No cast wraps around."""
    try:
        found = checks.integers(value, "corners", (None,))
    except ValueError as error:
        assert "corners must be integers in [0, 2147483647]" in str(error)
        assert not all(0 <= entry < 2**31 for entry in value)
    else:
        assert found.tolist() == value


@drawn(300, data=st.data())
def test_accepted_options_are_finite(data):
    """Of any environment with any one option drawn: refused by name, or every number of it finite or without limit."""
    name = data.draw(st.sampled_from(registry.names()))
    config = registry.spec(name).config_class()
    option = data.draw(st.sampled_from([f.name for f in dataclasses.fields(config)]))
    value = data.draw(ANYTHING)
    try:
        made = config(**{option: value})
    except ValueError as error:
        assert option in str(error) or option.split("_")[0] in str(error)
        return
    kept = getattr(made, option)
    numbers = kept if isinstance(kept, (list, tuple)) else [kept]
    flat = [x for entry in numbers for x in (entry if isinstance(entry, (list, tuple)) else [entry])]
    assert not any(isinstance(x, float) and math.isnan(x) for x in flat)
    unlimited = ("min_tension", "min_displacement", "max_displacement", "max_rate")
    assert option in unlimited or all(math.isfinite(x) for x in flat if isinstance(x, float))


@drawn(300, data=st.data())
def test_drawn_arguments_of_the_builder(data):
    """Any value in place of any argument: taken, or refused by softwarp itself."""
    call = data.draw(st.sampled_from(SCENES))
    argument = data.draw(st.sampled_from(sorted(set(call.good) - set(call.left_out))))
    value = data.draw(ANYTHING)
    fault = judge(call, argument, "drawn", call.good | {argument: value})
    assert fault is None or fault == "accepted silently", f"{call.name}({argument}={value!r}): {fault}"


def test_the_list_of_bad_values_is_bad():
    """Nothing on it is a plain number near 1, so that no call takes it by chance but for those that say so."""
    assert all(not (type(v) is float and 0.0 < v < 1e6) for v in BAD.values())
