/* Tangents of slopes of few columns, in as few columns.
 *
 * Where P = M C M', M = X^-1 M+, what a direction does to the covariances is needed by these columns alone:
 *
 *     V+ = dE+ M+ = (dY - E+ dX) M,
 *
 * by the tangents of the step that takes [M; E M] along, with [0; V] in the place of [0; dE]. A product with second
 * derivatives takes O(n^2) operations a step for each column, where all of dE would take O(n^3).
 */

/* What is kept of a step, behind the seed, from here on (2n x r each, the last n x r): [M; E M], Y1 M, Y2 M; dY1 M, dY2 M, dX M. */
static double *narrow_of(const Kept *k, int r, int step) {
    return k->narrow + (size_t)k->p.n * (k->p.n + 1) / 2 + (size_t)step * 11 * k->p.n * r;
}

/* sum += share H A, of few columns. */
INLINE void adds_by(
    const int r, const Passage *p, double share, const double *h, const double *RESTRICT A, double *RESTRICT sum
) {
    for (int q = 0; q < p->nnz; ++q) {
        const double weight = share * h[q];
        for (int c = 0; c < r; ++c) sum[p->row[q] * r + c] += weight * A[p->col[q] * r + c];
    }
}

static void add_few(const Passage *p, int r, double share, const double *h, const double *A, double *sum) {
    BY_WIDTH(adds_by, r, p, share, h, A, sum);
}

/* B <- S^-1 B of a step, few columns; `spare`: as large. */
static void narrow_solve(const Kept *k, int n, const int r, int step, double *RESTRICT B, double *RESTRICT spare) {
    const int m = 2 * n;
    if (is_steady(&k->p, step)) {
        solve_few(&k->p, n, r, factors_of(&k->p, step), B);
        return;
    }
    const double *inverse = k->inverses + (size_t)step * m * m;
    memcpy(spare, B, sizeof(double) * m * r);
    for (int i = 0; i < m; ++i) {
        const double *RESTRICT row = inverse + (size_t)i * m;
        double sums[2] = {0.0}; /* as many columns as there mostly are, side by side */
        for (int c = 0; c < r; c += 2) {
            const int wide = r - c < 2 ? r - c : 2;
            sums[0] = sums[1] = 0.0;
            for (int j = 0; j < m; ++j)
                for (int l = 0; l < wide; ++l) sums[l] += row[j] * spare[j * r + c + l];
            for (int l = 0; l < wide; ++l) B[i * r + c + l] = sums[l];
        }
    }
}

/* `few_stages` by either. */
static void narrow_stages(
    const Kept *k, int n, const int r, int step, const double *begin, double *RESTRICT y1, double *RESTRICT y2,
    double *RESTRICT spare
) {
    const Passage *p = &k->p;
    const double *h1 = p->h1 + (size_t)step * p->nnz, *h2 = p->h2 + (size_t)step * p->nnz;
    moved_by(p, n, r, h2, begin, y1);
    narrow_solve(k, n, r, step, y1, spare);
    moved_by(p, n, r, h1, y1, y2);
    for (int i = 0; i < 2 * n * r; ++i) y2[i] = y1[i] + 2.0 * GAP * ((y2[i] - begin[i]) / SHARE);
}

/* S^-1 of a step whose system is not triangular by its nonzeros; works in p->work up to 12 n^2. */
static void invert(const Kept *k, int n, int step) {
    const int m = 2 * n, w = 2 * m;
    double *a = k->p.work, *unit = a + 8 * n * n, *inverse = k->inverses + (size_t)step * m * m;
    memset(unit, 0, sizeof(double) * m * m);
    for (int i = 0; i < m; ++i) unit[i * m + i] = 1.0;
    solve_full(&k->p, n, step, NULL, w, unit, a);
    for (int i = 0; i < m; ++i) memcpy(inverse + (size_t)i * m, a + (size_t)i * w + m, sizeof(double) * m);
}

/* Columns of all steps up to the seed, which follow from it and the point alone; M' (r x n) becomes that before all. */
INLINE void narrow_columns(const Kept *k, int n, const int r, double *M, double *spare) {
    const Passage *p = &k->p;
    const size_t half = (size_t)n * (n + 1) / 2, square = (size_t)n * n, tall = (size_t)2 * n * r;
    for (int at = k->seeded - 1; at >= 0; --at) {
        double *z = narrow_of(k, r, at);
        if (!is_steady(p, at)) invert(k, n, at);
        divide_few(p->factor + at * square, p->swaps + (size_t)at * n, n, r, M);
        stacked(n, r, at ? p->after + (at - 1) * half : k->first, M, z, spare);
        narrow_stages(k, n, r, at, z, z + tall, z + 2 * tall, spare);
    }
}

