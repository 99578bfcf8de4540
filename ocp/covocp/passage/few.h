/* Slopes of few entries of the last covariance without the stages of its steps.
 *
 * Y1 M = S^-1 (I - g H2) [M; E M] and Y2 M = Y1 M + 2 g ((I - g H1) Y1 M - [M; E M])/a take the factors of S, which has few
 * nonzeros, and E: for a few columns a few thousand operations, and a fifth of the memory of the stages.
 */

/* own -= sum of entries times rows of B (of r numbers), at most PAIR columns in registers at a time. */
INLINE void less_rows(const double *entries, const int *rows, int count, const int r, const double *B, double *own) {
    enum { PAIR = 2 };
    for (int first = 0; first < r; first += PAIR) {
        double one[PAIR] = {0.0}, other[PAIR] = {0.0};
        const int wide = r - first < PAIR ? r - first : PAIR;
        int q = 0;
        for (; q + 2 <= count; q += 2) {
            const double a = entries[q], b = entries[q + 1];
            const double *x = B + rows[q] * r + first, *y = B + rows[q + 1] * r + first;
            for (int c = 0; c < wide; ++c) one[c] += a * x[c], other[c] += b * y[c];
        }
        for (int c = 0; q < count && c < wide; ++c)
            one[c] += entries[q] * B[rows[q] * r + first + c];
        for (int c = 0; c < wide; ++c) own[first + c] -= one[c] + other[c];
    }
}

/* S^-1 B in place, few columns. */
INLINE void solve_by(const int r, const Passage *p, int n, const double *factors, double *B) {
    const int m = 2 * n, filled = p->right[m];
    const double *lower = factors, *upper = lower + filled, *inverses = upper + filled;
    for (int i = 0; i < m; ++i) {
        const int at = p->left[i];
        less_rows(lower + at, p->before + at, p->left[i + 1] - at, r, B, B + p->order[i] * r);
    }
    for (int i = m - 1; i >= 0; --i) {
        const int at = p->right[i];
        double *own = B + p->order[i] * r;
        less_rows(upper + at, p->behind + at, p->right[i + 1] - at, r, B, own);
        for (int c = 0; c < r; ++c) own[c] *= inverses[i];
    }
}

static void solve_few(const Passage *p, int n, int r, const double *factors, double *B) {
    BY_WIDTH(solve_by, r, p, n, factors, B);
}

/* E a of a half-vector. */
INLINE void by_half(const double *RESTRICT half, int n, const double *RESTRICT a, double *RESTRICT product) {
    memset(product, 0, sizeof(double) * n);
    for (int j = 0; j < n; ++j) {
        const double own = a[j];
        product[j] += half[0] * own + dot(half + 1, a + j + 1, n - j - 1);
        for (int i = 1; i < n - j; ++i) product[j + i] += half[i] * own;
        half += n - j;
    }
}

/* B (2n x r) <- (I - g H) A. */
INLINE void moves_by(const int r, const Passage *p, int n, const double *h, const double *RESTRICT A, double *RESTRICT B) {
    memcpy(B, A, sizeof(double) * 2 * n * r);
    for (int q = 0; q < p->nnz; ++q) {
        const double share = GAP * h[q];
        for (int c = 0; c < r; ++c) B[p->row[q] * r + c] -= share * A[p->col[q] * r + c];
    }
}

static void moved_by(const Passage *p, int n, int r, const double *h, const double *A, double *B) {
    BY_WIDTH(moves_by, r, p, n, h, A, B);
}

/* [M; E M] (2n x r) from M' (r x n) and the half-vector of E; column: n. */
static void stacked(int n, const int r, const double *half, const double *M, double *RESTRICT both, double *column) {
    for (int c = 0; c < r; ++c) {
        by_half(half, n, M + c * n, column);
        for (int i = 0; i < n; ++i) both[i * r + c] = M[c * n + i], both[(n + i) * r + c] = column[i];
    }
}

/* Y1 M and Y2 M (2n x r) of step k from [M; E M] before it. */
static void few_stages(
    const Passage *p, int n, const int r, int k, const double *begin, double *RESTRICT y1, double *RESTRICT y2
) {
    const double *h1 = p->h1 + (size_t)k * p->nnz, *h2 = p->h2 + (size_t)k * p->nnz;
    moved_by(p, n, r, h2, begin, y1);
    solve_few(p, n, r, factors_of(p, k), y1);
    moved_by(p, n, r, h1, y1, y2);
    for (int i = 0; i < 2 * n * r; ++i) y2[i] = y1[i] + 2.0 * GAP * ((y2[i] - begin[i]) / SHARE);
}
