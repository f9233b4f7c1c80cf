"""Newton's method on the laws of a world's rows and contacts, between sweeps on a CPU. Theory: docs/theory/coulomb.md.

A sweep tells which laws hold with equality. ``lead`` solves all of these together, goes as far as none of them ends,
changes the law that does, and so on; the next sweep judges where that leads, closes what has opened and frees what is
held in vain. Each world of a pack goes its own way, in scalars: the systems of eight worlds have little in common. The
function is C++ for the compiler's vector types.
"""

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

MOST = 144  # rows of a system up to which it is solved; sweeps over more of them cost less
SOON = 96  # rows up to which the first sweep is followed by it; of more, the acceleration may do without it
PATIENCE = 15  # sweeps that they wait
EVENTS = 8  # laws that end on the way from one sweep to the next
TRIES = 20  # ways that are gone before a world goes on with the acceleration
REST = 10  # sweeps with the acceleration before a world tries again
GROWN = 1000.0  # growth of the squared correction from which a way was wrong
HEAVY = 3.0  # extents of the scene by which no force needs to move what it acts on, if that were alone
LONGEST = 1000.0  # way, relative to the correction that it starts from
DAMPING = 1.0e-5  # of the system's diagonal, for rows that repeat each other
PIVOT = 1.0e-6  # least pivot, relative to the diagonal
LOOSE = 0.97  # of its cone, from where a contact that sticks may soon slide
ON_CONE = 1.0e-5  # relative distance from the cone within which a contact slides
AGAIN = 8  # sweeps until a world with too many rows asks again: some of them open

# What a world remembers, in rows of its own: whether Newton's method leads it, whether the acceleration's memory must
# be emptied (1) or its last guess was taken back (0.5), the least squared correction since it leads, ways gone, whether
# one waits for its judgement, sweeps until it leads again, and whether the acceleration has had its time.
LEADS, FRESH, BEST, TRIED, WAITS, LEFT, SPENT = range(7)
STATE = 7
VECTORS = 3  # of the history: change and multipliers at the end of the last accepted sweep, gaps

