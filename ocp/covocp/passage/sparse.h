/* The system of the stages, by its nonzeros.
 *
 * The matrix (I - g H2)(I - g H1) - a/2 (H1 + H2) is that of the identity and little more where a step is short, in any
 * units of the rows: its diagonal has none. So it is made triangular in an order that is chosen once by the pattern,
 * without exchanges; a step with a pivot that is not good (`eliminate_steady`) is taken as that of a full matrix.
 */

/* Row i (in the order of elimination) of the matrix, at its places in `row`; the sizes that its diagonal is summed from. */
INLINE double written_row(const Passage *p, int k, int i, double *RESTRICT row) {
    const double *RESTRICT h1 = p->h1 + (size_t)k * p->nnz, *RESTRICT h2 = p->h2 + (size_t)k * p->nnz;
    const int own = p->order[i];
    for (int q = p->left[i]; q < p->left[i + 1]; ++q) row[p->before[q]] = 0.0;
    for (int q = p->right[i]; q < p->right[i + 1]; ++q) row[p->behind[q]] = 0.0;
    double size = row[i] = 1.0;
    for (int t = p->begin[own]; t < p->begin[own + 1]; ++t) {
        const int c = p->across[t], q = p->which[t];
        const double share = h2[q] / 12.0;
        row[p->rank[c]] -= 0.25 * (h1[q] + h2[q]);
        if (c == own) size += 0.25 * fabs(h1[q] + h2[q]);
        for (int s = p->begin[c]; s < p->begin[c + 1]; ++s) {
            const double moved = share * h1[p->which[s]];
            row[p->rank[p->across[s]]] += moved;
            if (p->across[s] == own) size += fabs(moved);
        }
    }
    return size;
}

/* B (2n x columns) becomes the solution of the system of step k with it; 0 where a pivot is not good: B is lost then. */
static int solve_sparse(const Passage *p, int n, int k, int columns, double *RESTRICT B) {
    const int m = 2 * n;
    double *RESTRICT row = p->values, *RESTRICT inverses = row + m, *RESTRICT shares = inverses + m, *RESTRICT upper = shares + m;
    int *RESTRICT rows = p->chosen;
    for (int i = 0; i < m; ++i) {
        double size = written_row(p, k, i, row);
        int count = 0;
        for (int q = p->left[i]; q < p->left[i + 1]; ++q) {
            const int j = p->before[q];
            const double share = row[j] * inverses[j];
            if (share == 0.0) continue;
            for (int s = p->right[j]; s < p->right[j + 1]; ++s) row[p->behind[s]] -= share * upper[s];
            size += fabs(share * upper[p->facing[q]]);
            shares[count] = share, rows[count++] = p->order[j];
        }
        add_chosen(B + p->order[i] * columns, -1.0, shares, rows, count, B, columns, columns);
        if (!(fabs(row[i]) >= STEADY * size)) return 0; /* NaN neither */
        inverses[i] = 1.0 / row[i];
        for (int q = p->right[i]; q < p->right[i + 1]; ++q) upper[q] = row[p->behind[q]];
    }
    for (int i = m - 1; i >= 0; --i) {
        const int first = p->right[i], count = p->right[i + 1] - first;
        double *RESTRICT own = B + p->order[i] * columns;
        for (int q = 0; q < count; ++q) rows[q] = p->order[p->behind[first + q]];
        add_chosen(own, -1.0, upper + first, rows, count, B, columns, columns);
        for (int c = 0; c < columns; ++c) own[c] *= inverses[i];
    }
    return 1;
}

/* The first stage of step k, (I - g H2) [I; E] or all columns of I - g H2 on the right; 0 as above. */
static int sparse_stage(const Passage *p, int n, int k, const double *RESTRICT E, int columns, double *RESTRICT stage) {
    const double *RESTRICT h2 = p->h2 + (size_t)k * p->nnz;
    const int m = 2 * n, all = columns == m;
    memset(stage, 0, sizeof(double) * m * columns);
    for (int i = 0; i < columns; ++i) stage[i * columns + i] = 1.0;
    if (!all) memcpy(stage + n * n, E, sizeof(double) * n * n);
    for (int q = 0; q < p->nnz; ++q) {
        const int c = p->col[q];
        const double moved = -GAP * h2[q];
        double *RESTRICT own = stage + p->row[q] * columns;
        if (all || c < n)
            own[c] += moved;
        else
            for (int j = 0; j < n; ++j) own[j] += moved * E[(c - n) * n + j];
    }
    return solve_sparse(p, n, k, columns, stage);
}
