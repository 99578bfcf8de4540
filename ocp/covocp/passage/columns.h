/* A function of scalars, given as CasADi lists its operations, on many columns: some of them at a time, operation by
 * operation. What tells one operation from the next then costs once for all of them.
 */

/* Columns that are worked on together. */
enum { LANES = 32 };

/* Operations by the numbers that columns.py gives them. */
enum {
    ASSIGN, ADD, SUBTRACT, MULTIPLY, DIVIDE, NEGATE, EXPONENTIAL, LOGARITHM, POWER, ROOT, SQUARE, TWICE, SINE, COSINE,
    TANGENT, ARCSINE, ARCCOSINE, ARCTANGENT, BELOW, AT_MOST, EQUAL, UNEQUAL, NOT, AND, OR, FLOOR, CEILING, REMAINDER,
    MAGNITUDE, SIGN, COPY_SIGN, WHERE, ERROR_FUNCTION, LEAST, LARGEST, INVERSE, HYPERBOLIC_SINE, HYPERBOLIC_COSINE,
    HYPERBOLIC_TANGENT, AREA_SINE, AREA_COSINE, AREA_TANGENT, ARCTANGENT_OF_TWO, CONSTANT, INPUT, OUTPUT, LOGARITHM_1P,
    EXPONENTIAL_M1, HYPOTENUSE
};

#define EACH(value) \
    for (int l = 0; l < LANES; ++l) own[l] = (value); \
    break

/* One operation on all lanes; inputs and outputs are no such. */
INLINE void operate(int kind, double constant, const double *a, const double *b, double *own) {
    switch (kind) {
    case ASSIGN: EACH(a[l]);
    case ADD: EACH(a[l] + b[l]);
    case SUBTRACT: EACH(a[l] - b[l]);
    case MULTIPLY: EACH(a[l] * b[l]);
    case DIVIDE: EACH(a[l] / b[l]);
    case NEGATE: EACH(-a[l]);
    case EXPONENTIAL: EACH(exp(a[l]));
    case LOGARITHM: EACH(log(a[l]));
    case POWER: EACH(pow(a[l], b[l]));
    case ROOT: EACH(sqrt(a[l]));
    case SQUARE: EACH(a[l] * a[l]);
    case TWICE: EACH(2.0 * a[l]);
    case SINE: EACH(sin(a[l]));
    case COSINE: EACH(cos(a[l]));
    case TANGENT: EACH(tan(a[l]));
    case ARCSINE: EACH(asin(a[l]));
    case ARCCOSINE: EACH(acos(a[l]));
    case ARCTANGENT: EACH(atan(a[l]));
    case BELOW: EACH(a[l] < b[l]);
    case AT_MOST: EACH(a[l] <= b[l]);
    case EQUAL: EACH(a[l] == b[l]);
    case UNEQUAL: EACH(a[l] != b[l]);
    case NOT: EACH(!a[l]);
    case AND: EACH(a[l] && b[l]);
    case OR: EACH(a[l] || b[l]);
    case FLOOR: EACH(floor(a[l]));
    case CEILING: EACH(ceil(a[l]));
    case REMAINDER: EACH(fmod(a[l], b[l]));
    case MAGNITUDE: EACH(fabs(a[l]));
    case SIGN: EACH(a[l] < 0 ? -1.0 : a[l] > 0 ? 1.0 : a[l]);
    case COPY_SIGN: EACH(copysign(a[l], b[l]));
    case WHERE: EACH(a[l] ? b[l] : 0.0);
    case ERROR_FUNCTION: EACH(erf(a[l]));
    case LEAST: EACH(fmin(a[l], b[l]));
    case LARGEST: EACH(fmax(a[l], b[l]));
    case INVERSE: EACH(1.0 / a[l]);
    case HYPERBOLIC_SINE: EACH(sinh(a[l]));
    case HYPERBOLIC_COSINE: EACH(cosh(a[l]));
    case HYPERBOLIC_TANGENT: EACH(tanh(a[l]));
    case AREA_SINE: EACH(asinh(a[l]));
    case AREA_COSINE: EACH(acosh(a[l]));
    case AREA_TANGENT: EACH(atanh(a[l]));
    case ARCTANGENT_OF_TWO: EACH(atan2(a[l], b[l]));
    case CONSTANT: EACH(constant);
    case LOGARITHM_1P: EACH(log1p(a[l]));
    case EXPONENTIAL_M1: EACH(expm1(a[l]));
    case HYPOTENUSE: EACH(hypot(a[l], b[l]));
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
            if (own[0] == INPUT) {
                const size_t height = heights[own[1]];
                const double *from = places[own[1]];
                double *to = work + (size_t)own[3] * LANES;
                if (from) from += first * height + own[2];
                for (int l = 0; l < LANES; ++l) to[l] = from && l < lanes ? from[l * height] : 0.0;
            } else if (own[0] == OUTPUT) {
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