_CODE = """
#pragma clang fp contract(fast)
CONSTANTS
typedef REAL wide_t __attribute__((vector_size(64), may_alias));
#ifdef __AVX512F__
typedef wide_t part_t;  // what a register holds
#else
typedef REAL part_t __attribute__((vector_size(32), may_alias));
#endif
const int CHUNK = 64 / sizeof(REAL), WIDTH = MOST + 16, STRIDE = WIDTH / CHUNK;
const REAL ENDLESS = 1.0e30f;
const int total = rows + 3 * count, bounds = bounded.shape[0];
const REAL* const W = (const REAL*)&wp::index(delassus, w, 0);
const REAL* const free_gap = (const REAL*)&wp::index(gap, w, 0);
REAL* const moved = (REAL*)&wp::index(change, w, 0);
REAL* const row_value = multiplier.shape[1] ? (REAL*)&wp::index(multiplier, w, 0) : nullptr;
REAL* const contact_value = force.shape[1] ? (REAL*)&wp::index(force, w, 0) : nullptr;
REAL* const past = (REAL*)&wp::index(history, w, 0);
REAL* const state = (REAL*)&wp::index(memory, w, FIRST_STATE);
REAL on[LANES], led[LANES];
__builtin_memcpy(on, &active, sizeof(on));
bool is_measured = false;

#define AT(array, i) array[(long)(i) * LANES + lane]
#define ROW(array, i) ((const REAL*)&wp::index(array, w, i))[lane]
#define ENTRY(i, j) AT(W, (long)(i) * order + (j))
#define HISTORY(k, i) AT(past, (long)(k) * order + (i))
#define VALUE(i) (*((i) < rows ? &AT(row_value, i) : &AT(contact_value, (i) - rows)))
#define END(i) HISTORY(FIRST_VECTOR, i)
#define KEPT(i) HISTORY(FIRST_VECTOR + 1, i)
#define GAP(i) HISTORY(FIRST_VECTOR + 2, i)
#define SIZE(a) ((a) < 0 ? -(a) : (a))

enum { FIXED, LOW, HIGH, FREE, OPEN, BARE, STICK, SLIDE };  // laws of rows, then of contacts
enum { PLAIN, ALONG, ACROSS };  // unknowns: one row; what presses and rubs along a slip; what turns it
for (int lane = 0; lane < LANES; ++lane) {
    led[lane] = 0;
    if (on[lane] <= 0) continue;
    REAL& leads = AT(state, LEADS);
    REAL& best = AT(state, BEST);
    if (leads == 0) {
        AT(state, LEFT) -= 1;
        if (AT(state, LEFT) > 0) continue;
        leads = 1; best = ENDLESS; AT(state, TRIED) = 0; AT(state, WAITS) = 0;
    }
    led[lane] = 1;
    REAL square = 0;
    for (int i = 0; i < total; ++i) {
        const REAL f = AT(moved, i) - HISTORY(0, i);
        square += f * f * ENTRY(i, i);
    }
    const bool is_wrong = AT(state, WAITS) > 0 && !(square <= GROWN * best);
    AT(state, WAITS) = 0;
    for (int i = 0; i < total; ++i)
        if (is_wrong) { AT(moved, i) = END(i); VALUE(i) = KEPT(i); }
        else { END(i) = AT(moved, i); KEPT(i) = VALUE(i); }
    if (is_last) continue;
    if (is_wrong || AT(state, TRIED) >= TRIES) {
        leads = 0; AT(state, LEFT) = REST; AT(state, FRESH) = 1;
        continue;
    }
    best = square < best ? square : best;
    ++AT(state, TRIED);
    if (!is_measured) {
        is_measured = true;
        MEASURE
    }

    // Rows and contacts whose laws hold with equality, and their size numbers at[] in W, three of a contact that rubs.
    int laws = 0, size = 0, law[MOST], first[MOST], span[MOST], place[MOST], at[MOST];
    REAL value[WIDTH], slack[WIDTH], soft[MOST], mu_[MOST];  // slack: gaps
    for (int b = 0; b < bounds && size <= MOST; ++b) {
        const int i = bounded.data[b];
        const REAL hard = ENTRY(i, i), old = AT(row_value, i), g = GAP(i), low = ROW(lower, i), high = ROW(upper, i);
        if (!(hard > 0)) continue;
        const REAL wanted = old - (g + ROW(compliance, i) * old) / (hard + ROW(compliance, i));
        const REAL bound = wanted < low ? low : wanted > high ? high : wanted;
        const bool is_low = bound < old + (ROW(floor, i) - g) / hard;
        const bool is_high = !is_low && bound > old + (ROW(ceiling, i) - g) / hard;
        if (!is_low && !is_high && (wanted <= low || wanted >= high)) continue;
        if (size == MOST) { size = MOST + 1; break; }
        law[laws] = is_low ? LOW : is_high ? HIGH : FREE;
        place[laws] = i; first[laws] = size; span[laws] = 1; soft[laws++] = is_low || is_high ? 0 : ROW(compliance, i);
        at[size++] = i;
    }
    for (int contact = 0; contact < count && size <= MOST; ++contact) {
        const int i = rows + 3 * contact;
        if (!(AT(contact_value, 3 * contact) > 0) || !(ENTRY(i, i) > 0)) continue;
        const bool is_bare = !(ROW(mu, contact) > 0) || !(ENTRY(i + 1, i + 1) + ENTRY(i + 2, i + 2) > 0);
        const int axes = is_bare ? 1 : 3;
        if (size + axes > MOST) { size = MOST + 1; break; }
        soft[laws] = ROW(softness, contact); mu_[laws] = ROW(mu, contact);
        law[laws] = is_bare ? BARE : STICK;
        place[laws] = i; first[laws] = size; span[laws++] = axes;
        for (int axis = 0; axis < axes; ++axis) at[size++] = i + axis;
    }
    if (size > MOST) {
        leads = 0; AT(state, LEFT) = AGAIN; led[lane] = 0;
        if (AT(state, TRIED) > 1) AT(state, FRESH) = 1;  // else the acceleration goes on as if not asked
        continue;
    }
    if (size == 0) continue;
    if (size > SOON && AT(state, SPENT) == 0) {
        leads = 0; AT(state, LEFT) = PATIENCE; AT(state, FRESH) = 1; AT(state, SPENT) = 1; led[lane] = 0;
        continue;
    }

    REAL near[MOST * WIDTH] __attribute__((aligned(64))), system[MOST * WIDTH] __attribute__((aligned(64)));
    REAL whole[MOST * WIDTH] __attribute__((aligned(64)));
    const int chunks = (size + CHUNK - 1) / CHUNK;
    for (int p = 0; p < size; ++p) {
        for (int q = 0; q <= p; ++q) near[p * WIDTH + q] = near[q * WIDTH + p] = ENTRY(at[p], at[q]);
        for (int q = size; q < chunks * CHUNK; ++q) near[p * WIDTH + q] = 0;
        value[p] = VALUE(at[p]); slack[p] = GAP(at[p]);
    }

    // Laws that may change soon stand last. The others are eliminated once, from rows of all.
    bool is_loose[MOST], is_parted = false;
    for (int l = 0; l < laws; ++l) {
        const REAL* const t = value + first[l];
        const REAL bound = LOOSE * mu_[l] * t[0];
        is_loose[l] = law[l] == STICK && !(t[1] * t[1] + t[2] * t[2] < bound * bound);
    }
    int who[MOST], rank[MOST], settled = 0;  // size numbers in the order of elimination, and the first of each law
    REAL inverse[MOST];  // one over each pivot

    bool is_lost = false;
    for (int event = 0; event < EVENTS; ++event) {
        int unknowns = 0, plain = 0, kind[MOST], of[MOST], number[MOST], seat[MOST];
        REAL n1[MOST], n2[MOST], extra[MOST];  // by law, but for the last
        REAL goal[WIDTH] __attribute__((aligned(64)));
        for (int l = 0; l < laws; ++l) {
            const int p = first[l];
            const REAL press = value[p];
            goal[p] = -(slack[p] + soft[l] * press);
            if (law[l] == LOW) goal[p] += ROW(floor, place[l]);
            if (law[l] == HIGH) goal[p] += ROW(ceiling, place[l]);
            if (span[l] == 3) {
                goal[p + 1] = -slack[p + 1]; goal[p + 2] = -slack[p + 2];
                const REAL t1 = value[p + 1], t2 = value[p + 2], length = __builtin_sqrt(t1 * t1 + t2 * t2);
                const bool touches = length > 0 && length >= mu_[l] * press * (1 - ON_CONE);
                if (law[l] == STICK && touches) law[l] = SLIDE;
                if (law[l] == SLIDE && !(length > 0)) law[l] = STICK;
                if (law[l] == SLIDE) { n1[l] = t1 / length; n2[l] = t2 / length; }
            }
            const bool has_end = law[l] == FIXED || law[l] == OPEN || law[l] == SLIDE;
            if (has_end && !is_loose[l]) { is_loose[l] = true; is_parted = false; }
        }
        for (int sliding = 0; sliding < 2; ++sliding) {
            for (int l = 0; l < laws; ++l) {
                if (!is_loose[l] || law[l] == FIXED || law[l] == OPEN || (law[l] == SLIDE) != (sliding > 0)) continue;
                const int p = first[l], axes = law[l] == STICK ? 3 : law[l] == SLIDE ? 2 : 1;
                for (int axis = 0; axis < axes; ++axis) {
                    kind[unknowns] = law[l] != SLIDE ? PLAIN : axis == 0 ? ALONG : ACROSS;
                    of[unknowns] = l; number[unknowns] = p + (law[l] == SLIDE ? 0 : axis);
                    extra[unknowns++] = axis == 0 ? soft[l] : 0;
                }
                if (law[l] != SLIDE) continue;
                const REAL slip = slack[p + 1] * n1[l] + slack[p + 2] * n2[l];
                extra[unknowns - 1] = SIZE(slip) / (n1[l] * value[p + 1] + n2[l] * value[p + 2]);
            }
            if (sliding == 0) plain = unknowns;
        }

        if (!is_parted) {
            is_parted = true;
            int n = 0;
            REAL least[MOST];
            for (int loose = 0; loose < 2; ++loose) {
                for (int l = 0; l < laws; ++l) {
                    if (is_loose[l] != (loose > 0)) continue;
                    rank[l] = n;
                    for (int axis = 0; axis < span[l]; ++axis) {
                        least[n] = axis == 0 ? soft[l] : 0;
                        who[n++] = first[l] + axis;
                    }
                }
                if (loose == 0) settled = n;
            }
            for (int i = 0; i < size; ++i) {
                const REAL* const from = near + who[i] * WIDTH;
                REAL* const line = whole + i * WIDTH;
                for (int j = i / CHUNK * CHUNK; j < size; ++j) line[j] = from[who[j]];
                for (int j = size; j < chunks * CHUNK; ++j) line[j] = 0;
                if (i < settled) line[i] = line[i] * (1 + DAMPING) + least[i];
                least[i] = PIVOT * SIZE(line[i]);
            }
            for (int k = 0; k < settled; k += 4) {  // four rows at a time, on two below, of which the right half counts
                const int block = settled - k < 4 ? settled - k : 4;
                const REAL* const top = whole + k * WIDTH;
                for (int r = k; r < k + block; ++r) {
                    wide_t* const line = (wide_t*)(whole + r * WIDTH);
                    for (int m = 0; m < r - k; ++m) {
                        const REAL factor = top[m * WIDTH + r] * inverse[k + m];
                        const wide_t* const above = (const wide_t*)(top + m * WIDTH);
                        for (int chunk = r / CHUNK; chunk < chunks; ++chunk) line[chunk] -= above[chunk] * factor;
                    }
                    for (int j = r / CHUNK * CHUNK; j < r; ++j) whole[r * WIDTH + j] = 0;
                    inverse[r] = SIZE(whole[r * WIDTH + r]) > least[r] ? 1 / whole[r * WIDTH + r] : 0;
                }
                for (int r = k + block; r < size; r += 2) {
                    const int other = r + 1 < size ? r + 1 : r;
                    part_t* const one = (part_t*)(whole + r * WIDTH);
                    part_t* const two = (part_t*)(whole + other * WIDTH);
                    const part_t* const above = (const part_t*)top;
                    const int parts = CHUNK * sizeof(REAL) / sizeof(part_t), stride = parts * STRIDE;
                    REAL a[4] = {}, b[4] = {};
                    for (int m = 0; m < block; ++m) {
                        a[m] = top[m * WIDTH + r] * inverse[k + m];
                        b[m] = top[m * WIDTH + other] * inverse[k + m];
                    }
                    const int begin = r * sizeof(REAL) / sizeof(part_t);
                    for (int part = begin; part < parts * chunks; ++part) {
                        const part_t t0 = above[part], t1 = block > 1 ? above[part + stride] : t0;
                        const part_t t2 = block > 2 ? above[part + 2 * stride] : t0;
                        const part_t t3 = block > 3 ? above[part + 3 * stride] : t0;
                        const part_t first = one[part] - ((t0 * a[0] + t1 * a[1]) + (t2 * a[2] + t3 * a[3]));
                        two[part] -= (t0 * b[0] + t1 * b[1]) + (t2 * b[2] + t3 * b[3]);
                        one[part] = first;
                    }
                }
            }
            for (int i = settled; i < size; ++i)
                for (int j = settled; j < i; ++j) whole[i * WIDTH + j] = whole[j * WIDTH + i];
        }
        if (unknowns + settled == 0) break;

        REAL z[WIDTH] __attribute__((aligned(64))) = {};
        for (int i = 0; i < size; ++i) z[i] = goal[who[i]];
        for (int k = 0; k < settled; ++k) {
            const REAL factor = z[k] * inverse[k];
            const REAL* const above = whole + k * WIDTH;
            const REAL own = z[k];
            for (int chunk = k / CHUNK; chunk < chunks; ++chunk)
                ((wide_t*)z)[chunk] -= ((const wide_t*)above)[chunk] * factor;
            z[k] = own;
        }

        REAL x[MOST], least[MOST], line_[WIDTH] __attribute__((aligned(64)));
        for (int u = 0; u < unknowns; ++u) seat[u] = rank[of[u]] + number[u] - first[of[u]];
        for (int u = 0; u < unknowns; ++u) {
            REAL* const line = system + u * WIDTH;
            const int l = of[u], here = seat[u];
            const REAL* from = whole + here * WIDTH;
            const REAL* const own = near + number[u] * WIDTH + first[l];
            REAL hard = near[number[u] * WIDTH + number[u]], right = z[here];
            if (kind[u] == ALONG) hard = own[0] + mu_[l] * (n1[l] * own[1] + n2[l] * own[2]);
            if (kind[u] == ACROSS) {
                const REAL c1 = -n2[l], c2 = n1[l];
                for (int chunk = settled / CHUNK; chunk < chunks; ++chunk)
                    ((wide_t*)line_)[chunk] = ((const wide_t*)(from + WIDTH))[chunk] * c1
                                            + ((const wide_t*)(from + 2 * WIDTH))[chunk] * c2;
                from = line_;
                hard = c1 * (c1 * own[WIDTH + 1] + c2 * own[WIDTH + 2])
                     + c2 * (c1 * own[2 * WIDTH + 1] + c2 * own[2 * WIDTH + 2]);
                right = c1 * z[here + 1] + c2 * z[here + 2];
            }
            for (int v = 0; v < plain; ++v) line[v] = from[seat[v]];
            for (int v = plain; v < unknowns; v += 2) {
                const REAL* const a = from + seat[v];
                const int m = of[v];
                line[v] = a[0] + mu_[m] * (n1[m] * a[1] + n2[m] * a[2]);
                line[v + 1] = n1[m] * a[2] - n2[m] * a[1];
            }
            line[u] += hard * DAMPING + extra[u];
            least[u] = PIVOT * SIZE(hard * (1 + DAMPING) + extra[u]);
            line[unknowns] = right;
            for (int v = unknowns + 1; v % CHUNK; ++v) line[v] = 0;
        }
        const int end = (unknowns + CHUNK) / CHUNK;
        for (int k = 0; k < unknowns; k += 4) {  // four rows at a time, on two below: each is loaded once
            const int block = unknowns - k < 4 ? unknowns - k : 4, skipped = k / CHUNK;
            const wide_t* const top = (const wide_t*)(system + k * WIDTH);
            const auto factors = [&](int r, int before, REAL* factor) {
                for (int m = 0; m < before; ++m) {
                    REAL entry = system[r * WIDTH + k + m];
                    for (int j = 0; j < m; ++j) entry -= factor[j] * system[(k + j) * WIDTH + k + m];
                    factor[m] = entry * x[k + m];
                }
            };
            for (int r = k; r < k + block; ++r) {
                REAL* const line = system + r * WIDTH;
                REAL factor[4];
                factors(r, r - k, factor);
                for (int m = 0; m < r - k; ++m)
                    for (int chunk = skipped; chunk < end; ++chunk)
                        ((wide_t*)line)[chunk] -= top[chunk + m * STRIDE] * factor[m];
                x[r] = SIZE(line[r]) > least[r] ? 1 / line[r] : 0;
            }
            for (int r = k + block; r < unknowns; r += 2) {
                const int other = r + 1 < unknowns ? r + 1 : r;
                part_t* const one = (part_t*)(system + r * WIDTH);
                part_t* const two = (part_t*)(system + other * WIDTH);
                const part_t* const above = (const part_t*)top;
                const int parts = sizeof(wide_t) / sizeof(part_t), stride = parts * STRIDE;
                REAL a[4], b[4];
                factors(r, 4, a);
                factors(other, 4, b);
                for (int part = parts * skipped; part < parts * end; ++part) {
                    const part_t t0 = above[part], t1 = above[part + stride];
                    const part_t t2 = above[part + 2 * stride], t3 = above[part + 3 * stride];
                    const part_t first = one[part] - ((t0 * a[0] + t1 * a[1]) + (t2 * a[2] + t3 * a[3]));
                    two[part] -= (t0 * b[0] + t1 * b[1]) + (t2 * b[2] + t3 * b[3]);
                    one[part] = first;
                }
            }
        }
        REAL sum = 0, step[WIDTH] = {};
        for (int i = settled; i < size; ++i) z[i] = 0;
        for (int k = unknowns - 1; k >= 0; --k) {
            x[k] *= system[k * WIDTH + unknowns];
            for (int r = 0; r < k; ++r) system[r * WIDTH + unknowns] -= system[r * WIDTH + k] * x[k];
            sum += x[k];
            const int l = of[k], q = seat[k];
            if (kind[k] == PLAIN) { z[q] += x[k]; continue; }
            const REAL c1 = kind[k] == ALONG ? mu_[l] * n1[l] : -n2[l], c2 = kind[k] == ALONG ? mu_[l] * n2[l] : n1[l];
            z[q] += kind[k] == ALONG ? x[k] : 0; z[q + 1] += c1 * x[k]; z[q + 2] += c2 * x[k];
        }
        for (int k = settled - 1; k >= 0; --k) {
            wide_t sums = {};
            REAL rest = z[k];
            z[k] = 0;
            for (int chunk = k / CHUNK; chunk < chunks; ++chunk)
                sums += ((const wide_t*)(whole + k * WIDTH))[chunk] * ((const wide_t*)z)[chunk];
            for (int i = 0; i < CHUNK; ++i) rest -= sums[i];
            z[k] = rest * inverse[k];
            sum += z[k];
        }
        for (int i = 0; i < size; ++i) step[who[i]] = z[i];
        is_lost = !(sum < ENDLESS && sum > -ENDLESS);
        if (is_lost) break;

        // The first law that ends on the way, and which one takes its place.
        REAL way = 1;
        int ends = -1, next = FIXED;
        for (int l = 0; l < laws; ++l) {
            const int p = first[l];
            const REAL s0 = step[p];
            if (law[l] == FREE && s0 != 0) {
                const REAL bound = s0 > 0 ? ROW(upper, place[l]) : ROW(lower, place[l]);
                const REAL limit = (bound - value[p]) / s0;
                if (limit < way) { way = limit > 0 ? limit : 0; ends = l; next = FIXED; }
            }
            if (law[l] <= OPEN) continue;
            if (s0 < 0 && value[p] < -way * s0) { way = -value[p] / s0; ends = l; next = OPEN; }
            if (law[l] != STICK) continue;
            const REAL s1 = step[p + 1], s2 = step[p + 2], t0 = mu_[l] * value[p], t1 = value[p + 1], t2 = value[p + 2];
            const REAL m0 = mu_[l] * s0, a = s1 * s1 + s2 * s2 - m0 * m0, b = t1 * s1 + t2 * s2 - t0 * m0;
            // |t|^2 - (mu n)^2 = a way^2 + 2 b way - c
            const REAL c = t0 * t0 - t1 * t1 - t2 * t2, root = b * b + a * c;
            const REAL under = root > 0 ? b + __builtin_sqrt(root) : 0;
            if (under > 0 && c < way * under) { way = c > 0 ? c / under : 0; ends = l; next = SLIDE; }
        }
        for (int l = 0; l < laws; ++l) {
            const int p = first[l];
            const REAL old = value[p];
            value[p] += way * step[p];
            if (l == ends && next == FIXED) value[p] = step[p] > 0 ? ROW(upper, place[l]) : ROW(lower, place[l]);
            if (law[l] < OPEN) { step[p] = value[p] - old; continue; }
            if ((l == ends && next == OPEN) || value[p] < 0) { value[p] = 0; law[l] = OPEN; }
            step[p] = value[p] - old;
            if (span[l] == 1) continue;
            const REAL t1 = value[p + 1] + way * step[p + 1], t2 = value[p + 2] + way * step[p + 2];
            const REAL length = __builtin_sqrt(t1 * t1 + t2 * t2), radius = mu_[l] * value[p];
            const REAL shrink = length > radius ? radius / length : 1;
            step[p + 1] = t1 * shrink - value[p + 1]; step[p + 2] = t2 * shrink - value[p + 2];
            value[p + 1] = t1 * shrink; value[p + 2] = t2 * shrink;
        }
        if (ends < 0) break;
        law[ends] = next;
        wide_t sums[MOST / CHUNK + 1];
        for (int chunk = 0; chunk < chunks; ++chunk) __builtin_memcpy(&sums[chunk], slack + chunk * CHUNK, 64);
        for (int q = 0; q < size; ++q)
            for (int chunk = 0; chunk < chunks; ++chunk)
                sums[chunk] += ((const wide_t*)(near + q * WIDTH))[chunk] * step[q];
        __builtin_memcpy(slack, sums, 64 * chunks);
    }
    if (is_lost) {
        leads = 0; AT(state, LEFT) = REST; AT(state, FRESH) = 1;
        continue;
    }
    REAL length = 0, heaviest = 0;
    for (int p = 0; p < size; ++p) {
        const REAL far = value[p] - VALUE(at[p]);
        length += far * far * near[p * WIDTH + p];
        const REAL load = SIZE(value[p]) * near[p * WIDTH + p];
        heaviest = load > heaviest ? load : heaviest;
    }
    if (!(heaviest <= HEAVY * extent)) {
        leads = 0; AT(state, LEFT) = REST; AT(state, FRESH) = 1;
        continue;
    }
    const REAL share = length > LONGEST * LONGEST * square ? LONGEST * __builtin_sqrt(square / length) : 1;
    for (int p = 0; p < size; ++p) {
        const REAL far = share * (value[p] - VALUE(at[p]));
        AT(moved, at[p]) += far;
        VALUE(at[p]) += far;
    }
    AT(state, WAITS) = 1;
}
#undef AT
#undef ROW
#undef ENTRY
#undef HISTORY
#undef VALUE
#undef END
#undef KEPT
#undef GAP
#undef SIZE
RETURN
"""

