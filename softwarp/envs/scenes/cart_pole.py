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
from softwarp.envs.options import Gravity, Length, Mass, Place, Sizes, check_options
from softwarp.scene import Joint, RigidBody


@dataclass(kw_only=True)
class CartPoleSceneConfig:
    """Options of the scene; the defaults are SofaGym's, with the pole's true moment of inertia."""

    cart_size: Sizes = (0.10, 0.06, 0.06)  # m
    cart_mass: Mass = 1.0  # kg
    pole_size: Sizes = (0.02, 0.02, 0.25)  # m, upright
    pole_mass: Mass = 0.1  # kg
    hinge_height: Place = 0.01  # m, above the cart's middle
    hinge_distance: Length = 0.11  # m, from the hinge to the pole's centre
    gravity: Gravity = (0.0, 0.0, -9.81)  # m/s^2

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        check_options(self)

    @property
    def pole_offset(self) -> float:
        """How far before the cart's middle the pole hangs [m]; it clears the cart's front by 3 mm."""
        return 0.5 * (self.cart_size[1] + self.pole_size[1]) + 0.003


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