/* The tangent of step `at` in these columns: V (n x r) becomes that after it. */
INLINE void narrow_step(
    const Kept *k, int n, const int r, int at, const double *e1, const double *e2, double *RESTRICT V,
    double *RESTRICT spare
) {
    const Passage *p = &k->p;
    const size_t nnz = p->nnz, tall = (size_t)2 * n * r, wide = (size_t)n * r, half = (size_t)n * (n + 1) / 2;
    const double *h1 = p->h1 + at * nnz, *h2 = p->h2 + at * nnz;
    double *z = narrow_of(k, r, at), *y1 = z + tall, *dy1 = z + 3 * tall, *dy2 = dy1 + tall, *dx = dy2 + tall;
    double *dz = spare, *inner = dz + tall, *dv = inner + tall, *column = dv + tall, *product = column + n;
    memset(dz, 0, sizeof(double) * wide);
    memcpy(dz + wide, V, sizeof(double) * wide);
    moved_by(p, n, r, h2, dz, dy1); /* the terms of `tangent_step`, in its order */
    add_few(p, r, -GAP, e2, z, dy1);
    add_few(p, r, 0.25, e1, y1, dy1);
    add_few(p, r, 0.25, e2, y1, dy1);
    memset(inner, 0, sizeof(double) * tall);
    add_few(p, r, 1.0, h1, y1, inner);
    add_few(p, r, -1.0 / 12.0, e2, inner, dy1);
    memset(inner, 0, sizeof(double) * tall);
    add_few(p, r, 1.0, e1, y1, inner);
    add_few(p, r, -1.0 / 12.0, h2, inner, dy1);
    narrow_solve(k, n, r, at, dy1, dv);
    moved_by(p, n, r, h1, dy1, dv);
    add_few(p, r, -GAP, e1, y1, dv);
    for (size_t i = 0; i < tall; ++i) dv[i] = (dv[i] - dz[i]) / SHARE, dy2[i] = dy1[i] + 2.0 * GAP * dv[i];
    memcpy(dx, dv, sizeof(double) * wide);
    for (int c = 0; c < r; ++c) {
        for (int i = 0; i < n; ++i) column[i] = dx[i * r + c];
        by_half(p->after + at * half, n, column, product);
        for (int i = 0; i < n; ++i) V[i * r + c] += dv[wide + i * r + c] - product[i];
    }
}

/* How slopes by H at step `at` move, and dM' (r x n), which becomes that before it. */
INLINE void narrow_back(
    const Kept *k, int n, const int r, int at, const double *C, double *RESTRICT dM, double *RESTRICT spare, double *out1,
    double *out2
) {
    const Passage *p = &k->p;
    const size_t half = (size_t)n * (n + 1) / 2, square = (size_t)n * n, tall = (size_t)2 * n * r;
    double *z = narrow_of(k, r, at), *dx = z + 5 * tall;
    double *begin = spare, *w = begin + tall, *weighted = w + 2 * tall, *turned = weighted + tall, *other = turned + tall;
    for (int c = 0; c < r; ++c)
        for (int i = 0; i < n; ++i) dM[c * n + i] -= dx[i * r + c]; /* X dM = dM+ - dX M */
    divide_few(p->factor + at * square, p->swaps + (size_t)at * n, n, r, dM);
    stacked(n, r, at ? p->after + (at - 1) * half : k->first, dM, begin, weighted);
    narrow_stages(k, n, r, at, begin, w, w + tall, weighted);
    for (int stage = 0; stage < 2; ++stage, w += tall) {
        const double *y = z + (1 + stage) * tall;
        double *dy = z + (3 + stage) * tall, *out = stage ? out2 : out1;
        if (!out) continue;
        for (size_t i = 0; i < tall; ++i) dy[i] += w[i];
        product(dy, C, 2 * n, r, r, turned);
        slopes_few(p, n, r, C, y, weighted, other); /* C is symmetric: both halves of the tangent, one after the other */
        at_nonzeros(p, n, r, dy, weighted, out);
        at_nonzeros(p, n, r, y, turned, other);
        for (int q = 0; q < p->nnz; ++q) out[q] += other[q];
    }
}

