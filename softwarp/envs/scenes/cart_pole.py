"""A cart on rails with a rigid pole hinged to it. Scene only; the task is ``tasks/cart_pole.py``.

Frame: the cart runs along x, its middle at z = 0; the pole stands up along +z in front of it (towards -y) and turns
about a hinge along y. With M and m the masses, d from the hinge to the pole's centre, J the pole's moment of inertia
about that centre, and F the force on the cart,

    (M + m) x'' + m d (a'' cos a - a'^2 sin a) = F,    (J + m d^2) a'' + m d x'' cos a = m g d sin a.

Reference: SofaGym, CartPole scene; Barto, Sutton, Anderson (1983) for the measures of ``CartPoleConfig.classic``.
"""

from __future__ import annotations

from dataclasses import dataclass

from softwarp import shapes
from softwarp.builder import ModelBuilder
from softwarp.envs.options.cart_pole import CartPoleSceneConfig
from softwarp.scene import Joint, RigidBody


@dataclass(frozen=True)
class CartPoleScene:
    """Ids of what was added to the builder."""

    cart: RigidBody
    pole: RigidBody
    hinge: Joint


def build_cart_pole_scene(config: CartPoleSceneConfig, builder: ModelBuilder) -> CartPoleScene:
    """Add cart, pole and hinge."""
    cart = builder.add_rigid(shapes.Box(config.cart_size), mass=config.cart_mass, free_axes="x", name="cart")
    hinge_at = (0.0, -config.pole_offset, config.hinge_height)
    pole = builder.add_rigid(
        shapes.Box(config.pole_size),
        mass=config.pole_mass,
        pose=(0.0, -config.pole_offset, config.hinge_height + config.hinge_distance),
        name="pole",
    )
    hinge = builder.add_joint(cart, pole, "hinge", anchor=hinge_at, axis=(0.0, 1.0, 0.0), name="hinge")
    return CartPoleScene(cart, pole, hinge)
