/* A function of scalars, given as CasADi lists its operations, on many columns: some of them at a time, operation by
 * operation. What tells one operation from the next then costs once for all of them. In sequences of columns the first
 * argument of each but the first is the first result of the one before; some sequences are worked on at a time.
 */

/* What is worked on together, at most, and where there are few. */
enum { LANES = 32, FEW_LANES = 4, FEW_TOGETHER = 16 };

/* CasADi's operations of scalars by the numbers that operations.py gives them. */
enum {
    OP_ASSIGN, OP_ADD, OP_SUB, OP_MUL, OP_DIV, OP_NEG, OP_EXP, OP_LOG, OP_POW, OP_SQRT, OP_SQ, OP_TWICE, OP_SIN,
    OP_COS, OP_TAN, OP_ASIN, OP_ACOS, OP_ATAN, OP_LT, OP_LE, OP_EQ, OP_NE, OP_NOT, OP_AND, OP_OR, OP_FLOOR, OP_CEIL,
    OP_FMOD, OP_FABS, OP_SIGN, OP_COPYSIGN, OP_IF_ELSE_ZERO, OP_ERF, OP_FMIN, OP_FMAX, OP_INV, OP_SINH, OP_COSH,
    OP_TANH, OP_ASINH, OP_ACOSH, OP_ATANH, OP_ATAN2, OP_CONST, OP_INPUT, OP_OUTPUT, OP_LOG1P, OP_EXPM1, OP_HYPOT
};

#define EACH(value) \
    for (int l = 0; l < wide; ++l) own[l] = (value); \
    break

/* One operation on all lanes; inputs and outputs are no such. */
INLINE void operate(const int wide, int kind, double constant, const double *a, const double *b, double *own) {
    switch (kind) {
    case OP_ASSIGN: EACH(a[l]);
    case OP_ADD: EACH(a[l] + b[l]);
    case OP_SUB: EACH(a[l] - b[l]);
    case OP_MUL: EACH(a[l] * b[l]);
    case OP_DIV: EACH(a[l] / b[l]);
    case OP_NEG: EACH(-a[l]);
    case OP_EXP: EACH(exp(a[l]));
    case OP_LOG: EACH(log(a[l]));
    case OP_POW: EACH(pow(a[l], b[l]));
    case OP_SQRT: EACH(sqrt(a[l]));
    case OP_SQ: EACH(a[l] * a[l]);
    case OP_TWICE: EACH(2.0 * a[l]);
    case OP_SIN: EACH(sin(a[l]));
    case OP_COS: EACH(cos(a[l]));
    case OP_TAN: EACH(tan(a[l]));
    case OP_ASIN: EACH(asin(a[l]));
    case OP_ACOS: EACH(acos(a[l]));
    case OP_ATAN: EACH(atan(a[l]));
    case OP_LT: EACH(a[l] < b[l]);
    case OP_LE: EACH(a[l] <= b[l]);
    case OP_EQ: EACH(a[l] == b[l]);
    case OP_NE: EACH(a[l] != b[l]);
    case OP_NOT: EACH(!a[l]);
    case OP_AND: EACH(a[l] && b[l]);
    case OP_OR: EACH(a[l] || b[l]);
    case OP_FLOOR: EACH(floor(a[l]));
    case OP_CEIL: EACH(ceil(a[l]));
    case OP_FMOD: EACH(fmod(a[l], b[l]));
    case OP_FABS: EACH(fabs(a[l]));
    case OP_SIGN: EACH(a[l] < 0 ? -1.0 : a[l] > 0 ? 1.0 : a[l]);
    case OP_COPYSIGN: EACH(copysign(a[l], b[l]));
    case OP_IF_ELSE_ZERO: EACH(a[l] ? b[l] : 0.0);
    case OP_ERF: EACH(erf(a[l]));
    case OP_FMIN: EACH(fmin(a[l], b[l]));
    case OP_FMAX: EACH(fmax(a[l], b[l]));
    case OP_INV: EACH(1.0 / a[l]);
    case OP_SINH: EACH(sinh(a[l]));
    case OP_COSH: EACH(cosh(a[l]));
    case OP_TANH: EACH(tanh(a[l]));
    case OP_ASINH: EACH(asinh(a[l]));
    case OP_ACOSH: EACH(acosh(a[l]));
    case OP_ATANH: EACH(atanh(a[l]));
    case OP_ATAN2: EACH(atan2(a[l], b[l]));
    case OP_CONST: EACH(constant);
    case OP_LOG1P: EACH(log1p(a[l]));
    case OP_EXPM1: EACH(expm1(a[l]));
    case OP_HYPOT: EACH(hypot(a[l], b[l]));
    }
}