# Gaps of rows whose laws may hold, of all worlds of a pack at once, or along the rows of one world.
_MEASURE_PACK = """
            typedef float lane_t __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
            const lane_t* const d = (const lane_t*)moved;
            for (int i = 0; i < total; ++i) {
                bool is_open = i >= rows;
                for (int k = 0; k < LANES && is_open; ++k)
                    is_open = !(contact_value[(long)((i - rows) / 3 * 3) * LANES + k] > 0);
                if (is_open) continue;
                const lane_t* const line = (const lane_t*)W + (long)i * order;
                lane_t s = ((const lane_t*)free_gap)[i], t = {};
                int j = 0;
                for (; j + 1 < total; j += 2) { s += line[j] * d[j]; t += line[j + 1] * d[j + 1]; }
                if (j < total) s += line[j] * d[j];
                ((lane_t*)past)[(long)(FIRST_VECTOR + 2) * order + i] = s + t;
            }
"""
_MEASURE_ONE = """
            for (int i = 0; i < total; ++i) {
                if (i >= rows && !(contact_value[(i - rows) / 3 * 3] > 0)) continue;
                const REAL* const line = W + (long)i * order;
                wide_t sum = {}, a, b;
                REAL s = free_gap[i];
                int j = 0;
                for (; j + CHUNK <= total; j += CHUNK) {
                    __builtin_memcpy(&a, line + j, sizeof(a));
                    __builtin_memcpy(&b, moved + j, sizeof(b));
                    sum += a * b;
                }
                for (; j < total; ++j) s += line[j] * moved[j];
                for (int k = 0; k < CHUNK; ++k) s += sum[k];
                GAP(i) = s;
            }
"""


