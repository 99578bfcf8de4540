/* Steps and readings forward. */
/* I - (H1 + H2)/4 + H2 H1/12 beside I - g H2 (2n columns), or beside (I - g H2) Z0 (n columns).
 *
 * p->sizes: what each entry of the diagonal is summed from.
 */
static void assemble(const Passage *p, int n, int k, const double *RESTRICT E, int w, double *RESTRICT a) {
    const int m = 2 * n, nnz = p->nnz, transition = w == 2 * m;
    const double *RESTRICT h1 = p->h1 + (size_t)k * nnz, *RESTRICT h2 = p->h2 + (size_t)k * nnz;
    double *RESTRICT sizes = p->sizes;
    memset(a, 0, sizeof(double) * m * w);
    for (int i = 0; i < m; ++i) a[i * w + i] = sizes[i] = 1.0;
    for (int i = 0; i < (transition ? m : n); ++i) a[i * w + m + i] = 1.0;
    if (!transition)
        for (int i = 0; i < n; ++i) memcpy(a + (n + i) * w + m, E + i * n, sizeof(double) * n);
    for (int q = 0; q < nnz; ++q) {
        const int r = p->row[q], c = p->col[q];
        double *RESTRICT own = a + r * w;
        const double share = h2[q] / 12.0, moved = -GAP * h2[q];
        own[c] -= 0.25 * (h1[q] + h2[q]);
        if (c == r) sizes[r] += 0.25 * fabs(h1[q] + h2[q]);
        for (int t = p->begin[c]; t < p->begin[c + 1]; ++t) {
            const double product = share * h1[p->which[t]];
            own[p->across[t]] += product;
            if (p->across[t] == r) sizes[r] += fabs(product);
        }
        if (transition || c < n)
            own[m + c] += moved;
        else
            for (int j = 0; j < n; ++j) own[m + j] += moved * E[(c - n) * n + j];
    }
}

/* The system of step k solved in a (2n x w): for its first stage, or for other right sides; with exchanges if need be. */
static void solve_full(
    const Passage *p, int n, int k, const double *RESTRICT E, int w, const double *right, double *RESTRICT a
) {
    const int m = 2 * n, columns = w - m;
    for (int exchanging = 0; exchanging < 2; ++exchanging) {
        assemble(p, n, k, E, w, a);
        for (int i = 0; right && i < m; ++i) memcpy(a + i * w + m, right + i * columns, sizeof(double) * columns);
        if (exchanging)
            eliminate(a, m, w, NULL, p->tall);
        else if (eliminate_steady(a, m, w, p->sizes))
            return;
    }
}

/* V = ((I - g H1) Y1 - Z0)/a, of some columns. */
static void change(
    const Passage *p, int n, int k, int columns, const double *RESTRICT Y1, const double *RESTRICT Z0, double *RESTRICT V
) {
    const double *RESTRICT h1 = p->h1 + (size_t)k * p->nnz;
    double *RESTRICT shares = p->sizes;
    for (int i = 0; i < 2 * n; ++i) {
        const int first = p->begin[i], count = p->begin[i + 1] - first;
        const double *RESTRICT before = Y1 + (size_t)i * columns, *other = Z0 && i >= n ? Z0 + (i - n) * n : NULL;
        double *RESTRICT own = V + (size_t)i * columns;
        for (int t = 0; t < count; ++t) shares[t] = h1[p->which[first + t]];
        for (int j = 0; j < columns; ++j) own[j] = before[j] - (other ? other[j] : 0.0);
        if (!other) own[i] -= 1.0;
        add_chosen(own, -GAP, shares, p->across + first, count, Y1, columns, columns);
        for (int j = 0; j < columns; ++j) own[j] *= 1.0 / SHARE;
    }
}

/* D [I; E] of a (2n x 2n) matrix. */
static void applied(const double *RESTRICT D, const double *RESTRICT E, int n, double *RESTRICT product) {
    for (int i = 0; i < 2 * n; ++i) {
        double *RESTRICT own = product + i * n;
        memcpy(own, D + i * 2 * n, sizeof(double) * n);
    }
    add_product(product, n, 1.0, D + n, 2 * n, 1, E, n, 2 * n, n, n);
}

/* Whether a step measures so much that the covariance loses most of its size where it is measured: then rounding of E
 * itself would count. The trace of h W E, in any units. */
static int measures_much(const Passage *p, int k, const double *E) {
    const double *h1 = p->h1 + (size_t)k * p->nnz, *h2 = p->h2 + (size_t)k * p->nnz;
    double first = 0.0, second = 0.0;
    for (int q = 0; q < p->nnz; ++q)
        if (p->row[q] < p->n && p->col[q] >= p->n) {
            const double own = E[p->row[q] * p->n + p->col[q] - p->n];
            first += h1[q] * own, second += h2[q] * own;
        }
    return !(first <= MUCH && second <= MUCH); /* NaN too */
}

/* One step: E (n x n) becomes the one after it; what slopes need is kept. Whether the transition was made.
 *
 * [I; E] goes through the step as it is. Where much is measured the transition D itself is made, from which E's rounding
 * is apart: the errors of D [I; E] stay in proportion to what they come from.
 */
