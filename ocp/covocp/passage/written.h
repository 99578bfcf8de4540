/* The passage as exported code has it: without readings, in memory of the caller, nothing kept from call to call. */

/* Numbers of what `written_forward` returns (`of` 0), and of what `written_slopes` returns (1), with what they work in. */
static size_t written_length(const int *shape, int of) {
    Passage p;
    described(&p, shape);
    p.full = 1;
    const size_t slopes = (size_t)p.n * (p.n + 1) / 2 + 2 * (size_t)p.nnz * p.moves;
    return (of ? slopes : keeps(&p, NULL) + stages(&p, NULL)) + works(&p, NULL);
}

/* Half-vectors after each step, and behind them what slopes need. */
static void written_forward(
    const int *shape, int *chosen, const double *first, const double *h1, const double *h2, double *result
) {
    Passage p;
    described(&p, shape);
    p.full = 1, p.h1 = h1, p.h2 = h2;
    counts(&p, chosen);
    result += keeps(&p, result);
    works(&p, result + stages(&p, result));
    passes(&p, p.n, first, NULL);
}

/* Slopes of seed . half-vectors by first, h1, h2, one behind the other; `passed`: the result of the passage. */
static void written_slopes(
    const int *shape, int *chosen, const double *h1, const double *h2, const double *passed, const double *seed,
    double *result
) {
    Passage p;
    described(&p, shape);
    const size_t half = (size_t)p.n * (p.n + 1) / 2, entries = (size_t)p.nnz * p.moves;
    double *by_h1 = result + half, *by_h2 = by_h1 + entries;
    p.full = 1, p.h1 = h1, p.h2 = h2;
    counts(&p, chosen);
    passed += keeps(&p, (double *)passed); /* which `back` only reads */
    stages(&p, (double *)passed);
    works(&p, by_h2 + entries);
    back(&p, p.n, NULL, seed, result, by_h1, by_h2, NULL, NULL);
}