/* Tangents along a direction; `fresh`: the columns are not known yet. M' is that of the seed, (r x n) as dM'. */
INLINE void narrow_tangents(
    const Kept *k, int n, const int r, int fresh, const Slopes *s, const double *d_first, const double *d1,
    const double *d2, double *dM, double *spare, double *by_h1, double *by_h2
) {
    const Passage *p = &k->p;
    const size_t nnz = p->nnz;
    double *V = spare, *rest = V + (size_t)n * r, *column = rest, *product = rest + n;
    if (fresh) narrow_columns(k, n, r, s->M, spare);
    const double *z = narrow_of(k, r, 0);
    for (int c = 0; c < r; ++c) { /* dE M at the start */
        for (int i = 0; i < n; ++i) column[i] = z[i * r + c];
        by_half(d_first, n, column, product);
        for (int i = 0; i < n; ++i) V[i * r + c] = product[i];
    }
    for (int at = 0; at < k->seeded; ++at) narrow_step(k, n, r, at, d1 + at * nnz, d2 + at * nnz, V, rest);
    memset(dM, 0, sizeof(double) * n * r);
    for (int at = k->seeded - 1; at >= 0; --at)
        narrow_back(k, n, r, at, s->C, dM, spare, by_h1 ? by_h1 + at * nnz : NULL, by_h2 ? by_h2 + at * nnz : NULL);
    for (int c = 0; c < r; ++c)
        for (int i = 0; i < n; ++i) s->M[c * n + i] = z[i * r + c];
}

/* Whether `narrow_second` takes these slopes: those of few columns, where something is kept of all steps. */
static int is_narrow(const Kept *k, const double *kicks, const double *seed, const double *d_kicks, const double *d_seed) {
    const Passage *p = &k->p;
    const int half = p->n * (p->n + 1) / 2;
    const int all_kept = p->brief || (p->full && !p->order);
    if (!all_kept || p->reads || kicks || d_kicks || !is_few(p, p->n, seed)) return 0;
    for (int e = 0; d_seed && e < p->ends; ++e)
        if (is_asked(d_seed + (size_t)e * half, half)) return 0;
    return 1;
}

/* Steps up to the half-vector that has a seed; 0 where there is none. */
static int seeded_steps(const Passage *p, const double *seed) {
    const int half = p->n * (p->n + 1) / 2;
    for (int e = 0; e < p->ends; ++e)
        if (is_asked(seed + (size_t)e * half, half)) return (e + 1) * p->every;
    return 0;
}

/* Room for so many numbers; nonzero without memory. */
static int narrow_room(Kept *k, size_t count) {
    if (count <= k->narrowed) return 0;
    free(k->narrow);
    k->held -= sizeof(double) * k->narrowed;
    k->narrow = NULL, k->narrowed = 0, k->seeded = 0;
    if (made(k, &k->narrow, count)) return 1;
    k->narrowed = count;
    return 0;
}

/* Tangents of the slopes at the point of the last run; nonzero without memory. */
static int narrow_second(
    Kept *k, int n, const double *seed, const double *d_first, const double *d1, const double *d2, double *by_first,
    double *by_h1, double *by_h2
) {
    const Passage *p = &k->p;
    const size_t half = (size_t)n * (n + 1) / 2, square = (size_t)n * n, nnz = p->nnz;
    const int steps = seeded_steps(p, seed), behind = p->count - steps;
    double *spare = p->work, *work = p->work + 12 * square;
    Moved v = {{0, 0, work, work + square, work + 2 * square}, NULL, work + 3 * square};
    int all = 1;
    for (int at = 0; at < steps; ++at) all &= is_steady(p, at);
    if (!all && made(k, &k->inverses, (size_t)p->moves * 4 * square)) return 1;
    if (by_h1) memset(by_h1 + steps * nnz, 0, sizeof(double) * behind * nnz);
    if (by_h2) memset(by_h2 + steps * nnz, 0, sizeof(double) * behind * nnz);
    if (steps) {
        const double *own = seed + (steps / p->every - 1) * half;
        join(&v.s, n, p->chosen, own);
        const int r = v.s.few;
        if (narrow_room(k, half + (size_t)p->moves * 11 * n * r)) return 1;
        const int fresh = k->seeded != steps || memcmp(k->narrow, own, sizeof(double) * half);
        memcpy(k->narrow, own, sizeof(double) * half);
        k->seeded = steps;
        if (r == 1)
            narrow_tangents(k, n, 1, fresh, &v.s, d_first, d1, d2, v.dM, spare, by_h1, by_h2);
        else if (r == 2)
            narrow_tangents(k, n, 2, fresh, &v.s, d_first, d1, d2, v.dM, spare, by_h1, by_h2);
        else
            narrow_tangents(k, n, r, fresh, &v.s, d_first, d1, d2, v.dM, spare, by_h1, by_h2);
    }
    if (by_first) pack_tangents(&v, n, spare, by_first);
    return 0;
}
