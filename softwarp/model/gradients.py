"""Gradients of a loss by what a step reads, with a world axis; their units are that of the loss over the named one."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from softwarp.model.fields import batched


@dataclass
class Ends:
    """Where the nodes of floating frames are at the end of a step, whose gradients turn with them."""

    node_x: wp.array = batched("node", width=3, unit="m", doc="position")
    node_v: wp.array = batched("node", width=3, unit="m/s", doc="velocity")


@dataclass
class Gradients:
    """What the adjoint of a step reads and writes.

    Those by the state are by the end of the step before its adjoint has run, and by its start afterwards. Those by
    commands are written anew by every step, those by parameters are summed over steps.
    """

    node_x: wp.array = batched("node", width=3, unit="m", doc="by position")
    node_v: wp.array = batched("node", width=3, unit="m/s", doc="by velocity")
    frame_pose: wp.array = batched("frame", width=7, unit="m", doc="by position and quaternion, along which it turns")
    frame_twist: wp.array = batched("frame", width=6, unit="m/s", doc="by velocity and spin [rad/s]")
    mode_q: wp.array = batched("mode", unit="m", doc="by the amplitude of a mode of a reduced body")
    mode_v: wp.array = batched("mode", unit="m/s", doc="by its velocity")
    mode_turn: wp.array = batched(
        "floating", width=4, doc="by the quaternion of a floating frame, along which it turns"
    )
    node_memory: wp.array = batched("relaxing node", width=3, unit="m", doc="by what stretches Maxwell branches")
    frame_memory: wp.array = batched("relaxing frame", width=6, unit="m", doc="likewise, and of turning [rad]")
    joint_reference: wp.array = batched("joint", unit="m", doc="by the position [rad] that a servo steers to")
    cable_tension: wp.array = batched("cable", unit="N", doc="by the tension that a step has found")
    cavity_pressure: wp.array = batched("cavity", unit="Pa", doc="by the pressure that a step has found")

    command_node_force: wp.array = batched("node", width=3, unit="N", doc="by external force")
    command_frame_force: wp.array = batched("frame", width=6, unit="N", doc="by external force and moment [N m]")
    command_body_velocity: wp.array = batched("rigid", width=6, unit="m/s", doc="by the velocity of a kinematic body")
    command_joint_target: wp.array = batched("joint", unit="m", doc="by target of a motor [rad, m/s, rad/s]")
    command_joint_force: wp.array = batched("joint", unit="N", doc="by commanded force [N m]")
    command_cable_displacement: wp.array = batched("cable", unit="m", doc="by target shortening")
    command_cable_tension: wp.array = batched("cable", unit="N", doc="by commanded tension")
    command_cavity_pressure: wp.array = batched("cavity", unit="Pa", doc="by commanded pressure")
    command_cavity_volume: wp.array = batched("cavity", unit="m^3", doc="by commanded volume")
    command_cavity_gas: wp.array = batched("cavity", unit="m^3", doc="by commanded gas")
    command_traction: wp.array = batched("traction", width=3, unit="Pa", doc="by force per area")

    youngs: wp.array = batched("body", unit="Pa", doc="by Young's modulus; 0 where the law has own parameters")
    nu: wp.array = batched("body", doc="by Poisson's ratio; likewise")
    density: wp.array = batched("body", unit="kg/m^3", doc="by density")
    rayleigh_mass: wp.array = batched("body", unit="1/s", doc="by the Rayleigh factor of the mass matrix")
    rayleigh_stiffness: wp.array = batched("body", unit="s", doc="by the Rayleigh factor of the stiffness matrix")
    relaxation_ratio: wp.array = batched("relaxing body", doc="by the stiffness of the Maxwell branch per the law's")
    relaxation_time: wp.array = batched("relaxing body", unit="s", doc="by the time in which its force decays")
    gravity: wp.array = batched("world", width=3, unit="m/s^2", doc="by gravity")
    law_parameter: wp.array = batched("law parameter", unit="Pa", doc="by a law's own parameters [exponents: 1]")
    cable_stiffness: wp.array = batched("elastic cable", unit="N/m", doc="by the stiffness of a cable that stretches")
    cable_damping: wp.array = batched("elastic cable", unit="N s/m", doc="by its damping")
    body_mass: wp.array = batched("rigid", unit="kg", doc="by mass, with which moments of inertia grow")
    body_damping: wp.array = batched("rigid", unit="1/s", doc="by the damping of motion")
    joint_stiffness: wp.array = batched("joint", unit="N/m", doc="by the stiffness of a servo [N m/rad]")
    joint_damping: wp.array = batched("joint", unit="N s/m", doc="by its damping [N m s/rad]")
    membrane_youngs: wp.array = batched("membrane", unit="Pa", doc="by Young's modulus")
    membrane_nu: wp.array = batched("membrane", doc="by Poisson's ratio")
    rod_youngs: wp.array = batched("rod", unit="Pa", doc="by Young's modulus")
    rod_nu: wp.array = batched("rod", doc="by Poisson's ratio")
    rod_density: wp.array = batched("rod", unit="kg/m^3", doc="by density")
    rod_rayleigh_mass: wp.array = batched("rod", unit="1/s", doc="by the Rayleigh factor of the mass matrix")
    rod_rayleigh_stiffness: wp.array = batched("rod", unit="s", doc="by the Rayleigh factor of the stiffness matrix")
    pair_mu: wp.array = batched("pair", unit="", doc="by the friction coefficient of a contact pair")

    rest_x: wp.array = batched("node", width=3, unit="m", doc="by the rest position, where it was asked for")
    cable_rest_length: wp.array = batched("cable", unit="m", doc="by the length at rest, likewise")


STATE = ("node_x", "node_v", "cable_tension", "cavity_pressure")
FRAMES = ("frame_pose", "frame_twist")  # of the state too, where there are rods
FLOATING = ("mode_turn",)  # where some of them have floating frames
MODES = ("mode_q", "mode_v")  # where there are reduced bodies, whose nodes follow them
MEMORIES = ("node_memory", "frame_memory")  # where there are Maxwell branches
JOINTS = ("joint_reference",)  # where there are joints
JOINT_MEMORY = ("joint_position", "joint_multiplier")  # how many turns they have made, and where a search starts
REST = ("rest_x", "cable_rest_length")
CONTACT = ("contact_count", "contact_key", "contact_force")  # where the search for contact forces starts
KINEMATIC = ("frame_pose", "frame_twist", "held_pose", "seen_pose")  # where kinematic bodies are
COMMANDS = (  # after ``command_``
    *("node_force", "body_force", "rod_force", "body_velocity", "joint_target", "joint_force"),
    *("traction", "cable_displacement", "cable_tension"),
    *("cavity_pressure", "cavity_volume", "cavity_gas"),
)
PARAMETERS = (
    *("youngs", "nu", "density", "rayleigh_mass", "rayleigh_stiffness", "gravity", "law_parameter"),
    *("relaxation_ratio", "relaxation_time"),
    *("membrane_youngs", "membrane_nu", "cable_stiffness", "cable_damping", "pair_mu"),
    *("body_mass", "body_damping", "joint_stiffness", "joint_damping"),
    *("rod_youngs", "rod_nu", "rod_density", "rod_rayleigh_mass", "rod_rayleigh_stiffness"),
)
