"""Constants of reduced bodies with a floating frame: modes that turn with the body."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from softwarp.model.fields import shared

RIGID = 6  # first modes of such a body: along the world's axes, and about them


@dataclass
class FloatingModel:
    """Reduced bodies whose modes live in a frame at their centre of mass.

    Their first six modes are rigid and depend on the state. Where bases have a column for the first of them, it holds
    the place at rest in the body's axes, against the centre of mass, and has the amplitude 1: so Phi q is the place.
    """

    # Host
    count: int  # floating bodies

    # Device
    body: wp.array = shared("floating", doc="soft body")
    number: wp.array = shared("floating", doc="reduced body")
    first: wp.array = shared("floating", doc="first mode")
    modes: wp.array = shared("floating", doc="modes, up to a multiple of three")
    first_wide: wp.array = shared("floating", doc="first wide mode")
    block: wp.array = shared("floating", doc="first block of modes")
    centre: wp.array = shared("floating", unit="m", doc="centre of mass at rest, (floating, 3)")
    radius: wp.array = shared("floating", unit="m", doc="radius of gyration: amplitude per angle")
    volume: wp.array = shared("floating", unit="m^3", doc="mass per density")
    listed_start: wp.array = shared("floating", doc="ranges in listed, (floating + 1,)")
    listed: wp.array = shared("floating listed", doc="listed node, body after body")
    listed_body: wp.array = shared("floating listed", doc="its floating body")
    touch: wp.array = shared("floating touch", doc="touching node")
    touch_range: wp.array = shared("floating", doc="touching nodes: first, end, (floating, 2)")
    touch_body: wp.array = shared("touch", doc="floating body of a touching node, -1 for none")
    touch_node: wp.array = shared("touch", doc="its node")
    moment_start: wp.array = shared("floating", doc="first of its moments")
    moment_body: wp.array = shared("moment", doc="floating body of a mode, up to its stride")
    moment_first: wp.array = shared("moment", doc="first entry in moments")
    moment_wide: wp.array = shared("moment", doc="first wide mode of the body")
    moment_stride: wp.array = shared("moment", doc="stride of the body")
    moments: wp.array = shared("moments", unit="m^3", doc="sum of volume phi_l phi_k': (mode k, 3, 3, stride of l)")
    pair: wp.array = shared("turning pair", doc="pair of blocks of which the earlier one turns the body")
    pair_body: wp.array = shared("turning pair", doc="its floating body")
    pair_mode: wp.array = shared("turning pair", doc="first mode of the later block, counted in the body")
    tet_body: wp.array = shared("tet sample", doc="floating body of a sample, -1 for none")
    tri_body: wp.array = shared("tri sample", doc="likewise")
    point_body: wp.array = shared("row point", doc="floating body that carries a point of a row, -1 for none")
    row: wp.array = shared("floating row", doc="mode row of a floating body")
    row_body: wp.array = shared("floating row", doc="its floating body")
