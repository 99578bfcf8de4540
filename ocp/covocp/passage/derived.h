/* The derivatives of a function of scalars as it is told, as functions of scalars again: along a direction, and back from
 * weights of its results. Each operation has a rule, which is CasADi's. What is not needed is left out, and registers are
 * used again after the last operation that asks for what they hold; what has more operations than there is room for is none.
 */

/* Zero, one and minus one where a value stands; most results of one operation: partial derivatives and their products. */
enum { NONE = -1, ONE = -2, MINUS = -3, CONSTANTS = 16 };

/* Values one after the other: kind, what they are made of (of an input its argument and the place there). */
typedef struct {
    int count, most, full;
    int *kind, *one, *two;
    double *constant;
    int constants, known[CONSTANTS];
} Values;

static int value(Values *v, int kind, int one, int two, double constant) {
    if (v->count == v->most) v->full = 1;
    const int at = v->full ? 0 : v->count++;
    v->kind[at] = kind, v->one[at] = one, v->two[at] = two, v->constant[at] = constant;
    return at;
}

static int of_one(Values *v, int kind, int a) { return value(v, kind, a, NONE, 0.0); }

static int of_two(Values *v, int kind, int a, int b) { return value(v, kind, a, b, 0.0); }

static int number(Values *v, double constant) {
    for (int i = 0; i < v->constants; ++i)
        if (v->constant[v->known[i]] == constant) return v->known[i];
    const int at = value(v, OP_CONST, NONE, NONE, constant);
    if (v->constants < CONSTANTS) v->known[v->constants++] = at;
    return at;
}

static int negative(Values *v, int a) { return of_one(v, OP_NEG, a); }

static int inverse_of(Values *v, int a) { return of_one(v, OP_INV, a); }

/* 1 + sign a^2 */
static int one_and_square(Values *v, double sign, int a) {
    return of_two(v, sign > 0 ? OP_ADD : OP_SUB, number(v, 1.0), of_one(v, OP_SQ, a));
}

static int sum_of(Values *v, int a, int b) { return a == NONE ? b : b == NONE ? a : of_two(v, OP_ADD, a, b); }

static int times_slope(Values *v, int slope, int a) {
    if (slope == NONE || a == NONE) return NONE;
    return slope == ONE ? a : slope == MINUS ? negative(v, a) : of_two(v, OP_MUL, slope, a);
}

/* Whether a is the less of both, a half where they are alike. */
static int share_of(Values *v, int a, int b) {
    const int less = of_two(v, OP_LE, a, b);
    return of_two(v, OP_DIV, less, of_two(v, OP_ADD, less, of_two(v, OP_LE, b, a)));
}

