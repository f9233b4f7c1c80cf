"""Labels of the rows that obey a law in inverse control: found, and changed. Theory: docs/theory/laws.md.

A *free* row's multiplier closes its gap (plus compliance times multiplier); others keep theirs at a bound, while their
gap has the sign that it allows. A contact is *open*, *sticks* (its three rows are free) or *slides* (its friction is mu
times the normal force, in a direction that is kept). A label is changed where its inequality holds the solution back
and the other piece is better (Coevoet, Escande, Duriez 2017).
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.codes import FAR, ContactLabel, RowLabel

CONTACT_LAWS = 5  # inequalities of a contact: normal, and two for each tangent
NO_SLIP = 1.0e-9  # m
BETTER = 1.0e-6  # part of the objective by which a change of labels has to lower it


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels that read a shard's workspace and write double precision; one thread per world."""
    real = wp.float64
    narrow = variant.real
    module = variant.module("labels")

    @wp.func
    def matrix_row(item: int, rows: int, first_contact: int, passive_row: wp.array(dtype=wp.int32)):
        """Row of W of an item: static rows with a law first, then three for each contact."""
        row = first_contact + item - rows
        if item < rows:
            row = passive_row[item]
        return row

    @wp.func
    def clamp_disc(a: real, b: real, radius: real):
        """Nearest point of a disc."""
        length = wp.sqrt(a * a + b * b)
        factor = real(1.0)
        if length > radius:
            factor = radius / wp.max(length, real(1.0e-300))
        return a * factor, b * factor

    @wp.kernel(module=module, enable_backward=False)
    def present_labels(
        rows: int,
        first_contact: int,
        order: int,
        sweeps: int,
        # Model
        passive_row: wp.array(dtype=wp.int32),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        matrix_in: wp.array3d(dtype=narrow),
        free_gap_in: wp.array3d(dtype=narrow),
        multiplier_in: wp.array3d(dtype=narrow),
        contact_multiplier_in: wp.array3d(dtype=narrow),
        lower_in: wp.array3d(dtype=narrow),
        upper_in: wp.array3d(dtype=narrow),
        compliance_in: wp.array3d(dtype=narrow),
        softness_in: wp.array3d(dtype=narrow),
        mu_in: wp.array3d(dtype=narrow),
        # Workspace out
        start_out: wp.array2d(dtype=real),
        value_out: wp.array2d(dtype=real),
        label_out: wp.array2d(dtype=wp.int32),
        direction_out: wp.array2d(dtype=real),
    ):
        """Labels that the laws have under the present efforts, by sweeps of projected Gauss-Seidel."""
        w = wp.tid()
        lanes = matrix_in.shape[2]
        pack = w // lanes
        lane = w % lanes
        contacts = count_in[pack, 0, lane]
        total = rows + 3 * contacts
        for k in range(total):
            if k < rows:
                start_out[w, k] = real(multiplier_in[pack, passive_row[k], lane])
            else:
                start_out[w, k] = real(contact_multiplier_in[pack, k - rows, lane])
            value_out[w, k] = start_out[w, k]
        for _sweep in range(sweeps):
            for k in range(total):
                i = matrix_row(k, rows, first_contact, passive_row)
                gap = real(free_gap_in[pack, i, lane])
                for j in range(total):
                    column = matrix_row(j, rows, first_contact, passive_row)
                    gap += real(matrix_in[pack, i * order + column, lane]) * (value_out[w, j] - start_out[w, j])
                diagonal = real(matrix_in[pack, i * order + i, lane]) + real(1.0e-30)
                low = -real(wp.static(FAR))
                high = real(wp.static(FAR))
                soft = real(0.0)
                axis = (k - rows) % 3
                contact = (k - rows) // 3
                if k < rows:
                    low = real(lower_in[pack, i, lane])
                    high = real(upper_in[pack, i, lane])
                    soft = real(compliance_in[pack, i, lane])
                elif axis == 0:
                    low = real(0.0)
                    soft = real(softness_in[pack, contact, lane])
                step = (gap + soft * value_out[w, k]) / (diagonal + soft)
                value_out[w, k] = wp.clamp(value_out[w, k] - step, low, high)
                if k >= rows and axis == 2:
                    radius = real(mu_in[pack, contact, lane]) * value_out[w, k - 2]
                    a, b = clamp_disc(value_out[w, k - 1], value_out[w, k], radius)
                    value_out[w, k - 1] = a
                    value_out[w, k] = b
        for k in range(rows):
            i = passive_row[k]
            label = int(wp.static(RowLabel.FREE))
            if value_out[w, k] <= real(lower_in[pack, i, lane]):
                label = int(wp.static(RowLabel.LOW))
            elif value_out[w, k] >= real(upper_in[pack, i, lane]):
                label = int(wp.static(RowLabel.HIGH))
            label_out[w, k] = label
        for c in range(contacts):
            k = rows + 3 * c
            a = value_out[w, k + 1]
            b = value_out[w, k + 2]
            size = wp.sqrt(a * a + b * b)
            radius = real(mu_in[pack, c, lane]) * value_out[w, k]
            label = int(wp.static(ContactLabel.STICK))
            if value_out[w, k] <= real(0.0):
                label = int(wp.static(ContactLabel.OPEN))
            elif size >= radius * real(1.0 - 1.0e-9):
                label = int(wp.static(ContactLabel.SLIDE))
            label_out[w, rows + c] = label
            direction_out[w, 2 * c] = a / wp.max(size, real(1.0e-300))
            direction_out[w, 2 * c + 1] = b / wp.max(size, real(1.0e-300))

    @wp.func
    def slip(n: int, item: int, gradient: wp.array2d(dtype=real), x: wp.array2d(dtype=real), w: int):
        """Gap of an item under the efforts x."""
        total = gradient[w, item * (n + 1) + n]
        for a in range(n):
            total += gradient[w, item * (n + 1) + a] * x[w, a]
        return total

    @wp.func
    def flip(
        q: int,
        held: real,
        n: int,
        rows: int,
        gradient: wp.array2d(dtype=real),
        x: wp.array2d(dtype=real),
        label: wp.array2d(dtype=wp.int32),
        direction: wp.array2d(dtype=real),
        w: int,
    ):
        """Move the label whose inequality q holds the solution back to the neighbouring piece.

        A contact that closes has slipped: it slides on, and friction will hold against the slip.
        """
        if q < rows:
            side = int(wp.static(RowLabel.HIGH))
            if held > real(0.0):
                side = int(wp.static(RowLabel.LOW))
            if label[w, q] != wp.static(RowLabel.FREE):
                side = int(wp.static(RowLabel.FREE))
            label[w, q] = side
        else:
            c = (q - rows) // wp.static(CONTACT_LAWS)
            law = (q - rows) % wp.static(CONTACT_LAWS)
            side = int(wp.static(ContactLabel.OPEN))
            if law > 0:
                side = int(wp.static(ContactLabel.SLIDE))
                sign = real(1.0)
                if law % 2 == 0:
                    sign = real(-1.0)
                direction[w, 2 * c] = wp.where(law < 3, sign, real(0.0))
                direction[w, 2 * c + 1] = wp.where(law < 3, real(0.0), sign)
            elif label[w, rows + c] == wp.static(ContactLabel.OPEN):
                side = int(wp.static(ContactLabel.SLIDE))
                a = slip(n, rows + 3 * c + 1, gradient, x, w)
                b = slip(n, rows + 3 * c + 2, gradient, x, w)
                size = wp.sqrt(a * a + b * b)
                if size <= real(wp.static(NO_SLIP)):
                    side = int(wp.static(ContactLabel.STICK))
                direction[w, 2 * c] = -a / wp.max(size, real(1.0e-300))
                direction[w, 2 * c + 1] = -b / wp.max(size, real(1.0e-300))
            label[w, rows + c] = side

    @wp.kernel(module=module, enable_backward=False)
    def pivot(
        n: int,
        rows: int,
        first: int,
        count: int,
        effector_rows: int,
        is_first: bool,
        is_last: bool,
        # Model
        effector_weight: wp.array(dtype=real),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        outcome_in: wp.array2d(dtype=wp.int32),
        multiplier_in: wp.array2d(dtype=real),
        effect_in: wp.array2d(dtype=real),
        gap_in: wp.array2d(dtype=real),
        gradient_in: wp.array2d(dtype=real),
        x_in: wp.array2d(dtype=real),
        # Workspace out
        label_out: wp.array2d(dtype=wp.int32),
        direction_out: wp.array2d(dtype=real),
        best_out: wp.array2d(dtype=real),
        best_label_out: wp.array2d(dtype=wp.int32),
        best_direction_out: wp.array2d(dtype=real),
        best_multiplier_out: wp.array2d(dtype=real),
        best_gradient_out: wp.array2d(dtype=real),
        best_x_out: wp.array2d(dtype=real),
        tried_out: wp.array2d(dtype=wp.int32),
    ):
        """Keep the better labels, and change one of those that hold the solution back; the last call only keeps."""
        w = wp.tid()
        lanes = count_in.shape[2]
        contacts = count_in[w // lanes, 0, w % lanes]
        value = real(0.0)
        for e in range(effector_rows):
            gap = gap_in[w, e] + gap_in[w, effector_rows + e]
            for a in range(n):
                gap += effect_in[w, e * n + a] * x_in[w, a]
            value += effector_weight[e] * effector_weight[e] * gap * gap
        is_better = outcome_in[w, 0] == 0 and value < best_out[w, 0] * real(1.0 - BETTER) - real(1.0e-18)
        if is_first or is_better:
            best_out[w, 0] = value
            for k in range(rows + contacts):
                best_label_out[w, k] = label_out[w, k]
            for k in range(2 * contacts):
                best_direction_out[w, k] = direction_out[w, k]
            for k in range((rows + 3 * contacts) * (n + 1)):
                best_gradient_out[w, k] = gradient_in[w, k]
            for a in range(n):
                best_x_out[w, a] = x_in[w, a]
            for q in range(count):
                best_multiplier_out[w, q] = multiplier_in[w, first + q]
                tried_out[w, q] = 0
        else:
            for k in range(rows + contacts):
                label_out[w, k] = best_label_out[w, k]
            for k in range(2 * contacts):
                direction_out[w, k] = best_direction_out[w, k]
        chosen = int(-1)
        largest = real(0.0)
        for q in range(count):
            held = wp.abs(best_multiplier_out[w, q])
            if tried_out[w, q] == 0 and held > largest:
                largest = held
                chosen = q
        if chosen >= 0 and not is_last:
            tried_out[w, chosen] = 1
            held = best_multiplier_out[w, chosen]
            flip(chosen, held, n, rows, best_gradient_out, best_x_out, label_out, direction_out, w)

    return SimpleNamespace(matrix_row=matrix_row, present_labels=present_labels, pivot=pivot)
