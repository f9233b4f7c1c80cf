"""A driven cart with a flexible stem between two fixed obstacles. Task: ``tasks/cart_stem_contact.py``.

Frame: as in ``cart_stem.py``. The obstacles are boxes turned by 45 degrees about y, so that each shows the stem
an edge at height 0.12 m. The stem touches them with a skin of 1 mm radius, SofaGym's contact distance, whatever the
radius of its section; its weightless tip sphere is there for pictures.

Reference: SofaGym, CartStemContact scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from softwarp import shapes
from softwarp.builder import ModelBuilder
from softwarp.envs.options.cart_stem_contact import CartStemContactSceneConfig
from softwarp.envs.scenes.cart_stem import add_stem
from softwarp.scene import RigidBody, Rod

TURN = (0.0, math.sin(math.pi / 8.0), 0.0, math.cos(math.pi / 8.0))  # quaternion of the obstacles
TIP_MASS = 1.0e-6  # kg
MOTOR_CART_MASS = 1.0  # kg, of a cart with a motor, which holds it where it is told whatever its mass


@dataclass(frozen=True)
class CartStemContactScene:
    """Ids of what was added to the builder."""

    cart: RigidBody
    tip: RigidBody
    obstacles: tuple[RigidBody, RigidBody]  # left, right
    stem: Rod


def build_cart_stem_contact_scene(
    config: CartStemContactSceneConfig,
    builder: ModelBuilder,
    centres: tuple[float, float] = (-0.05, 0.05),
    *,
    motor: bool = False,
) -> CartStemContactScene:
    """Add a cart moved along x as commanded, its stem, and the two obstacles.

    Args:
        config: Measures and materials.
        builder: Where to add them.
        centres: Where the obstacles stand [m].
        motor: Move the cart by a motor, joint 0, which inverse control can command, instead of a prescribed velocity.
    """
    box = shapes.Box(config.cart_size)
    if motor:
        cart = builder.add_rigid(box, mass=MOTOR_CART_MASS, free_axes="x", name="cart")
        rate, axis = config.max_speed, (1.0, 0.0, 0.0)
        builder.add_joint(None, cart, "slider", axis=axis, control="position", max_rate=rate, name="motor")
    else:
        cart = builder.add_rigid(box, kinematic=True, max_speed=config.max_speed, name="cart")
    stem = add_stem(config, builder, cart, skin=config.skin, pieces=config.contact_pieces)
    ball = shapes.Sphere(max(config.radius, config.skin))
    tip = builder.add_rigid(ball, mass=TIP_MASS, pose=(0.0, 0.0, config.length), name="tip")
    builder.attach(tip, to=stem, node=-1)
    obstacles = []
    for name, x in zip(("left", "right"), centres, strict=True):
        box = shapes.Box(config.obstacle_size)
        pose = (x, 0.0, config.obstacle_height, *TURN)
        obstacle = builder.add_rigid(box, kinematic=True, pose=pose, name=f"{name} obstacle")
        builder.add_contact(stem, obstacle, mu=config.mu)
        obstacles.append(obstacle)
    return CartStemContactScene(cart, tip, (obstacles[0], obstacles[1]), stem)
