/* The system of the stages, by its nonzeros.
 *
 * The matrix S = (I - g H2)(I - g H1) - a/2 (H1 + H2) is that of the identity and little more where a step is short, in any
 * units of the rows: its diagonal has none. So it is made triangular in an order that is chosen once by the pattern,
 * without exchanges; a step with a pivot that is not good (`eliminate_steady`) is taken as that of a full matrix.
 *
 * S does not depend on the covariance: `lanes` steps are made triangular side by side, entry by entry.
 */

/* Where those of step k are. */
static double *factors_of(const Passage *p, int k) {
    return p->factors + (size_t)(p->brief ? k : k % p->lanes) * factors_length(p);
}

/* sum += a b, of the numbers of all lanes. */
INLINE void add_lanes(const int lanes, double *sum, const double *a, const double *b) {
#if defined(__GNUC__)
    typedef double Side __attribute__((vector_size(8 * MOST_LANES), aligned(8), may_alias));
    if (lanes == MOST_LANES) {
        *(Side *)sum += *(const Side *)a * *(const Side *)b;
        return;
    }
#endif
    for (int l = 0; l < lanes; ++l) sum[l] += a[l] * b[l];
}

/* Row i (in the order of elimination) of some matrices in `row`, and what their diagonals are summed from in `size`; h1, h2:
 * nonzeros of H of all of them. */
INLINE void written_row(
    const Passage *p, const int lanes, int i, const double *RESTRICT h1, const double *RESTRICT h2, double *RESTRICT row,
    double *RESTRICT size
) {
    const int own = p->order[i];
    for (int q = p->left[i]; q < p->left[i + 1]; ++q)
        for (int l = 0; l < lanes; ++l) row[p->before[q] * lanes + l] = 0.0;
    for (int q = p->right[i]; q < p->right[i + 1]; ++q)
        for (int l = 0; l < lanes; ++l) row[p->behind[q] * lanes + l] = 0.0;
    for (int l = 0; l < lanes; ++l) row[own * lanes + l] = size[l] = 1.0;
    for (int t = p->begin[own]; t < p->begin[own + 1]; ++t) {
        const int c = p->across[t];
        const double *RESTRICT one = h1 + p->which[t] * lanes, *RESTRICT two = h2 + p->which[t] * lanes;
        double share[MOST_LANES];
        for (int l = 0; l < lanes; ++l) row[c * lanes + l] -= 0.25 * (one[l] + two[l]), share[l] = two[l] / 12.0;
        for (int l = 0; c == own && l < lanes; ++l) size[l] += 0.25 * fabs(one[l] + two[l]);
        for (int s = p->begin[c]; s < p->begin[c + 1]; ++s) {
            const double *further = h1 + p->which[s] * lanes;
            add_lanes(lanes, row + p->across[s] * lanes, share, further);
            for (int l = 0; p->across[s] == own && l < lanes; ++l) size[l] += fabs(share[l] * further[l]);
        }
    }
}

/* Row i, written in `row`, made triangular; `lower`, `upper`, `inverses`: of all rows and lanes. Whether pivots are good. */
INLINE void triangular_row(
    const Passage *p, const int lanes, int i, double *RESTRICT row, double *RESTRICT size, double *RESTRICT lower,
    double *RESTRICT upper, double *RESTRICT inverses, int *RESTRICT good
) {
    const int own = p->order[i];
    for (int q = p->left[i]; q < p->left[i + 1]; ++q) {
        const int j = p->rank[p->before[q]];
        const double *RESTRICT entry = row + p->before[q] * lanes, *RESTRICT inverse = inverses + j * lanes;
        const double *RESTRICT facing = upper + p->facing[q] * lanes;
        double share[MOST_LANES];
        for (int l = 0; l < lanes; ++l) {
            lower[q * lanes + l] = entry[l] * inverse[l];
            share[l] = -lower[q * lanes + l];
            size[l] += fabs(share[l] * facing[l]);
        }
        for (int s = p->right[j]; s < p->right[j + 1]; ++s)
            add_lanes(lanes, row + p->behind[s] * lanes, share, upper + s * lanes);
    }
    const double *RESTRICT pivot = row + own * lanes;
    for (int l = 0; l < lanes; ++l) {
        good[l] &= fabs(pivot[l]) >= STEADY * size[l]; /* NaN is not */
        inverses[i * lanes + l] = 1.0 / pivot[l];
    }
    for (int q = p->right[i]; q < p->right[i + 1]; ++q)
        for (int l = 0; l < lanes; ++l) upper[q * lanes + l] = row[p->behind[q] * lanes + l];
}

