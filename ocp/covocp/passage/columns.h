/* A function of scalars, given as CasADi lists its operations, on many columns: some of them at a time, operation by
 * operation. What tells one operation from the next then costs once for all of them.
 */

/* Columns that are worked on together. */
enum { LANES = 32 };

/* CasADi's operations of scalars by the numbers that operations.py gives them. */
enum {
    OP_ASSIGN, OP_ADD, OP_SUB, OP_MUL, OP_DIV, OP_NEG, OP_EXP, OP_LOG, OP_POW, OP_SQRT, OP_SQ, OP_TWICE, OP_SIN,
    OP_COS, OP_TAN, OP_ASIN, OP_ACOS, OP_ATAN, OP_LT, OP_LE, OP_EQ, OP_NE, OP_NOT, OP_AND, OP_OR, OP_FLOOR, OP_CEIL,
    OP_FMOD, OP_FABS, OP_SIGN, OP_COPYSIGN, OP_IF_ELSE_ZERO, OP_ERF, OP_FMIN, OP_FMAX, OP_INV, OP_SINH, OP_COSH,
    OP_TANH, OP_ASINH, OP_ACOSH, OP_ATANH, OP_ATAN2, OP_CONST, OP_INPUT, OP_OUTPUT, OP_LOG1P, OP_EXPM1, OP_HYPOT
};

#define EACH(value) \
    for (int l = 0; l < LANES; ++l) own[l] = (value); \
    break

/* One operation on all lanes; inputs and outputs are no such. */
INLINE void operate(int kind, double constant, const double *a, const double *b, double *own) {
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

/* The function on `columns` columns.
 *
 * count: operations; program: of each its kind and three numbers: registers of its arguments and of its result; of an
 * input its argument, the place there and the register; of an output the register, the result and the place there.
 * constants: of each operation. registers: how many. heights: numbers of a column of each argument, then of each result.
 * places: where they lie, column after column; NULL: an argument of zeros, or a result that is not wanted. Nonzero
 * without memory.
 */
EXPORT int NAME(columns)(
    int count, const int *program, const double *constants, int registers, int arguments, const int *heights,
    double *const *places, int columns
) {
    double *work = room((size_t)registers * LANES, sizeof(double));
    if (!work) return 1;
    for (int first = 0; first < columns; first += LANES) {
        const int lanes = columns - first < LANES ? columns - first : LANES;
        const int *own = program;
        for (int k = 0; k < count; ++k, own += 4) {
            if (own[0] == OP_INPUT) {
                const size_t height = heights[own[1]];
                const double *from = places[own[1]];
                double *to = work + (size_t)own[3] * LANES;
                if (from) from += first * height + own[2];
                for (int l = 0; l < LANES; ++l) to[l] = from && l < lanes ? from[l * height] : 0.0;
            } else if (own[0] == OP_OUTPUT) {
                const size_t height = heights[arguments + own[2]];
                double *to = places[arguments + own[2]];
                const double *from = work + (size_t)own[1] * LANES;
                if (!to) continue;
                to += first * height + own[3];
                for (int l = 0; l < lanes; ++l) to[l * height] = from[l];
            } else
                operate(own[0], constants[k], work + (size_t)own[1] * LANES, work + (size_t)own[2] * LANES,
                        work + (size_t)own[3] * LANES);
        }
    }
    free(work);
    return 0;
}