def _constants(lanes: int, first_state: int, first_vector: int) -> str:
    """Declarations of the constants of this file."""
    names = (
        "MOST",
        "SOON",
        "PATIENCE",
        "EVENTS",
        "TRIES",
        "REST",
        "GROWN",
        "HEAVY",
        "LONGEST",
        "DAMPING",
        "PIVOT",
        "LOOSE",
        "ON_CONE",
        "AGAIN",
    )
    names += "LEADS", "FRESH", "BEST", "TRIED", "WAITS", "LEFT", "SPENT"
    values = {name: globals()[name] for name in names}
    values |= {"LANES": lanes, "FIRST_STATE": first_state, "FIRST_VECTOR": first_vector}
    return "".join(
        f"const {'int' if isinstance(value, int) else 'REAL'} {name} = {value};\n" for name, value in values.items()
    )


def lead(variant: Variant, first_state: int, first_vector: int) -> wp.Function:
    """What follows a sweep where Newton's method leads, for one scalar type on a CPU.

    Args:
        variant: Scalar type.
        first_state: First of the rows of ``memory`` that are Newton's.
        first_vector: First of its vectors of ``history``.
    """
    S, lanes = variant.S, variant.lanes
    is_pack = lanes > 1
    code = _CODE.replace("MEASURE", _MEASURE_PACK if is_pack else _MEASURE_ONE)
    result = "wp::vec_t<8, wp::float32> result;\n__builtin_memcpy(&result, led, sizeof(led));\nreturn result;"
    code = code.replace("RETURN", result if is_pack else "return led[0];")
    code = code.replace("CONSTANTS", _constants(lanes, first_state, first_vector))

    @wp.func_native(code.replace("REAL", "double" if variant.real is wp.float64 else "float"))
    def lead_worlds(
        delassus: wp.array2d(dtype=S),
        gap: wp.array2d(dtype=S),
        compliance: wp.array2d(dtype=S),
        lower: wp.array2d(dtype=S),
        upper: wp.array2d(dtype=S),
        floor: wp.array2d(dtype=S),
        ceiling: wp.array2d(dtype=S),
        mu: wp.array2d(dtype=S),
        softness: wp.array2d(dtype=S),
        bounded: wp.array(dtype=wp.int32),
        multiplier: wp.array2d(dtype=S),
        force: wp.array2d(dtype=S),
        change: wp.array2d(dtype=S),
        history: wp.array2d(dtype=S),
        memory: wp.array2d(dtype=S),
        w: int,
        rows: int,
        order: int,
        count: int,
        is_last: bool,
        extent: variant.real,
        active: S,
    ) -> S:
        """Judge the last way and go the next one; 1 for worlds that it leads, 0 for those of the acceleration."""

    return lead_worlds