/* Slope of f = kind(a, b) by a, or by b (`second`). */
static int slope_by(Values *v, int kind, int second, int a, int b, int f) {
    int t;
    switch (kind) {
    case OP_ASSIGN: case OP_ADD: return ONE;
    case OP_SUB: return second ? MINUS : ONE;
    case OP_MUL: return second ? a : b;
    case OP_DIV: return second ? negative(v, of_two(v, OP_DIV, f, b)) : inverse_of(v, b);
    case OP_NEG: return MINUS;
    case OP_EXP: return f;
    case OP_LOG: return inverse_of(v, a);
    case OP_POW:
        if (second) return of_two(v, OP_MUL, of_one(v, OP_LOG, a), f);
        return of_two(v, OP_MUL, b, of_two(v, OP_POW, a, of_two(v, OP_SUB, b, number(v, 1.0))));
    case OP_SQRT: return inverse_of(v, of_one(v, OP_TWICE, f));
    case OP_SQ: return of_one(v, OP_TWICE, a);
    case OP_TWICE: return number(v, 2.0);
    case OP_SIN: return of_one(v, OP_COS, a);
    case OP_COS: return negative(v, of_one(v, OP_SIN, a));
    case OP_TAN: return one_and_square(v, 1.0, f);
    case OP_ASIN: return inverse_of(v, of_one(v, OP_SQRT, one_and_square(v, -1.0, a)));
    case OP_ACOS: return negative(v, inverse_of(v, of_one(v, OP_SQRT, one_and_square(v, -1.0, a))));
    case OP_ATAN: return inverse_of(v, one_and_square(v, 1.0, a));
    case OP_FMOD: return second ? of_two(v, OP_DIV, of_two(v, OP_SUB, f, a), b) : ONE;
    case OP_FABS: return of_one(v, OP_SIGN, a);
    case OP_COPYSIGN:
        return second ? NONE : of_two(v, OP_MUL, of_one(v, OP_SIGN, a), of_two(v, OP_COPYSIGN, number(v, 1.0), b));
    case OP_IF_ELSE_ZERO: return second ? a : NONE;
    case OP_ERF:
        return of_two(v, OP_MUL, number(v, 1.1283791670955126), of_one(v, OP_EXP, negative(v, of_one(v, OP_SQ, a))));
    case OP_FMIN: return share_of(v, second ? b : a, second ? a : b);
    case OP_FMAX: return share_of(v, second ? a : b, second ? b : a);
    case OP_INV: return negative(v, of_one(v, OP_SQ, f));
    case OP_SINH: return of_one(v, OP_COSH, a);
    case OP_COSH: return of_one(v, OP_SINH, a);
    case OP_TANH: return one_and_square(v, -1.0, f);
    case OP_ASINH: return inverse_of(v, of_one(v, OP_SQRT, one_and_square(v, 1.0, a)));
    case OP_ACOSH:
        t = inverse_of(v, of_one(v, OP_SQRT, of_two(v, OP_SUB, a, number(v, 1.0))));
        return of_two(v, OP_DIV, t, of_one(v, OP_SQRT, of_two(v, OP_ADD, a, number(v, 1.0))));
    case OP_ATANH: return inverse_of(v, one_and_square(v, -1.0, a));
    case OP_ATAN2:
        t = of_two(v, OP_ADD, of_one(v, OP_SQ, a), of_one(v, OP_SQ, b));
        return second ? negative(v, of_two(v, OP_DIV, a, t)) : of_two(v, OP_DIV, b, t);
    case OP_LOG1P: return inverse_of(v, of_two(v, OP_ADD, number(v, 1.0), a));
    case OP_EXPM1: return of_one(v, OP_EXP, a);
    case OP_HYPOT: return of_two(v, OP_DIV, second ? b : a, f);
    default: return NONE; /* comparisons, rounding, signs */
    }
}

/* What a derivative is made from. */
typedef struct {
    int count, arguments, results;
    const int *program, *heights, *wanted, *pairs;
    const double *constants;
} Primal;

/* Its values, as they are, and for each of its operations which of them it reads (of an output), and whether it moves. */
static void copied(const Primal *f, Values *v, int *last, int *at, int *moves) {
    for (int k = 0; k < f->count; ++k) {
        const int *own = f->program + 4 * k, kind = own[0];
        at[k] = NONE;
        if (kind == OP_OUTPUT) {
            at[k] = last[own[1]];
            continue;
        }
        int now;
        if (kind == OP_INPUT)
            now = value(v, kind, own[1], own[2], 0.0), moves[now] = f->wanted[own[1]];
        else if (kind == OP_CONST)
            now = value(v, kind, NONE, NONE, f->constants[k]), moves[now] = 0;
        else {
            const int one = last[own[1]], two = f->pairs[kind] ? last[own[2]] : NONE;
            now = of_two(v, kind, one, two), moves[now] = moves[one] || (two >= 0 && moves[two]);
        }
        last[own[3]] = now;
    }
}

