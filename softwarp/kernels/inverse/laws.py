"""Laws beside the actuators in inverse control: contacts, limits, other rows. Theory: docs/theory/laws.md.

Rows that obey a law have a label (``labels``). For given labels the free multipliers are linear in the efforts x of the
actuators, v = z + Z x, and the laws are linear inequalities.
"""

from types import SimpleNamespace

import numpy as np
import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.inverse import labels
from softwarp.kernels.inverse.labels import CONTACT_LAWS
from softwarp.model.codes import FAR, ContactLabel, RowLabel

FIRM = 1.0e-9  # part of W's diagonal that is added to it, as contacts may share their forces in more than one way
ROUNDING = 100.0  # roundings of W's entries that this has to be above


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels that read a shard's workspace and write double precision; one thread per world."""
    real = wp.float64
    narrow = variant.real
    module = variant.module("pivoting")
    firm = max(FIRM, ROUNDING * float(np.finfo(np.float32 if narrow == wp.float32 else np.float64).eps))
    matrix_row = labels.kernels(variant).matrix_row

    @wp.func
    def column_entry(
        matrix: wp.array3d(dtype=narrow),
        direction: wp.array2d(dtype=real),
        mu: wp.array3d(dtype=narrow),
        w: int,
        pack: int,
        lane: int,
        order: int,
        rows: int,
        first_contact: int,
        row: int,
        column: int,
        slides: bool,
    ):
        """W, with the friction that goes with the normal force of a contact that slides."""
        entry = real(matrix[pack, row * order + column, lane])
        if slides:
            c = (column - first_contact) // 3
            along = direction[w, 2 * c] * real(matrix[pack, row * order + column + 1, lane])
            along += direction[w, 2 * c + 1] * real(matrix[pack, row * order + column + 2, lane])
            entry += real(mu[pack, c, lane]) * along
        return entry

    @wp.kernel(module=module, enable_backward=False)
    def free_rows(
        rows: int,
        first_contact: int,
        # Model
        passive_row: wp.array(dtype=wp.int32),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        lower_in: wp.array3d(dtype=narrow),
        upper_in: wp.array3d(dtype=narrow),
        label_in: wp.array2d(dtype=wp.int32),
        # Workspace out
        value_out: wp.array2d(dtype=real),
        free_out: wp.array2d(dtype=wp.int32),
        free_count_out: wp.array2d(dtype=wp.int32),
    ):
        """Items whose multipliers are free, and the multipliers of the others."""
        w = wp.tid()
        lanes = count_in.shape[2]
        pack = w // lanes
        lane = w % lanes
        free = int(0)
        for k in range(rows):
            if label_in[w, k] == wp.static(RowLabel.FREE):
                free_out[w, free] = k
                free += 1
            elif label_in[w, k] == wp.static(RowLabel.LOW):
                value_out[w, k] = real(lower_in[pack, passive_row[k], lane])
            else:
                value_out[w, k] = real(upper_in[pack, passive_row[k], lane])
        for c in range(count_in[pack, 0, lane]):
            for axis in range(3):
                k = rows + 3 * c + axis
                label = label_in[w, rows + c]
                value_out[w, k] = real(0.0)
                if label == wp.static(ContactLabel.STICK) or (label == wp.static(ContactLabel.SLIDE) and axis == 0):
                    free_out[w, free] = k
                    free += 1
        free_count_out[w, 0] = free

    @wp.kernel(module=module, enable_backward=False)
    def eliminate(
        n: int,
        rows: int,
        first_contact: int,
        order: int,
        width: int,
        # Model
        passive_row: wp.array(dtype=wp.int32),
        actuator_row: wp.array(dtype=wp.int32),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        matrix_in: wp.array3d(dtype=narrow),
        free_gap_in: wp.array3d(dtype=narrow),
        compliance_in: wp.array3d(dtype=narrow),
        softness_in: wp.array3d(dtype=narrow),
        mu_in: wp.array3d(dtype=narrow),
        start_in: wp.array2d(dtype=real),
        value_in: wp.array2d(dtype=real),
        label_in: wp.array2d(dtype=wp.int32),
        direction_in: wp.array2d(dtype=real),
        effort_in: wp.array2d(dtype=real),
        free_in: wp.array2d(dtype=wp.int32),
        free_count_in: wp.array2d(dtype=wp.int32),
        # Workspace out
        system_out: wp.array2d(dtype=real),
    ):
        """Z and z of the free rows, by Gauss elimination with pivots; columns free_count .. + n of ``system_out``."""
        w = wp.tid()
        lanes = matrix_in.shape[2]
        pack = w // lanes
        lane = w % lanes
        total = rows + 3 * count_in[pack, 0, lane]
        free = free_count_in[w, 0]
        for f in range(free):
            k = free_in[w, f]
            i = matrix_row(k, rows, first_contact, passive_row)
            base = real(free_gap_in[pack, i, lane])
            for j in range(total):
                column = matrix_row(j, rows, first_contact, passive_row)
                known = real(0.0)
                if j < rows and label_in[w, wp.min(j, rows)] != wp.static(RowLabel.FREE):
                    known = value_in[w, j]
                base += real(matrix_in[pack, i * order + column, lane]) * (known - start_in[w, j])
            for a in range(n):
                entry = real(matrix_in[pack, i * order + actuator_row[a], lane])
                system_out[w, f * width + free + a] = -entry
                base -= entry * effort_in[w, a]
            system_out[w, f * width + free + n] = -base
            for g in range(free):
                other = free_in[w, g]
                column = matrix_row(other, rows, first_contact, passive_row)
                slides = other >= rows and label_in[w, rows + wp.max(other - rows, 0) // 3] == wp.static(
                    ContactLabel.SLIDE
                )
                system_out[w, f * width + g] = column_entry(
                    matrix_in, direction_in, mu_in, w, pack, lane, order, rows, first_contact, i, column, slides
                )
            if k < rows:
                system_out[w, f * width + f] += real(compliance_in[pack, i, lane])
            elif (k - rows) % 3 == 0:
                system_out[w, f * width + f] += real(softness_in[pack, (k - rows) // 3, lane])
            system_out[w, f * width + f] += wp.abs(system_out[w, f * width + f]) * real(wp.static(firm))
        last = free + n + 1
        for f in range(free):
            best = int(f)
            for g in range(f + 1, free):
                if wp.abs(system_out[w, g * width + f]) > wp.abs(system_out[w, best * width + f]):
                    best = g
            for column in range(f, last):
                held = system_out[w, f * width + column]
                system_out[w, f * width + column] = system_out[w, best * width + column]
                system_out[w, best * width + column] = held
            pivot = system_out[w, f * width + f]
            for column in range(f, last):
                system_out[w, f * width + column] = system_out[w, f * width + column] / pivot
            for g in range(free):
                if g != f:
                    factor = system_out[w, g * width + f]
                    for column in range(f, last):
                        system_out[w, g * width + column] -= factor * system_out[w, f * width + column]

    @wp.func
    def reduced(
        n: int,
        entry: int,
        rows: int,
        first_contact: int,
        order: int,
        width: int,
        i: int,
        total: int,
        passive_row: wp.array(dtype=wp.int32),
        actuator_row: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=narrow),
        free_gap: wp.array3d(dtype=narrow),
        mu: wp.array3d(dtype=narrow),
        start: wp.array2d(dtype=real),
        value: wp.array2d(dtype=real),
        label: wp.array2d(dtype=wp.int32),
        direction: wp.array2d(dtype=real),
        effort: wp.array2d(dtype=real),
        free: wp.array2d(dtype=wp.int32),
        free_count: int,
        system: wp.array2d(dtype=real),
        w: int,
        pack: int,
        lane: int,
    ):
        """Row i of W with the laws' response: its entry for the effort of one actuator, or (n) the gap without any."""
        result = real(0.0)
        if entry < n:
            result = real(matrix[pack, i * order + actuator_row[entry], lane])
        else:
            result = real(free_gap[pack, i, lane])
            for a in range(n):
                result -= real(matrix[pack, i * order + actuator_row[a], lane]) * effort[w, a]
            for j in range(total):
                column = matrix_row(j, rows, first_contact, passive_row)
                known = real(0.0)
                if j < rows and label[w, wp.min(j, rows)] != wp.static(RowLabel.FREE):
                    known = value[w, j]
                result += real(matrix[pack, i * order + column, lane]) * (known - start[w, j])
        for f in range(free_count):
            other = free[w, f]
            column = matrix_row(other, rows, first_contact, passive_row)
            slides = other >= rows and label[w, rows + wp.max(other - rows, 0) // 3] == wp.static(ContactLabel.SLIDE)
            weight = column_entry(matrix, direction, mu, w, pack, lane, order, rows, first_contact, i, column, slides)
            result += weight * system[w, f * width + free_count + entry]
        return result

    @wp.kernel(module=module, enable_backward=False)
    def respond(
        n: int,
        rows: int,
        effector_rows: int,
        first_effector: int,
        first_contact: int,
        order: int,
        width: int,
        # Model
        passive_row: wp.array(dtype=wp.int32),
        actuator_row: wp.array(dtype=wp.int32),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        matrix_in: wp.array3d(dtype=narrow),
        free_gap_in: wp.array3d(dtype=narrow),
        target_in: wp.array3d(dtype=narrow),
        mu_in: wp.array3d(dtype=narrow),
        start_in: wp.array2d(dtype=real),
        value_in: wp.array2d(dtype=real),
        label_in: wp.array2d(dtype=wp.int32),
        direction_in: wp.array2d(dtype=real),
        effort_in: wp.array2d(dtype=real),
        free_in: wp.array2d(dtype=wp.int32),
        free_count_in: wp.array2d(dtype=wp.int32),
        system_in: wp.array2d(dtype=real),
        way_low_in: wp.array2d(dtype=real),
        way_high_in: wp.array2d(dtype=real),
        # Workspace out
        effect_out: wp.array2d(dtype=real),
        compliance_out: wp.array2d(dtype=real),
        way_out: wp.array2d(dtype=real),
        gap_out: wp.array2d(dtype=real),
        low_out: wp.array2d(dtype=real),
        high_out: wp.array2d(dtype=real),
        gradient_out: wp.array2d(dtype=real),
    ):
        """What the efforts do to effectors, actuators and the gaps of rows with a law, once the free rows respond."""
        w = wp.tid()
        lanes = matrix_in.shape[2]
        pack = w // lanes
        lane = w % lanes
        total = rows + 3 * count_in[pack, 0, lane]
        free = free_count_in[w, 0]
        for item in range(effector_rows + n + total):
            i = first_effector + item
            if item >= effector_rows:
                i = actuator_row[wp.min(item - effector_rows, n - 1)]
            if item >= effector_rows + n:
                i = matrix_row(item - effector_rows - n, rows, first_contact, passive_row)
            for a in range(n + 1):
                value = reduced(
                    n,
                    a,
                    rows,
                    first_contact,
                    order,
                    width,
                    i,
                    total,
                    passive_row,
                    actuator_row,
                    matrix_in,
                    free_gap_in,
                    mu_in,
                    start_in,
                    value_in,
                    label_in,
                    direction_in,
                    effort_in,
                    free_in,
                    free,
                    system_in,
                    w,
                    pack,
                    lane,
                )
                if item >= effector_rows + n:
                    gradient_out[w, (item - effector_rows - n) * (n + 1) + a] = value
                elif a < n and item < effector_rows:
                    effect_out[w, item * n + a] = value
                elif a < n:
                    compliance_out[w, (item - effector_rows) * n + a] = value
                elif item < effector_rows:
                    gap_out[w, effector_rows + item] = value
                else:
                    way_out[w, item - effector_rows] = value + real(target_in[pack, i, lane])
        for e in range(effector_rows):
            brought = real(0.0)
            for a in range(n):
                brought += effect_out[w, e * n + a] * effort_in[w, a]
            gap_out[w, e] = gap_out[w, effector_rows + e] + brought
            gap_out[w, effector_rows + e] = -brought
        for a in range(n):
            low_out[w, n + a] = way_low_in[w, a] - way_out[w, a]
            high_out[w, n + a] = way_high_in[w, a] - way_out[w, a]

    @wp.kernel(module=module, enable_backward=False)
    def inequalities(
        n: int,
        rows: int,
        first: int,
        count: int,
        width: int,
        # Model
        passive_row: wp.array(dtype=wp.int32),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        lower_in: wp.array3d(dtype=narrow),
        upper_in: wp.array3d(dtype=narrow),
        mu_in: wp.array3d(dtype=narrow),
        label_in: wp.array2d(dtype=wp.int32),
        free_in: wp.array2d(dtype=wp.int32),
        free_count_in: wp.array2d(dtype=wp.int32),
        system_in: wp.array2d(dtype=real),
        gradient_in: wp.array2d(dtype=real),
        # Workspace out
        normal_out: wp.array2d(dtype=real),
        low_out: wp.array2d(dtype=real),
        high_out: wp.array2d(dtype=real),
    ):
        """The laws for the present labels as rows of the quadratic program, from row ``first`` on."""
        w = wp.tid()
        lanes = count_in.shape[2]
        pack = w // lanes
        lane = w % lanes
        contacts = count_in[pack, 0, lane]
        free = free_count_in[w, 0]
        for q in range(first, first + count):
            low_out[w, q] = -real(wp.static(FAR))
            high_out[w, q] = real(wp.static(FAR))
            for a in range(n):
                normal_out[w, q * n + a] = real(0.0)
        for k in range(rows):
            lower = real(lower_in[pack, passive_row[k], lane])
            upper = real(upper_in[pack, passive_row[k], lane])
            if label_in[w, k] != wp.static(RowLabel.FREE) and lower < upper:
                for a in range(n):
                    normal_out[w, (first + k) * n + a] = gradient_in[w, k * (n + 1) + a]
                gap = gradient_in[w, k * (n + 1) + n]
                if label_in[w, k] == wp.static(RowLabel.LOW):
                    low_out[w, first + k] = -gap
                else:
                    high_out[w, first + k] = -gap
        for c in range(contacts):
            q = first + rows + wp.static(CONTACT_LAWS) * c
            if label_in[w, rows + c] == wp.static(ContactLabel.OPEN):
                k = rows + 3 * c
                for a in range(n):
                    normal_out[w, q * n + a] = gradient_in[w, k * (n + 1) + a]
                low_out[w, q] = -gradient_in[w, k * (n + 1) + n]
        for f in range(free):
            k = free_in[w, f]
            response = f * width + free
            axis = (k - rows) % 3
            c = (k - rows) // 3
            q = first + k
            if k >= rows:
                q = first + rows + wp.static(CONTACT_LAWS) * c
            if k < rows or axis == 0:
                for a in range(n):
                    normal_out[w, q * n + a] = system_in[w, response + a]
                low_out[w, q] = -system_in[w, response + n]
                if k < rows:
                    low_out[w, q] += real(lower_in[pack, passive_row[k], lane])
                    high_out[w, q] = real(upper_in[pack, passive_row[k], lane]) - system_in[w, response + n]
            else:
                push = (f - axis) * width + free  # of the contact's normal force
                mu = real(mu_in[pack, c, lane])
                above = q + 2 * axis - 1
                for a in range(n):
                    normal_out[w, above * n + a] = system_in[w, response + a] - mu * system_in[w, push + a]
                    normal_out[w, (above + 1) * n + a] = system_in[w, response + a] + mu * system_in[w, push + a]
                high_out[w, above] = mu * system_in[w, push + n] - system_in[w, response + n]
                low_out[w, above + 1] = -mu * system_in[w, push + n] - system_in[w, response + n]

    @wp.kernel(module=module, enable_backward=False)
    def grip(
        n: int,
        rows: int,
        width: int,
        pair: int,
        least: real,
        most: real,
        row: int,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        pair_in: wp.array3d(dtype=wp.int32),
        free_in: wp.array2d(dtype=wp.int32),
        free_count_in: wp.array2d(dtype=wp.int32),
        system_in: wp.array2d(dtype=real),
        # Workspace out
        normal_out: wp.array2d(dtype=real),
        low_out: wp.array2d(dtype=real),
        high_out: wp.array2d(dtype=real),
    ):
        """The sum of a pair's normal forces as a row of the quadratic program, without bounds where nothing touches."""
        w = wp.tid()
        lanes = count_in.shape[2]
        free = free_count_in[w, 0]
        for a in range(n):
            normal_out[w, row * n + a] = real(0.0)
        known = real(0.0)
        touches = bool(False)
        for f in range(free):
            k = free_in[w, f] - rows
            if k >= 0 and k % 3 == 0:
                if pair_in[w // lanes, k // 3, w % lanes] == pair:
                    touches = True
                    known += system_in[w, f * width + free + n]
                    for a in range(n):
                        normal_out[w, row * n + a] += system_in[w, f * width + free + a]
        low_out[w, row] = wp.where(touches, least - known, -real(wp.static(FAR)))
        high_out[w, row] = wp.where(touches, most - known, real(wp.static(FAR)))

    return SimpleNamespace(
        free_rows=free_rows, eliminate=eliminate, respond=respond, inequalities=inequalities, grip=grip
    )
