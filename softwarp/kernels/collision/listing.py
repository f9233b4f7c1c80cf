"""The list of contacts: what touches joins it, forces stay with their keys. Theory: docs/theory/collision.md."""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.collision.geometry import APART, DISTANCE, NORMAL, TOUCH_ROWS, TURNED
from softwarp.model.codes import URGENCIES, CoupleColumn


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of one variant, on single worlds."""
    real = variant.real
    module = variant.module("listing")

    @wp.func
    def put(
        pack: int,
        place: int,
        lane: int,
        pair: int,
        key: int,
        owner: int,
        face: int,
        known: int,
        key_out: wp.array3d(dtype=wp.int32),
        pair_out: wp.array3d(dtype=wp.int32),
        couple_out: wp.array3d(dtype=wp.int32),
        face_out: wp.array3d(dtype=wp.int32),
        known_out: wp.array3d(dtype=wp.int32),
    ):
        """A contact of a couple at one place of the list."""
        key_out[pack, place, lane] = key
        pair_out[pack, place, lane] = pair
        couple_out[pack, place, lane] = owner
        face_out[pack, place, lane] = face
        known_out[pack, place, lane] = known

    @wp.kernel(module=module, enable_backward=False)
    def collect(
        # Model
        chunk_key: wp.array(dtype=wp.int32),
        chunk_couple: wp.array(dtype=wp.int32),
        couple: wp.array2d(dtype=wp.int32),
        capacity: int,
        # Workspace in
        chunk_hits_in: wp.array3d(dtype=wp.int32),
        hit_in: wp.array3d(dtype=wp.int32),
        known_count_in: wp.array3d(dtype=wp.int32),
        known_key_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        listed_out: wp.array3d(dtype=wp.int32),
        count_out: wp.array3d(dtype=wp.int32),
        overflow_out: wp.array3d(dtype=wp.int32),
        key_out: wp.array3d(dtype=wp.int32),
        pair_out: wp.array3d(dtype=wp.int32),
        couple_out: wp.array3d(dtype=wp.int32),
        face_out: wp.array3d(dtype=wp.int32),
        known_out: wp.array3d(dtype=wp.int32),
        reserve_count_out: wp.array3d(dtype=wp.int32),
        reserve_key_out: wp.array3d(dtype=wp.int32),
        reserve_couple_out: wp.array3d(dtype=wp.int32),
        reserve_face_out: wp.array3d(dtype=wp.int32),
    ):
        """Contacts of one world from its hits; each finds its predecessor, as both lists ascend.

        If there are too many, those that touch already go before those that might touch within the step. What waits
        goes into the reserve, which has as much room. Of a step's lists the one that left out most tells how many.
        """
        pack, lane = wp.tid()
        total = int(0)
        for chunk in range(chunk_couple.shape[0]):
            total += chunk_hits_in[pack, chunk, lane]
        waiting = int(0)
        spare = int(total)  # places for contacts that are not urgent
        if total > capacity:
            spare = capacity
            for chunk in range(chunk_couple.shape[0]):
                if chunk_hits_in[pack, chunk, lane] > 0:
                    for key in range(chunk_key[chunk], chunk_key[chunk + 1]):
                        if hit_in[pack, key, lane] >= 0 and hit_in[pack, key, lane] % wp.static(URGENCIES) == 0:
                            spare -= 1
        count = int(0)
        m = int(0)
        known = wp.min(known_count_in[pack, 0, lane], capacity)
        for chunk in range(chunk_couple.shape[0]):
            if chunk_hits_in[pack, chunk, lane] > 0:
                owner = chunk_couple[chunk]
                for key in range(chunk_key[chunk], chunk_key[chunk + 1]):
                    hit = hit_in[pack, key, lane]
                    takes = hit >= 0 and count < capacity
                    if hit >= 0 and hit % wp.static(URGENCIES) == 2:
                        takes = False
                        if waiting < capacity:
                            reserve_key_out[pack, waiting, lane] = key
                            reserve_couple_out[pack, waiting, lane] = owner
                            reserve_face_out[pack, waiting, lane] = hit / wp.static(URGENCIES)
                        waiting += 1
                    elif takes and hit % wp.static(URGENCIES) == 1:
                        takes = spare > 0
                        spare -= 1
                    if takes:
                        while m < known and known_key_in[pack, wp.min(m, capacity - 1), lane] < key:
                            m += 1
                        found = int(-1)
                        if m < known:
                            if known_key_in[pack, m, lane] == key:
                                found = m
                        pair = couple[owner, wp.static(CoupleColumn.PAIR)]
                        face = hit / wp.static(URGENCIES)
                        put(
                            pack,
                            count,
                            lane,
                            pair,
                            key,
                            owner,
                            face,
                            found,
                            key_out,
                            pair_out,
                            couple_out,
                            face_out,
                            known_out,
                        )
                        count += 1
        listed_out[pack, 0, lane] = count
        count_out[pack, 0, lane] = count
        kept = wp.min(waiting, capacity)
        overflow_out[pack, 0, lane] = wp.max(overflow_out[pack, 0, lane], total - count - kept)
        reserve_count_out[pack, 0, lane] = kept
        for c in range(count, capacity):
            key_out[pack, c, lane] = -1
            pair_out[pack, c, lane] = 0
            couple_out[pack, c, lane] = 0
            face_out[pack, c, lane] = -1
            known_out[pack, c, lane] = -1

    @wp.kernel(module=module, enable_backward=False)
    def call_up(
        # Model
        couple: wp.array2d(dtype=wp.int32),
        capacity: int,
        # Workspace in
        reserve_key_in: wp.array3d(dtype=wp.int32),
        reserve_couple_in: wp.array3d(dtype=wp.int32),
        reserve_face_in: wp.array3d(dtype=wp.int32),
        reserve_touch_in: wp.array3d(dtype=real),
        pair_distance_in: wp.array3d(dtype=real),
        idle_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        reserve_count_out: wp.array3d(dtype=wp.int32),
        first_out: wp.array3d(dtype=wp.int32),
        count_out: wp.array3d(dtype=wp.int32),
        overflow_out: wp.array3d(dtype=wp.int32),
        key_out: wp.array3d(dtype=wp.int32),
        pair_out: wp.array3d(dtype=wp.int32),
        couple_out: wp.array3d(dtype=wp.int32),
        face_out: wp.array3d(dtype=wp.int32),
        known_out: wp.array3d(dtype=wp.int32),
    ):
        """Append one world's reserve, from ``first`` on, if any of it overlaps at the end of the step; once a step.

        All of it, because nothing looks again at where the step leads with those alone. Else it goes on waiting, as it
        does in idle worlds, which keep their contacts.
        """
        pack, lane = wp.tid()
        count = count_out[pack, 0, lane]
        first_out[pack, 0, lane] = count
        needed = bool(False)
        for r in range(reserve_count_out[pack, 0, lane]):
            pair = couple[reserve_couple_in[pack, r, lane], wp.static(CoupleColumn.PAIR)]
            end = reserve_touch_in[pack, wp.static(TOUCH_ROWS) * r + wp.static(DISTANCE), lane]
            if end < pair_distance_in[pack, pair, lane] and idle_in[pack, 0, lane] == 0:
                needed = True
        missed = int(0)
        if needed:
            for r in range(reserve_count_out[pack, 0, lane]):
                if count < capacity:
                    key = reserve_key_in[pack, r, lane]
                    owner = reserve_couple_in[pack, r, lane]
                    pair = couple[owner, wp.static(CoupleColumn.PAIR)]
                    face = reserve_face_in[pack, r, lane]
                    put(
                        pack,
                        count,
                        lane,
                        pair,
                        key,
                        owner,
                        face,
                        -1,
                        key_out,
                        pair_out,
                        couple_out,
                        face_out,
                        known_out,
                    )
                    count += 1
                else:
                    missed += 1
            reserve_count_out[pack, 0, lane] = 0
        count_out[pack, 0, lane] = count
        overflow_out[pack, 0, lane] = overflow_out[pack, 0, lane] + missed

    @wp.func
    def is_served(
        pack: int,
        lane: int,
        c: int,
        touch: wp.array3d(dtype=real),
        axes: wp.array3d(dtype=real),
        gap: real,
        distance: real,
        depth: real,
        again: bool,
    ):
        """Whether the rows of a contact are good enough for where it ends: else they turned, or have failed before.

        One that has been left apart says that others serve.
        """
        row = wp.static(TOUCH_ROWS) * c
        cosine = real(0.0)
        for k in range(3):
            cosine += touch[pack, row + wp.static(NORMAL) + k, lane] * axes[pack, 9 * c + k, lane]
        is_held = touch[pack, row + wp.static(DISTANCE), lane] - distance >= wp.min(gap, real(0.0)) - depth
        return is_held or gap == real(APART) or (cosine >= real(TURNED) and not again)

    @wp.kernel(module=module, enable_backward=False)
    def collect_late(
        # Model
        chunk_key: wp.array(dtype=wp.int32),
        chunk_couple: wp.array(dtype=wp.int32),
        couple: wp.array2d(dtype=wp.int32),
        capacity: int,
        # Workspace in
        chunk_hits_in: wp.array3d(dtype=wp.int32),
        hit_in: wp.array3d(dtype=wp.int32),
        listed_in: wp.array3d(dtype=wp.int32),
        axes_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        touch_in: wp.array3d(dtype=real),
        pair_distance_in: wp.array3d(dtype=real),
        called_in: wp.array3d(dtype=wp.int32),
        depth: real,
        again: bool,
        # Workspace out
        first_out: wp.array3d(dtype=wp.int32),
        count_out: wp.array3d(dtype=wp.int32),
        overflow_out: wp.array3d(dtype=wp.int32),
        key_out: wp.array3d(dtype=wp.int32),
        pair_out: wp.array3d(dtype=wp.int32),
        couple_out: wp.array3d(dtype=wp.int32),
        face_out: wp.array3d(dtype=wp.int32),
        known_out: wp.array3d(dtype=wp.int32),
    ):
        """Append hits of one world, from ``first`` on, that no listed contact of that key and face serves.

        Gaps of late contacts at the start are extrapolated: no penetration that was there before.
        """
        pack, lane = wp.tid()
        first = count_out[pack, 0, lane]
        count = int(first)
        missed = int(0)
        for chunk in range(chunk_couple.shape[0]):
            if chunk_hits_in[pack, chunk, lane] > 0:
                owner = chunk_couple[chunk]
                for key in range(chunk_key[chunk], chunk_key[chunk + 1]):
                    hit = hit_in[pack, key, lane]
                    is_new = hit >= 0
                    pair = couple[owner, wp.static(CoupleColumn.PAIR)]
                    c = int(0)
                    while is_new and c < first:
                        if c >= called_in[pack, 0, lane] and pair_out[pack, c, lane] == pair:
                            is_new = False  # served by what was called up, from the side where the step began
                        elif key_out[pack, c, lane] == key and face_out[pack, c, lane] == hit / wp.static(URGENCIES):
                            gap = gap_in[pack, c, lane]
                            if c >= listed_in[pack, 0, lane] and gap != real(APART):
                                gap = real(0.0)
                            distance = pair_distance_in[pack, pair_out[pack, c, lane], lane]
                            is_new = not is_served(pack, lane, c, touch_in, axes_in, gap, distance, depth, again)
                        c += 1
                    if is_new and count < capacity:
                        face = hit / wp.static(URGENCIES)
                        put(
                            pack,
                            count,
                            lane,
                            pair,
                            key,
                            owner,
                            face,
                            -1,
                            key_out,
                            pair_out,
                            couple_out,
                            face_out,
                            known_out,
                        )
                        count += 1
                    elif is_new:
                        missed += 1
        first_out[pack, 0, lane] = first
        count_out[pack, 0, lane] = count
        overflow_out[pack, 0, lane] = overflow_out[pack, 0, lane] + missed

    @wp.func
    def place_of(
        pack: int, lane: int, c: int, count: int, listed: wp.array3d(dtype=wp.int32), key: wp.array3d(dtype=wp.int32)
    ):
        """Place of contact c in ascending order of the keys, in which only late contacts are not."""
        place = int(c)
        if listed[pack, 0, lane] < count and c < count:
            own = key[pack, c, lane]
            place = int(0)
            for other in range(count):
                if key[pack, other, lane] < own or (key[pack, other, lane] == own and other < c):
                    place += 1
        return place

    @wp.kernel(module=module, enable_backward=False)
    def remember(
        joins: bool,
        # Workspace in
        listed_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        key_in: wp.array3d(dtype=wp.int32),
        axes_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        # Workspace out
        known_count_out: wp.array3d(dtype=wp.int32),
        known_key_out: wp.array3d(dtype=wp.int32),
        known_force_out: wp.array3d(dtype=real),
    ):
        """Key and force of one contact [N], in world axes, on side a, in ascending order of the keys; 0 past the last.

        Only late contacts, past those that were listed first, are out of order. Where a late one has the key of a
        listed one, whose rows have failed, this one receives the forces of both if they are to be joined.
        """
        pack, c, lane = wp.tid()
        count = count_in[pack, 0, lane]
        place = place_of(pack, lane, c, count, listed_in, key_in)
        if c == 0:
            known_count_out[pack, 0, lane] = count
        known_key_out[pack, place, lane] = key_in[pack, c, lane]
        for i in range(3):
            force = real(0.0)
            if c < count:
                for axis in range(3):
                    force += multiplier_in[pack, 3 * c + axis, lane] * axes_in[pack, 9 * c + 3 * axis + i, lane]
                if joins:
                    for other in range(wp.max(listed_in[pack, 0, lane], c + 1), count):
                        if key_in[pack, other, lane] == key_in[pack, c, lane]:
                            for axis in range(3):
                                entry = 9 * other + 3 * axis + i
                                force += multiplier_in[pack, 3 * other + axis, lane] * axes_in[pack, entry, lane]
            known_force_out[pack, 3 * place + i, lane] = force

    @wp.kernel(module=module, enable_backward=False)
    def load(
        # State
        count_in: wp.array2d(dtype=wp.int32),
        key_in: wp.array2d(dtype=wp.int32),
        force_in: wp.array2d(dtype=real),
        world_count: int,
        lanes: int,
        # Workspace out
        known_count_out: wp.array3d(dtype=wp.int32),
        known_key_out: wp.array3d(dtype=wp.int32),
        known_force_out: wp.array3d(dtype=real),
        overflow_out: wp.array3d(dtype=wp.int32),
    ):
        """Remembered contacts from the state, and none left out so far; lanes past the last world repeat it."""
        pack, c, lane = wp.tid()
        world = wp.min(pack * lanes + lane, world_count - 1)
        if c == 0:
            known_count_out[pack, 0, lane] = count_in[world, 0]
            overflow_out[pack, 0, lane] = 0
        known_key_out[pack, c, lane] = key_in[world, c]
        for i in range(3):
            known_force_out[pack, 3 * c + i, lane] = force_in[world, 3 * c + i]

    @wp.kernel(module=module, enable_backward=False)
    def store(
        lanes: int,
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        known_count_in: wp.array3d(dtype=wp.int32),
        known_key_in: wp.array3d(dtype=wp.int32),
        known_force_in: wp.array3d(dtype=real),
        # State out
        count_out: wp.array2d(dtype=wp.int32),
        key_out: wp.array2d(dtype=wp.int32),
        force_out: wp.array2d(dtype=real),
    ):
        """Remembered contacts into the state of a good world; a failed one loses forces that are no numbers."""
        pack, c, lane = wp.tid()
        world = pack * lanes + lane
        if world < count_out.shape[0]:
            is_good = flag_in[pack, 0, lane] + flag_in[pack, 1, lane] == 0
            if is_good:
                if c == 0:
                    count_out[world, 0] = known_count_in[pack, 0, lane]
                key_out[world, c] = known_key_in[pack, c, lane]
            for i in range(3):
                if is_good:
                    force_out[world, 3 * c + i] = known_force_in[pack, 3 * c + i, lane]
                elif not wp.isfinite(force_out[world, 3 * c + i]):
                    force_out[world, 3 * c + i] = real(0.0)

    return SimpleNamespace(
        collect=collect,
        call_up=call_up,
        collect_late=collect_late,
        place_of=place_of,
        put=put,
        remember=remember,
        load=load,
        store=store,
    )