/* Slopes of the weighted results by the arguments: `slopes`, one after the other as heights say. */
static void back_from_weights(const Primal *f, Values *v, const int *at, const int *moves, int *slopes) {
    const int values = v->count;
    int *weight = slopes; /* those of the arguments lie before those of the values */
    for (int i = 0; i < f->arguments; ++i) weight += f->heights[i];
    for (int i = 0; i < values; ++i) weight[i] = NONE;
    for (int *s = slopes; s < weight; ++s) *s = NONE;
    for (int k = 0; k < f->count; ++k) {
        const int *own = f->program + 4 * k;
        if (own[0] != OP_OUTPUT || !moves[at[k]]) continue;
        const int seed = value(v, OP_INPUT, f->arguments + f->results + own[2], own[3], 0.0);
        weight[at[k]] = sum_of(v, weight[at[k]], seed);
    }
    for (int i = values - 1; i >= 0 && !v->full; --i) {
        const int kind = v->kind[i], one = v->one[i], two = v->two[i];
        if (weight[i] == NONE) continue;
        if (kind == OP_INPUT) {
            int *own = slopes + two;
            for (int j = 0; j < one; ++j) own += f->heights[j];
            *own = sum_of(v, *own, weight[i]);
            continue;
        }
        for (int second = 0; second < 2; ++second) {
            const int operand = second ? two : one;
            if (operand < 0 || !moves[operand]) continue;
            const int slope = slope_by(v, kind, second, one, two, i);
            weight[operand] = sum_of(v, weight[operand], times_slope(v, slope, weight[i]));
        }
    }
}

/* Tangents of the results along one of the arguments: `slopes`, one after the other. */
static void along_direction(const Primal *f, Values *v, const int *at, const int *moves, int *slopes) {
    const int values = v->count;
    int *tangent = slopes;
    for (int i = 0; i < f->results; ++i) tangent += f->heights[f->arguments + i];
    for (int *s = slopes; s < tangent; ++s) *s = NONE;
    for (int i = 0; i < values && !v->full; ++i) {
        const int kind = v->kind[i], one = v->one[i], two = v->two[i];
        tangent[i] = NONE;
        if (!moves[i]) continue;
        if (kind == OP_INPUT) {
            tangent[i] = value(v, kind, f->arguments + f->results + one, two, 0.0);
            continue;
        }
        for (int second = 0; second < 2; ++second) {
            const int operand = second ? two : one;
            if (operand < 0 || tangent[operand] == NONE) continue;
            const int slope = slope_by(v, kind, second, one, two, i);
            tangent[i] = sum_of(v, tangent[i], times_slope(v, slope, tangent[operand]));
        }
    }
    for (int k = 0; k < f->count; ++k) {
        const int *own = f->program + 4 * k;
        if (own[0] != OP_OUTPUT) continue;
        int place = own[3];
        for (int i = 0; i < own[2]; ++i) place += f->heights[f->arguments + i];
        slopes[place] = v->full ? NONE : tangent[at[k]];
    }
}

/* What is written out of values: operations, and which registers hold what. */
typedef struct {
    const Values *v;
    int *uses, *place, *stack; /* of each value how often it is still asked for, and its register, -1: none yet */
    int free, taken, made;
    int *program;
    double *constants;
} Written;

static void operation(Written *w, int kind, int one, int two, int three, double constant) {
    int *own = w->program + 4 * w->made;
    own[0] = kind, own[1] = one, own[2] = two, own[3] = three, w->constants[w->made++] = constant;
}

/* A register for a value. */
static int placed_in(Written *w, int i) { return w->place[i] = w->free ? w->stack[--w->free] : w->taken++; }

/* The register of a value that an operation asks for; inputs and constants are had when they are first asked for. */
static int register_of(Written *w, int i) {
    const Values *v = w->v;
    if (i < 0) return 0;
    if (w->place[i] < 0 && v->kind[i] == OP_INPUT) operation(w, OP_INPUT, v->one[i], v->two[i], placed_in(w, i), 0.0);
    if (w->place[i] < 0) operation(w, OP_CONST, 0, 0, placed_in(w, i), v->constant[i]);
    return w->place[i];
}

/* One use less: its register is free after the last one. */
static void used(Written *w, int i) {
    if (i >= 0 && !--w->uses[i]) w->stack[w->free++] = w->place[i];
}

/* The operations that give some values as results, whose heights are those given, 0: not there; their number, negative
 * where there are more than `most`. memory: 4 times `most` numbers and one for each result; registers: how many it takes. */