/* Factors of `lanes` steps from step `first` on. */
INLINE void factorized(const Passage *p, const int lanes, int first) {
    const int m = 2 * p->n, nnz = p->nnz, filled = p->right[m];
    const int steps = p->moves - first < lanes ? p->moves - first : lanes;
    double *RESTRICT h1 = p->values, *RESTRICT h2 = h1 + nnz * lanes, *RESTRICT row = h2 + nnz * lanes;
    double *RESTRICT all = row + m * lanes, *RESTRICT upper = all + filled * lanes;
    double *RESTRICT inverses = upper + filled * lanes, size[MOST_LANES];
    int *RESTRICT good = p->good + (p->brief ? first : 0);
    int fine[MOST_LANES];
    for (int l = 0; l < lanes; ++l) {
        const size_t step = (size_t)(first + (l < steps ? l : steps - 1)) * nnz; /* the last one fills what is left */
        for (int q = 0; q < nnz; ++q) h1[q * lanes + l] = p->h1[step + q], h2[q * lanes + l] = p->h2[step + q];
        fine[l] = 1;
    }
    for (int i = 0; i < m; ++i) {
        written_row(p, lanes, i, h1, h2, row, size);
        triangular_row(p, lanes, i, row, size, all, upper, inverses, fine);
    }
    const size_t length = factors_length(p);
    for (int l = 0; l < steps; ++l) {
        double *RESTRICT own = factors_of(p, first + l);
        good[l] = fine[l];
        for (size_t q = 0; q < length; ++q) own[q] = all[q * lanes + l];
    }
}

/* The same where a step begins that is the first of `lanes`. */
static void factorize(const Passage *p, int k) {
    if (!p->order || k % p->lanes) return;
    if (p->lanes == MOST_LANES)
        factorized(p, MOST_LANES, k);
    else
        factorized(p, 1, k);
}

/* Whether the pivots of step k are good. */
static int is_steady(const Passage *p, int k) { return p->order && p->good[p->brief ? k : k % p->lanes]; }

/* B (2n x columns) becomes the solution of the system of step k with it. */
static void solve_sparse(const Passage *p, int n, int k, int columns, double *RESTRICT B) {
    const int m = 2 * n;
    const double *lower = factors_of(p, k), *upper = lower + p->right[m], *inverses = upper + p->right[m];
    for (int i = 0; i < m; ++i) {
        const int at = p->left[i];
        add_chosen(B + p->order[i] * columns, -1.0, lower + at, p->before + at, p->left[i + 1] - at, B, columns, columns);
    }
    for (int i = m - 1; i >= 0; --i) {
        const int at = p->right[i];
        double *RESTRICT own = B + p->order[i] * columns;
        add_chosen(own, -1.0, upper + at, p->behind + at, p->right[i + 1] - at, B, columns, columns);
        for (int c = 0; c < columns; ++c) own[c] *= inverses[i];
    }
}

/* The first stage of step k, (I - g H2) [I; E] or all columns of I - g H2 on the right. */
static void sparse_stage(const Passage *p, int n, int k, const double *RESTRICT E, int columns, double *RESTRICT stage) {
    const double *RESTRICT h2 = p->h2 + (size_t)k * p->nnz;
    const int m = 2 * n, all = columns == m;
    double *RESTRICT shares = p->sizes;
    memset(stage, 0, sizeof(double) * m * columns);
    for (int i = 0; i < columns; ++i) stage[i * columns + i] = 1.0;
    if (!all) memcpy(stage + n * n, E, sizeof(double) * n * n);
    for (int i = 0; i < m; ++i) {
        double *own = stage + i * columns;
        int count = 0;
        for (int t = p->begin[i]; t < p->begin[i + 1]; ++t) {
            const int c = p->across[t];
            if (all || c < n)
                own[c] -= GAP * h2[p->which[t]];
            else
                shares[count] = h2[p->which[t]], p->chosen[count++] = c - n;
        }
        add_chosen(own, -GAP, shares, p->chosen, count, E, n, n);
    }
    solve_sparse(p, n, k, columns, stage);
}
