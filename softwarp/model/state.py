"""Arrays with a world axis: what a step changes, what a caller commands, and what differs between worlds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import warp as wp

from softwarp.model.fields import allocate, batched, declarations, real_of
from softwarp.model.model import Model

Container = TypeVar("Container")


@dataclass
class State:
    """All that is needed to resume, plus the outputs that follow from it."""

    node_x: wp.array = batched("node", start="x0", width=3, unit="m", doc="position")
    node_v: wp.array = batched("node", start="v0", width=3, unit="m/s", doc="velocity")
    cable_tension: wp.array = batched("cable", start="tension", unit="N", doc="tension of the last step; warm start")
    good_x: wp.array = batched("node", width=3, unit="m", doc="positions after the last good step")
    good_v: wp.array = batched("node", width=3, unit="m/s", doc="velocities after the last good step")
    frame_pose: wp.array = batched("frame", start="pose0", width=7, unit="m", doc="position and quaternion x y z w")
    frame_twist: wp.array = batched("frame", start="twist0", width=6, unit="m/s", doc="velocity and spin [rad/s]")
    good_pose: wp.array = batched("frame", width=7, unit="m", doc="poses after the last good step")
    good_twist: wp.array = batched("frame", width=6, unit="m/s", doc="twists after the last good step")
    held_pose: wp.array = batched("rigid", start="held_pose", width=7, unit="m", doc="pose that it is held at")
    seen_pose: wp.array = batched("rigid", start="seen_pose", width=7, unit="m", doc="pose command of the last step")
    mode_q: wp.array = batched("mode", start="mode_q0", unit="m", doc="amplitude of a mode of a reduced body")
    mode_v: wp.array = batched("mode", start="mode_v0", unit="m/s", doc="its velocity")
    mode_turn: wp.array = batched(
        "floating", start="mode_turn0", width=4, doc="quaternion x y z w of a floating frame, from rest"
    )
    good_mode_q: wp.array = batched("mode", unit="m", doc="amplitudes after the last good step")
    good_mode_v: wp.array = batched("mode", unit="m/s", doc="their velocities then")
    good_mode_turn: wp.array = batched("floating", width=4, doc="floating frames then")
    cavity_pressure: wp.array = batched("cavity", start="pressure", unit="Pa", doc="gauge pressure; warm start")
    cavity_volume: wp.array = batched("cavity", unit="m^3", doc="volume of a chamber")
    joint_position: wp.array = batched("joint", start="joint_position", unit="m", doc="way, or angle [rad] of a hinge")
    joint_velocity: wp.array = batched("joint", unit="m/s", doc="its change in the last step [rad/s]")
    joint_force: wp.array = batched("joint", unit="N", doc="force of the motor [N m]")
    joint_reaction: wp.array = batched("joint", width=6, unit="N", doc="force, moment [N m] at the anchor on the child")
    joint_reference: wp.array = batched(
        "joint", start="joint_reference", unit="m", doc="position [rad] a servo steers to"
    )
    joint_multiplier: wp.array = batched(
        "joint row", start="joint_multiplier", unit="N", doc="forces of its rows; warm start"
    )
    tube_length: wp.array = batched("tube", start="tube_length0", unit="m", doc="deployed length")
    tube_angle: wp.array = batched("tube", start="tube_angle0", unit="rad", doc="angle at the base")
    base_angle: wp.array = batched("telescope", start="base_angle0", unit="rad", doc="angle of its frame at the port")
    windup: wp.array = batched(
        "windup", start="windup0", unit="rad", doc="angle of a tube at a node to the tube that reaches farthest"
    )
    good_length: wp.array = batched("tube", unit="m", doc="deployed lengths after the last good step")
    good_angle: wp.array = batched("tube", unit="rad", doc="angles at the base then")
    good_base: wp.array = batched("telescope", unit="rad", doc="angle of the frame at the port then")
    good_windup: wp.array = batched("windup", unit="rad", doc="angles of tubes at nodes then")
    telescope_load: wp.array = batched(
        "telescope segment", start="telescope_load0", width=2, unit="N m", doc="bending by loads, smoothed"
    )
    segment_law: wp.array = batched(
        "varying segment", width=13, doc="length [m], stiffnesses C [N] and D [N m^2], rest strain of a segment"
    )
    contact_count: wp.array = batched("world", doc="contacts remembered from the last step", integer=True)
    contact_overflow: wp.array = batched(
        "world", doc="most contacts of a step that found no place, since it was set to 0", integer=True
    )
    contact_key: wp.array = batched("contact", doc="feature and target of a remembered contact", integer=True)
    contact_force: wp.array = batched("contact", width=3, unit="N", doc="its force on the feature; warm start")
    contact_pair: wp.array = batched("contact", doc="pair of a contact, -1 for none", integer=True)
    contact_point: wp.array = batched("contact", width=3, unit="m", doc="where the parts touch")
    contact_normal: wp.array = batched("contact", width=3, doc="normal towards part a of the pair")
    contact_load: wp.array = batched("contact", width=3, unit="N", doc="force on part a")
    contact_gap: wp.array = batched("contact", unit="m", doc="distance less contact distance, at the step's start")
    pair_force: wp.array = batched("pair", width=3, unit="N", doc="sum of forces on part a of a pair")
    node_memory: wp.array = batched(
        "relaxing node", start="node_memory", width=3, unit="m", doc="what stretches the Maxwell branches"
    )
    frame_memory: wp.array = batched(
        "relaxing frame", start="frame_memory", width=6, unit="m", doc="likewise, and of turning [rad]"
    )
    time: wp.array = batched("world", unit="s", doc="simulated time")
    status: wp.array = batched("world", doc="result code of the last step", integer=True)
    residual: wp.array = batched("world", unit="m", doc="constraint residual of the last step")
    inverted_count: wp.array = batched("world", doc="elements inside out after the last step", integer=True)
    compression: wp.array = batched("world", doc="1 - J of the most compressed element, J its volume ratio; 1: flat")
    marker_x: wp.array = batched("marker", width=3, unit="m", doc="marker position")
    marker_v: wp.array = batched("marker", width=3, unit="m/s", doc="marker velocity")
    cable_x: wp.array = batched("point", width=3, unit="m", doc="points of all cables in order")
    cable_length: wp.array = batched("cable", unit="m", doc="length")
    cable_displacement: wp.array = batched("cable", unit="m", doc="rest length minus length")


LATER = ("state.inverted_count", "state.compression")  # outputs that older snapshots do not have


@dataclass
class Control:
    """Commands; written by the caller only."""

    cable_displacement: wp.array = batched("cable", unit="m", doc="target shortening under length control")
    cable_tension: wp.array = batched("cable", unit="N", doc="tension under force control")
    node_force: wp.array = batched("node", width=3, unit="N", doc="external force")
    traction: wp.array = batched("traction", width=3, unit="Pa", doc="force per area at rest of its faces, world axes")
    cavity_pressure: wp.array = batched("cavity", unit="Pa", doc="gauge pressure under pressure control")
    cavity_volume: wp.array = batched("cavity", unit="m^3", doc="volume under volume control")
    cavity_gas: wp.array = batched("cavity", unit="m^3", doc="gas under gas control: its volume at ambient pressure")
    tube_length: wp.array = batched("tube", unit="m", doc="deployed length that is wanted")
    tube_angle: wp.array = batched("tube", unit="rad", doc="angle at the base that is wanted")
    joint_target: wp.array = batched("joint", unit="m", doc="position [rad] or velocity [m/s, rad/s] as commanded")
    joint_force: wp.array = batched("joint", unit="N", doc="force [N m] under force control; added to a servo's")
    frame_force: wp.array = batched("frame", width=6, unit="N", doc="external force and moment [N m], world axes")
    body_pose: wp.array = batched("rigid", width=7, unit="m", doc="pose of a kinematic body; followed when it changes")
    body_velocity: wp.array = batched("rigid", width=6, unit="m/s", doc="velocity and spin of a kinematic body")


@dataclass
class Parameters:
    """Physical parameters of every world; may be written at any time and hold from the next step on."""

    youngs: wp.array = batched("body", unit="Pa", doc="Young's modulus; only a scale where the law has own parameters")
    nu: wp.array = batched("body", doc="Poisson's ratio; likewise")
    density: wp.array = batched("body", unit="kg/m^3", doc="density")
    rayleigh_mass: wp.array = batched("body", unit="1/s", doc="Rayleigh factor of the mass matrix")
    rayleigh_stiffness: wp.array = batched("body", unit="s", doc="Rayleigh factor of the stiffness matrix")
    relaxation_ratio: wp.array = batched("relaxing body", doc="stiffness of the Maxwell branch per that of the law")
    relaxation_time: wp.array = batched("relaxing body", unit="s", doc="in which its force decays")
    gravity: wp.array = batched("world", width=3, unit="m/s^2", doc="gravity")
    cable_min_displacement: wp.array = batched("cable", unit="m", doc="lower limit of the target")
    cable_max_displacement: wp.array = batched("cable", unit="m", doc="upper limit of the target")
    cable_min_tension: wp.array = batched("cable", unit="N", doc="0: the cable only pulls")
    cable_max_tension: wp.array = batched("cable", unit="N", doc="upper limit of the tension")
    body_mass: wp.array = batched("rigid", unit="kg", doc="mass; the inertia scales with it")
    body_damping: wp.array = batched("rigid", unit="1/s", doc="mass-proportional damping")
    body_max_speed: wp.array = batched("rigid", unit="m/s", doc="largest speed of a kinematic body")
    body_max_spin: wp.array = batched("rigid", unit="rad/s", doc="largest angular speed of a kinematic body")
    cavity_min_pressure: wp.array = batched("cavity", unit="Pa", doc="lower limit of the gauge pressure")
    cavity_max_pressure: wp.array = batched("cavity", unit="Pa", doc="upper limit of the gauge pressure")
    cavity_min_volume: wp.array = batched("cavity", unit="m^3", doc="lower limit of a commanded volume")
    cavity_max_volume: wp.array = batched("cavity", unit="m^3", doc="upper limit of a commanded volume")
    cavity_max_pressure_rate: wp.array = batched("cavity", unit="Pa/s", doc="largest change of a commanded pressure")
    cavity_max_flow: wp.array = batched("cavity", unit="m^3/s", doc="largest change of commanded volume or gas")
    cavity_ambient: wp.array = batched("cavity", unit="Pa", doc="absolute pressure outside")
    cavity_exponent: wp.array = batched("cavity", doc="exponent of the gas law: 1 isothermal, 1.4 adiabatic")
    membrane_youngs: wp.array = batched("membrane", unit="Pa", doc="Young's modulus")
    membrane_nu: wp.array = batched("membrane", doc="Poisson's ratio")
    joint_stiffness: wp.array = batched("joint", unit="N/m", doc="of a servo [N m/rad]; from 1e29 on it is rigid")
    joint_damping: wp.array = batched("joint", unit="N s/m", doc="of a servo [N m s/rad]")
    joint_max_force: wp.array = batched("joint", unit="N", doc="largest force of the motor [N m]")
    joint_max_rate: wp.array = batched("joint", unit="m/s", doc="largest speed of the reference [rad/s]")
    joint_min_position: wp.array = batched("joint", unit="m", doc="lower limit [rad]")
    joint_max_position: wp.array = batched("joint", unit="m", doc="upper limit [rad]")
    pair_mu: wp.array = batched("pair", doc="friction coefficient")
    pair_restitution: wp.array = batched("pair", doc="coefficient of restitution")
    pair_contact_distance: wp.array = batched("pair", unit="m", doc="distance at which surfaces rest on each other")
    pair_alarm_distance: wp.array = batched("pair", unit="m", doc="distance from which they are looked at")
    pair_compliance: wp.array = batched("pair", unit="m/N", doc="compliance of the normal law")
    rod_youngs: wp.array = batched("rod", unit="Pa", doc="Young's modulus")
    rod_nu: wp.array = batched("rod", doc="Poisson's ratio")
    rod_density: wp.array = batched("rod", unit="kg/m^3", doc="density")
    rod_rayleigh_mass: wp.array = batched("rod", unit="1/s", doc="Rayleigh factor of the mass matrix")
    rod_rayleigh_stiffness: wp.array = batched("rod", unit="s", doc="Rayleigh factor of the stiffness matrix")
    tube_youngs: wp.array = batched("tube", unit="Pa", doc="Young's modulus; sections keep their ratio to it")
    tube_nu: wp.array = batched("tube", doc="Poisson's ratio")
    tube_density: wp.array = batched("tube", unit="kg/m^3", doc="density")
    tube_curvature: wp.array = batched("tube", doc="factor on the stress-free curvature")
    tube_max_speed: wp.array = batched("tube", unit="m/s", doc="largest speed of insertion")
    tube_max_spin: wp.array = batched("tube", unit="rad/s", doc="largest angular speed at the base")
    cable_max_rate: wp.array = batched("cable", unit="m/s", doc="largest change of the displacement per time")
    cable_stiffness: wp.array = batched("elastic cable", unit="N/m", doc="from 1e29 on it does not stretch")
    cable_damping: wp.array = batched("elastic cable", unit="N s/m", doc="of stretching")
    body_choice: wp.array = batched("choice", doc="which mesh a body with one of several has, of those in contact")
    law_parameter: wp.array = batched("law parameter", unit="Pa", doc="of laws with own parameters [exponents: 1]")


def create(cls: type[Container], model: Model) -> Container:
    """Allocate every declared array of a container, zeroed."""
    real = real_of(model.precision)
    arrays: dict[str, Any] = {}
    for name, declaration in declarations(cls).items():
        rows = model.items(declaration["item"]) * declaration["width"]
        dtype = wp.int32 if declaration["integer"] else real
        arrays[name] = allocate(model.num_worlds, rows, dtype, model.device)
    return cls(**arrays)


def create_parameters(model: Model) -> Parameters:
    """Parameters filled with the values given to the builder, the same in every world."""
    parameters = create(Parameters, model)
    for name in declarations(Parameters):
        array: wp.array = getattr(parameters, name)
        if array.shape[1]:
            value = np.broadcast_to(model.defaults[name].reshape(1, -1), array.shape)
            array.assign(np.ascontiguousarray(value, dtype=wp.dtype_to_numpy(array.dtype)))
    return parameters


def worlds_slice(container: Container, begin: int, end: int) -> Container:
    """The same container over worlds ``begin`` .. ``end``, without a copy."""
    cls: Any = type(container)

    def part(array: wp.array) -> wp.array:
        if array.shape[1] == 0:  # Warp refuses to slice an empty array
            return wp.zeros((end - begin, 0), dtype=array.dtype, device=array.device)
        return array[begin:end]

    return cls(**{name: part(getattr(container, name)) for name in declarations(cls)})  # type: ignore[no-any-return]