static int step(const Passage *p, int n, int k, double *RESTRICT E) {
    const int m = 2 * n, transition = measures_much(p, k, E), columns = transition ? m : n, w = m + columns;
    double *RESTRICT a = p->work, *RESTRICT b = p->work + 8 * n * n, *RESTRICT D = p->work + 10 * n * n;
    const size_t place = p->full ? (size_t)k : 0, own = spot(p, k);
    double *RESTRICT Y1 = p->stage1 + place * m * n, *RESTRICT Y2 = p->stage2 + place * m * n;
    double *RESTRICT factor = p->factor + own * n * n;
    double *swaps = p->swaps + own * n;
    double *RESTRICT stage = transition ? D : Y1;
    if (is_steady(p, k))
        sparse_stage(p, n, k, E, columns, stage);
    else {
        solve_full(p, n, k, E, w, NULL, a);
        for (int i = 0; i < m; ++i) memcpy(stage + i * columns, a + i * w + m, sizeof(double) * columns);
    }
    if (transition) { /* the second stage has the place of V meanwhile */
        change(p, n, k, m, D, NULL, a);
        applied(D, E, n, Y1);
        applied(a, E, n, Y2);
    } else
        change(p, n, k, n, Y1, E, Y2);
    /* X' E+ = Y', side by side */
    turn(Y2, n, n, n, b, m);
    turn(Y2 + n * n, n, n, n, b + n, m);
    for (int i = 0; i < n; ++i) {
        b[i * m + i] += 1.0;
        for (int j = 0; j < n; ++j) b[i * m + n + j] += E[i * n + j];
    }
    for (int i = 0; i < m * n; ++i) Y2[i] = Y1[i] + 2.0 * GAP * Y2[i];
    eliminate_symmetric(b, n, swaps, p->tall, a, E);
    for (int i = 0; i < n; ++i) memcpy(factor + i * n, b + i * m, sizeof(double) * n);
    return transition;
}

/* Where readings compute: past what steps use. */
static double *aside(const Passage *p) { return p->work + 17 * (size_t)p->n * p->n; }

/* What reading j does: E (n x n) becomes the one after it; what slopes need is kept. */
static void reading(Passage *p, int n, int j, double *RESTRICT E) {
    const int r = p->r, w = 2 * r + n;
    const size_t square = (size_t)n * n, tall = (size_t)r * n, wide = (size_t)r * r;
    const double *M = p->told + j * telling(p), *half = M + tall;
    double *K = p->gain + j * tall, *A = p->keep + j * square, *S = p->inverse + j * wide, *after = p->reached + j * square;
    double *a = aside(p), *seen = a + (size_t)r * w, *R = seen + tall, *spare = p->work;
    product(M, E, r, n, n, seen); /* M E */
    product_turned(seen, M, r, n, r, S);
    spread(half, r, R);
    for (int i = 0; i < r; ++i) {
        for (int c = 0; c < r; ++c) a[i * w + c] = S[i * r + c] + R[i * r + c], a[i * w + r + c] = i == c;
        memcpy(a + i * w + 2 * r, seen + i * n, sizeof(double) * n);
    }
    eliminate(a, r, w, NULL, p->tall);
    for (int i = 0; i < r; ++i) {
        memcpy(S + i * r, a + i * w + r, sizeof(double) * r);
        for (int c = 0; c < n; ++c) K[c * r + i] = a[i * w + 2 * r + c];
    }
    product(K, M, n, r, n, A);
    for (size_t i = 0; i < square; ++i) A[i] = (i % (n + 1) == 0) - A[i];
    product(A, E, n, n, n, spare);
    product_turned(spare, A, n, n, n, after);
    product(K, R, n, r, r, seen);
    product_turned(seen, K, n, r, n, spare);
    for (size_t i = 0; i < square; ++i) after[i] += spare[i];
    for (int i = 0; i < n; ++i)
        for (int c = 0; c < n; ++c) E[i * n + c] = 0.5 * (after[i * n + c] + after[c * n + i]);
    memcpy(after, E, sizeof(double) * square);
}

/* Whether what is after step k is wanted. */
INLINE int at_end(const Passage *p, int k) { return (k + 1) % p->every == 0; }

/* The lower triangle of E. */
static void half_of(const double *RESTRICT E, int n, double *RESTRICT half) {
    for (int j = 0, t = 0; j < n; ++j)
        for (int i = j; i < n; ++i, ++t) half[t] = E[i * n + j];
}

/* What is done at step `at`, whose system is triangular where there is an order: E becomes the one after it.
 * Whether it may be passed back by its system alone. */
static int passed_step(Passage *p, int n, int at, double *E) {
    const int place = p->place[at];
    if (place >= 0) return !step(p, n, place, E) && is_steady(p, place);
    reading(p, n, -1 - place, E);
    return 0;
}

/* The passage from the first half-vector on, at p->h1, p->h2, p->told; kicks are added to what passes, NULL: nothing. */
static void passes(Passage *p, int n, const double *first, const double *kicks) {
    const size_t half = (size_t)n * (n + 1) / 2;
    double *E = p->work + 14 * n * n;
    const int between = apart(p);
    spread(first, n, E);
    if (p->thin) memset(p->hard, 0, sizeof(int) * p->ends);
    for (int k = 0; k < p->count; ++k) {
        if (p->place[k] >= 0) factorize(p, p->place[k]);
        const int simple = passed_step(p, n, k, E), wanted = at_end(p, k);
        if (p->thin) p->hard[k / p->every] |= !simple;
        if ((k + 1) % between) continue;
        double *after = p->after + k / between * half;
        half_of(E, n, after);
        if (!kicks || !wanted) continue;
        for (size_t t = 0; t < half; ++t) after[t] += kicks[k / p->every * half + t];
        spread(after, n, E);
    }
}