static int written_out_values(
    Values *v, const int *results, const int *heights, int count, int *memory, int *program, double *constants, int *registers
) {
    const int zero = number(v, 0.0);
    int outputs = 0, *first = memory + 3 * v->most, *next = first + v->most;
    for (int r = 0; r < count; ++r) outputs += heights[r];
    if (v->full || v->count + outputs > v->most) return -1;
    Written w = {v, memory, memory + v->most, memory + 2 * v->most, 0, 0, 0, program, constants};
    for (int i = 0; i < v->count; ++i) w.uses[i] = 0, w.place[i] = first[i] = NONE;
    for (int i = 0; i < outputs; ++i) {
        const int own = results[i] == NONE ? zero : results[i];
        ++w.uses[own], next[i] = first[own], first[own] = i;
    }
    for (int i = v->count - 1; i >= 0; --i) {
        if (!w.uses[i] || v->kind[i] == OP_INPUT || v->kind[i] == OP_CONST) continue;
        ++w.uses[v->one[i]];
        if (v->two[i] >= 0) ++w.uses[v->two[i]];
    }
    for (int i = 0; i < v->count; ++i) {
        const int kind = v->kind[i], leaf = kind == OP_INPUT || kind == OP_CONST;
        if (!w.uses[i] || (leaf && first[i] == NONE)) continue;
        if (!leaf) {
            const int one = register_of(&w, v->one[i]), two = register_of(&w, v->two[i]);
            used(&w, v->one[i]), used(&w, v->two[i]);
            operation(&w, kind, one, two, placed_in(&w, i), 0.0);
        }
        for (int at = first[i]; at != NONE; at = next[at]) {
            int result = 0, height = at;
            while (height >= heights[result]) height -= heights[result++];
            operation(&w, OP_OUTPUT, register_of(&w, i), result, height, 0.0);
        }
        for (int at = first[i]; at != NONE; at = next[at]) used(&w, i);
    }
    *registers = w.taken;
    return w.made;
}

/* A derivative of a function that is told as `columns` takes it, told so: the number of its operations, negative where
 * there are more than `most`, or no memory.
 *
 * reverse: from weights of the results, which follow arguments and results, to slopes by the arguments; else from a
 * direction of the arguments, which follows them, to tangents of the results. wanted: of each argument, whether it moves.
 * there: of each of its results whether there is any that is not zero; others have no entries. registers: how many. */
EXPORT int derived_program(
    int reverse, int count, const int *program, const double *constants, int registers, int arguments, int results,
    const int *heights, const int *wanted, const int *pairs, int most, int *derived, double *numbers, int *there,
    int *needed
) {
    const Primal f = {count, arguments, results, program, heights, wanted, pairs, constants};
    const int outputs = reverse ? arguments : results, *sizes = reverse ? heights : heights + arguments;
    size_t all = 0;
    for (int i = 0; i < outputs; ++i) all += sizes[i];
    const size_t each = (size_t)most, whole = registers + 2 * (size_t)count + 2 * all + 8 * each;
    int *memory = malloc(sizeof(int) * whole);
    double *real = malloc(sizeof(double) * each);
    int made = -1;
    if (memory && real) {
        int *last = memory, *at = last + registers, *moves = at + count, *slopes = moves + count, *of = slopes + all;
        Values v = {0, most, 0, of + each, of + 2 * each, of + 3 * each, real, 0, {0}};
        copied(&f, &v, last, at, moves);
        if (reverse)
            back_from_weights(&f, &v, at, moves, slopes);
        else
            along_direction(&f, &v, at, moves, slopes);
        int *kept = of; /* heights of what is there; what values were weighted by is not asked for any more */
        size_t place = 0, put = 0;
        for (int r = 0; r < outputs && !v.full; ++r) {
            int any = 0;
            for (int j = 0; j < sizes[r]; ++j) any |= slopes[place + j] != NONE;
            for (int j = 0; any && j < sizes[r]; ++j) slopes[put++] = slopes[place + j];
            place += sizes[r], there[r] = any, kept[r] = any ? sizes[r] : 0;
        }
        if (!v.full)
            made = written_out_values(&v, slopes, kept, outputs, of + 4 * each, derived, numbers, needed);
    }
    free(memory), free(real);
    return made;
}