#undef EACH

/* The function as it is told, see `columns`. */
typedef struct {
    int count;
    const int *program;
    const double *constants;
    int arguments;
    const int *heights;
    double *const *places;
    int steps;
} Told_function;

/* One step of `lanes` of the sequences from the `first` on. work: registers; given: the first argument, from the step
 * before, NULL: as it is told; found: the first result for the next one, NULL: there is none.
 */
INLINE void one_step(
    const int wide, const Told_function *f, int first, int lanes, int k, double *work, const double *given,
    double *found
) {
    const int *own = f->program;
    for (int o = 0; o < f->count; ++o, own += 4) {
        if (own[0] == OP_INPUT) {
            double *to = work + (size_t)own[3] * wide;
            if (own[1] == 0 && given) {
                for (int l = 0; l < wide; ++l) to[l] = given[(size_t)own[2] * wide + l];
                continue;
            }
            const int alone = own[1] == 0; /* one column for a sequence */
            const size_t height = f->heights[own[1]], apart = alone ? height : height * f->steps;
            const double *from = f->places[own[1]];
            if (from) from += first * apart + (alone ? 0 : k * height) + own[2];
            for (int l = 0; l < wide; ++l) to[l] = from && l < lanes ? from[l * apart] : 0.0;
        } else if (own[0] == OP_OUTPUT) {
            const double *from = work + (size_t)own[1] * wide;
            if (own[2] == 0 && found)
                for (int l = 0; l < wide; ++l) found[(size_t)own[3] * wide + l] = from[l];
            const size_t height = f->heights[f->arguments + own[2]], apart = height * f->steps;
            double *to = f->places[f->arguments + own[2]];
            if (!to) continue;
            to += first * apart + k * height + own[3];
            for (int l = 0; l < lanes; ++l) to[l * apart] = from[l];
        } else
            operate(wide, own[0], f->constants[o], work + (size_t)own[1] * wide, work + (size_t)own[2] * wide,
                    work + (size_t)own[3] * wide);
    }
}

/* All steps of all sequences, so many at a time. */
INLINE void in_lanes(const int wide, const Told_function *f, int sequences, double *work, double *passed) {
    const size_t height = f->heights[0];
    for (int first = 0; first < sequences; first += wide) {
        const int lanes = sequences - first < wide ? sequences - first : wide;
        for (int k = 0; k < f->steps; ++k) {
            double *given = passed + (k & 1) * height * wide, *found = passed + ((k + 1) & 1) * height * wide;
            one_step(wide, f, first, lanes, k, work, k ? given : NULL, k + 1 < f->steps ? found : NULL);
        }
    }
}

/* The function on the columns of `sequences` sequences of `steps` steps each; of one step: of columns for themselves.
 *
 * count: operations; program: of each its kind and three numbers: registers of its arguments and of its result; of an
 * input its argument, the place there and the register; of an output the register, the result and the place there.
 * constants: of each operation. registers: how many. heights: numbers of a column of each argument, then of each result;
 * of more than one step the first argument and the first result have as many.
 * places: where they lie, column after column, sequence after sequence; of the first argument a column for a sequence.
 * NULL: an argument of zeros, or a result that is not wanted. Nonzero without memory.
 */
EXPORT int NAME(columns)(
    int count, const int *program, const double *constants, int registers, int arguments, const int *heights,
    double *const *places, int steps, int sequences
) {
    const Told_function f = {count, program, constants, arguments, heights, places, steps};
    const int wide = sequences == 1 ? 1 : sequences <= FEW_TOGETHER ? FEW_LANES : LANES;
    const size_t kept = steps > 1 ? 2 * (size_t)heights[0] : 0;
    double *work = room(((size_t)registers + kept) * wide, sizeof(double));
    if (!work) return 1;
    double *passed = work + (size_t)registers * wide;
    if (wide == 1)
        in_lanes(1, &f, sequences, work, passed);
    else if (wide == FEW_LANES)
        in_lanes(FEW_LANES, &f, sequences, work, passed);
    else
        in_lanes(LANES, &f, sequences, work, passed);
    free(work);
    return 0;
}
