"""A cart on rails with a flexible stem. Scene only; the tasks are in ``cart_stem.py`` and ``cart_stem_contact.py``.

Frame: the cart runs along x, its middle at z = 0, the unloaded stem rises from there along +z, and all motion is in the
x-z plane. A stem of one section bends into a circular arc, as the Cosserat stems of SofaGym do; more sections make it a
true rod. With E I the bending stiffness and L the length, one section under a tip weight P is stable upright up to
P = 3 E I / L^2 and has the stiffness 4 E I / L^3 - 4 P / (3 L) sideways; many sections buckle at pi^2 / 4 E I / L^2.

Reference: SofaGym, scenes of CartStem and CartStemContact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softwarp import shapes
from softwarp.builder import ModelBuilder
from softwarp.envs.options.cart_stem import CartStemSceneConfig, StemConfig
from softwarp.scene import RigidBody, Rod


@dataclass(frozen=True)
class CartStemScene:
    """Ids of what was added to the builder."""

    cart: RigidBody
    sphere: RigidBody
    stem: Rod


def build_cart_stem_scene(config: CartStemSceneConfig, builder: ModelBuilder) -> CartStemScene:
    """Add a cart that slides along x, the stem on it and a sphere at the stem's end."""
    cart = builder.add_rigid(shapes.Box(config.cart_size), mass=config.cart_mass, free_axes="x", name="cart")
    stem = add_stem(config, builder, cart)
    ball = shapes.Sphere(config.sphere_radius)
    sphere = builder.add_rigid(
        ball,
        mass=config.sphere_mass,
        damping=config.sphere_damping,
        pose=(0.0, 0.0, config.length),
        name="sphere",
    )
    builder.attach(sphere, to=stem, node=-1)
    return CartStemScene(cart, sphere, stem)


def add_stem(
    config: StemConfig, builder: ModelBuilder, cart: RigidBody, *, skin: float | None = None, pieces: int = 1
) -> Rod:
    """Add the stem, upright on the middle of a cart.

    Args:
        config: Its measures.
        builder: Where to add it.
        cart: What carries it.
        skin: Radius that contact and pictures see [m]; None takes that of the section.
        pieces: Straight pieces per section that contact sees.
    """
    area, bending = math.pi * config.radius**2, math.pi * config.radius**4 / 4.0
    shear = 6.0 * (1.0 + config.nu) / (7.0 + 6.0 * config.nu) * area  # Cowper, round sections
    stem = builder.add_rod(
        np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, config.length), config.sections + 1),
        radius=config.radius if skin is None else skin,
        youngs=config.youngs,
        nu=config.nu,
        density=config.density,
        normal=(1.0, 0.0, 0.0),
        section=(area, shear, config.flatness * bending, bending, 2.0 * bending),
        rayleigh=config.rayleigh,
        contact_pieces=pieces,
        name="stem",
    )
    builder.attach(stem, nodes=[0], to=cart)
    return stem


def arc_poses(cart_x: Tensor, curvature: Tensor, arc_length: Tensor) -> Tensor:
    """Poses of points along a stem of constant curvature.

    Args:
        cart_x: Where it stands [m], shape (world,).
        curvature: Towards +x [1/m], shape (world,).
        arc_length: Of the points, from the cart [m], shape (point,).

    Returns:
        Positions [m] and quaternions x y z w, shape (world, point, 7).
    """
    angle = curvature[:, None] * arc_length
    half = 0.5 * angle
    zero = torch.zeros_like(angle)
    sideways = arc_length * half.sin() * torch.sinc(half / math.pi)  # (1 - cos k s) / k without cancellation
    upwards = arc_length * torch.sinc(angle / math.pi)  # sin(k s) / k
    return torch.stack((cart_x[:, None] + sideways, zero, upwards, zero, half.sin(), zero, half.cos()), dim=-1)
