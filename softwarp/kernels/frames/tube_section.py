"""Sections of tubes one in the other, and of the segments that they make up together. Theory: docs/theory/telescope.md.

Bending, torsion, shear and axial stiffnesses of the tubes at a place add, and their stress-free curvatures, turned by
their angles, have the mean that these stiffnesses weigh. A segment has parts between the ends of tubes and sections:
their rigid motions without load follow one another, which is exact, and their compliances add.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra import screw, single
from softwarp.kernels.algebra.lanes import Variant, single_worlds

PLAN_ROWS = 7  # of a telescope: old and new length of its line, way and old and new carrier, whether it moves, base
LAW_ROWS = 13  # of a segment: length, C, D, rest strain
# rad, of a segment at rest: what curls more needs shorter ones, and beyond pi its ends lie either way round
MOST_CURL = 2.5
GRAIN = 2.0e-4  # of a segment: parts shorter than that, which float32 may not resolve, are left out
RIGID = 1.0e-4  # of a segment: shortest length behind the port that counts as one that twists
SMOOTHING = 0.1  # part of the change of a moment that one step takes into account


@cache
def structures(scalar: Any) -> SimpleNamespace:
    """Structs of one scalar type: ``Tubes``, ``Materials``, ``Part`` and ``Mean``."""
    real = scalar
    vec3 = wp.types.vector(3, real)

    @wp.struct
    class Tubes:
        first_tube: wp.array(dtype=wp.int32)
        pieces: wp.array(dtype=wp.int32)
        first_windup: wp.array(dtype=wp.int32)
        hidden_twists: wp.array(dtype=wp.int32)
        whole: wp.array(dtype=real)
        area: wp.array(dtype=real)
        section_start: wp.array(dtype=wp.int32)
        section_end: wp.array(dtype=real)
        section_ratio: wp.array(dtype=real)
        section_curvature: wp.array(dtype=real)

    @wp.struct
    class Materials:
        youngs: wp.array3d(dtype=real)
        nu: wp.array3d(dtype=real)
        factor: wp.array3d(dtype=real)  # on stress-free curvature

    @wp.struct
    class Part:
        """What one tube has at a place."""

        bending: real  # E I
        torsion: real  # G J
        shear: real  # G A_s
        axial: real  # E A
        x: real  # stress-free curvature in the axes of the carrier
        y: real
        twist: real  # stress-free twist less the change of its angle to the carrier

    @wp.struct
    class Mean:
        """What all tubes have together at a place."""

        bending: real
        torsion: real
        shear: real
        axial: real
        k: vec3  # curvature and twist without load

    return SimpleNamespace(Tubes=Tubes, Materials=Materials, Part=Part, Mean=Mean)


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """What tubes have at a place, alone and together."""
    real = variant.real
    vec3 = single.functions(variant).vec3
    found = structures(variant.real)
    Tubes, Materials, Part, Mean = found.Tubes, found.Materials, found.Part, found.Mean

    @wp.func
    def shown(length: wp.array3d(dtype=real), pack: int, lane: int, tube: int, carrier: int, line: real):
        """How far a tube reaches on the line."""
        reach = length[pack, tube, lane]
        if tube == carrier:
            reach = line
        return reach

    @wp.func
    def section_at(tubes: Tubes, tube: int, place: real):
        """Section of a tube at a distance from its base."""
        part = tubes.section_start[tube]
        final = tubes.section_start[tube + 1] - 1
        while part < final and tubes.section_end[part] <= place:
            part += 1
        return part

    @wp.func
    def next_stop(
        tubes: Tubes,
        length: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        telescope: int,
        carrier: int,
        line: real,
        s: real,
        end: real,
        grain: real,
    ):
        """Where the first tube or section beyond s ends, or ``end``."""
        stop = end
        for tube in range(tubes.first_tube[telescope], tubes.first_tube[telescope + 1]):
            reach = shown(length, pack, lane, tube, carrier, line)
            if reach > s + grain:
                stop = wp.min(stop, reach)
                behind = tubes.whole[tube] - reach
                part = section_at(tubes, tube, s + grain + behind)
                border = tubes.section_end[part] - behind
                if border > s + grain:
                    stop = wp.min(stop, border)
        if end - stop < grain:
            stop = end
        return stop

    @wp.func
    def part_at(
        tubes: Tubes,
        materials: Materials,
        pack: int,
        lane: int,
        tube: int,
        reach: real,
        s: real,
        psi: real,
        change: real,
    ):
        """What a tube has at a place."""
        behind = tubes.whole[tube] - reach
        part = section_at(tubes, tube, s + behind)
        e = materials.youngs[pack, tube, lane] * tubes.section_ratio[part]
        g = e / (real(2.0) * (real(1.0) + materials.nu[pack, tube, lane]))
        factor = materials.factor[pack, tube, lane]
        kx = factor * tubes.section_curvature[3 * part]
        ky = factor * tubes.section_curvature[3 * part + 1]
        found = Part()
        found.bending = e * tubes.area[4 * tube + 2]
        found.torsion = g * tubes.area[4 * tube + 3]
        found.shear = g * tubes.area[4 * tube + 1]
        found.axial = e * tubes.area[4 * tube]
        if kx != real(0.0) or ky != real(0.0):  # most of a wire is straight
            c = wp.cos(psi)
            d = wp.sin(psi)
            found.x = c * kx - d * ky
            found.y = d * kx + c * ky
        found.twist = factor * tubes.section_curvature[3 * part + 2] - change
        return found

    @wp.func
    def angle_at(windup: wp.array3d(dtype=real), pack: int, lane: int, row: int, t: real):
        """Angle of a tube between two nodes."""
        return windup[pack, row, lane] * (real(1.0) - t) + windup[pack, row + 1, lane] * t

    @wp.func
    def mean_at(
        tubes: Tubes,
        materials: Materials,
        length: wp.array3d(dtype=real),
        windup: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        telescope: int,
        carrier: int,
        line: real,
        place: int,
        s: real,
    ):
        """What all tubes have together at s, which lies in segment ``place``."""
        n = tubes.pieces[telescope]
        piece = line / real(n)
        first = tubes.first_tube[telescope]
        result = Mean()
        for tube in range(first, tubes.first_tube[telescope + 1]):
            reach = shown(length, pack, lane, tube, carrier, line)
            if reach > s:
                row = tubes.first_windup[telescope] + (tube - first) * (n + 1) + place
                psi = angle_at(windup, pack, lane, row, s / piece - real(place))
                change = (windup[pack, row + 1, lane] - windup[pack, row, lane]) / piece
                part = part_at(tubes, materials, pack, lane, tube, reach, s, psi, change)
                result.bending += part.bending
                result.torsion += part.torsion
                result.shear += part.shear
                result.axial += part.axial
                result.k += vec3(part.bending * part.x, part.bending * part.y, part.torsion * part.twist)
        result.k = vec3(result.k[0] / result.bending, result.k[1] / result.bending, result.k[2] / result.torsion)
        return result

    return SimpleNamespace(shown=shown, next_stop=next_stop, part_at=part_at, angle_at=angle_at, mean_at=mean_at)


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Sections and moments of segments, on single worlds."""
    real = variant.real
    one = single.functions(variant)
    vec3, quat, vector_at, quat_at, put = one.vec3, one.quat, one.vector_at, one.quat_at, one.put
    exponential, logarithm = one.exponential, one.logarithm
    turning = screw.functions(variant)
    spread, gathered = turning.spread, turning.gathered
    vec4 = wp.types.vector(4, real)
    types, place_of = structures(variant.real), functions(variant)
    Tubes, Materials = types.Tubes, types.Materials
    next_stop, mean_at = place_of.next_stop, place_of.mean_at
    module = variant.module("tube_section")

    @wp.kernel(module=module, enable_backward=False)
    def compose(
        # Model
        tubes: Tubes,
        piece_telescope: wp.array(dtype=wp.int32),
        piece_place: wp.array(dtype=wp.int32),
        piece_segment: wp.array(dtype=wp.int32),
        # Workspace in
        materials: Materials,
        plan_in: wp.array3d(dtype=real),
        length_in: wp.array3d(dtype=real),
        windup_in: wp.array3d(dtype=real),
        # Workspace out
        law_out: wp.array3d(dtype=real),
    ):
        """Section of one segment: its parts in a row, each with its own curvature; compliances add."""
        pack, item, lane = wp.tid()
        telescope = piece_telescope[item]
        place = piece_place[item]
        row = wp.static(PLAN_ROWS) * telescope
        line = plan_in[pack, row + 1, lane]
        carrier = int(plan_in[pack, row + 4, lane])
        n = tubes.pieces[telescope]
        piece = line / real(n)
        grain = real(wp.static(GRAIN)) * piece
        s = real(place) * piece
        end = s + piece
        soft = vec4()
        x = vec3()
        q = quat(real(0.0), real(0.0), real(0.0), real(1.0))
        rounds = int(0)
        while end - s > grain and rounds < 1000:
            stop = next_stop(tubes, length_in, pack, lane, telescope, carrier, line, s, end, grain)
            part = stop - s
            mean = mean_at(
                tubes,
                materials,
                length_in,
                windup_in,
                pack,
                lane,
                telescope,
                carrier,
                line,
                place,
                s + real(0.5) * part,
            )
            soft += vec4(part / mean.bending, part / mean.torsion, part / mean.shear, part / mean.axial)
            turn = mean.k * (
                part * wp.min(real(1.0), real(MOST_CURL) / wp.max(wp.length(mean.k) * piece, real(1.0e-6)))
            )
            x += wp.quat_rotate(q, spread(turn, vec3(real(0.0), real(0.0), part)))
            q = wp.normalize(q * exponential(turn))
            s = stop
            rounds += 1
        turn = logarithm(q)
        u = gathered(turn, x)
        out = wp.static(LAW_ROWS) * piece_segment[item]
        law_out[pack, out, lane] = piece
        put(law_out, pack, lane, out + 1, vec3(piece / soft[2], piece / soft[2], piece / soft[3]))
        put(law_out, pack, lane, out + 4, vec3(piece / soft[0], piece / soft[0], piece / soft[1]))
        put(law_out, pack, lane, out + 7, u / piece)
        put(law_out, pack, lane, out + 10, turn / piece)

    @wp.kernel(module=module, enable_backward=False)
    def bend(
        # Model
        piece_segment: wp.array(dtype=wp.int32),
        seg_frame: wp.array2d(dtype=wp.int32),
        lanes: int,
        # State
        contact_count_in: wp.array2d(dtype=wp.int32),
        # Workspace in
        law_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        load0_in: wp.array3d(dtype=real),
        # Workspace out
        load_out: wp.array3d(dtype=real),
        twist_out: wp.array3d(dtype=real),
    ):
        """Bending moment of loads in one segment, in its axes [N m], smoothed over steps; twist of its frames [1/m].

        A line that swings has other moments from step to step, which the tubes' torsion need not follow. One in contact
        has those of now.
        """
        pack, item, lane = wp.tid()
        segment = piece_segment[item]
        q = quat_at(pose_in, pack, lane, 7 * seg_frame[segment, 0] + 3)
        turn = logarithm(wp.quat_inverse(q) * quat_at(pose_in, pack, lane, 7 * seg_frame[segment, 1] + 3))
        row = wp.static(LAW_ROWS) * segment
        strain = turn / law_in[pack, row, lane] - vector_at(law_in, pack, lane, row + 10)
        d = vector_at(law_in, pack, lane, row + 4)
        share = real(wp.static(SMOOTHING))
        world = pack * lanes + lane
        if world < contact_count_in.shape[0]:
            if contact_count_in[world, 0] > 0:
                share = real(1.0)
        for c in range(2):
            load = load0_in[pack, 2 * item + c, lane]
            load_out[pack, 2 * item + c, lane] = load + share * (d[c] * strain[c] - load)
        twist_out[pack, item, lane] = turn[2] / law_in[pack, row, lane]

    return SimpleNamespace(compose=compose, bend=bend)
