/* Slopes, from the last step to the first. */
/* M <- X^-1 M, M (n x r) row by row; X' = P' L U. */
static void divide(const double *RESTRICT factor, const double *RESTRICT swaps, int n, int r, double *RESTRICT M) {
    for (int first = 0, end; first < n; first = end) {
        end = first + PANEL < n ? first + PANEL : n;
        add_product(M + first * r, r, -1.0, factor + first, 1, n, M, r, end - first, first, r);
        for (int i = first; i < end; ++i) {
            const double inverse = 1.0 / factor[i * n + i];
            double *RESTRICT own = M + i * r;
            add_rows(own, -1.0, factor + first * n + i, n, M + first * r, r, i - first, r);
            for (int c = 0; c < r; ++c) own[c] *= inverse;
        }
    }
    for (int end = n, first; end > 0; end = first) {
        first = end > PANEL ? end - PANEL : 0;
        add_product(M + first * r, r, -1.0, factor + end * n + first, 1, n, M + end * r, r, end - first, n - end, r);
        for (int i = end - 2; i >= first; --i)
            add_rows(M + i * r, -1.0, factor + (i + 1) * n + i, n, M + (i + 1) * r, r, end - 1 - i, r);
    }
    for (int k = n - 1; k >= 0; --k) exchange(M, r, k, (int)swaps[k]);
}

/* The same for M' (r x n), whose rows move by those of the factors. */
INLINE void divide_few(const double *RESTRICT factor, const double *RESTRICT swaps, int n, int r, double *RESTRICT M) {
    for (int c = 0; c < r; ++c) {
        double *RESTRICT own = M + c * n;
        for (int i = 0; i < n; ++i) {
            const double *RESTRICT row = factor + i * n;
            const double share = own[i] /= row[i];
            for (int j = i + 1; j < n; ++j) own[j] -= share * row[j];
        }
        for (int i = n - 1; i > 0; --i) {
            const double *RESTRICT row = factor + i * n;
            const double share = own[i];
            for (int j = 0; j < i; ++j) own[j] -= share * row[j];
        }
        for (int k = n - 1; k >= 0; --k) {
            const int other = (int)swaps[k];
            const double kept = own[k];
            own[k] = own[other], own[other] = kept;
        }
    }
}

/* -1/2 (J left) right' at the nonzeros, both (2n x r). */
INLINE void nonzeros_by(
    const int r, const Passage *p, int n, const double *RESTRICT left, const double *RESTRICT right,
    double *RESTRICT slopes
) {
    for (int q = 0; q < p->nnz; ++q) {
        const int i = p->row[q];
        const double *RESTRICT one = left + (i < n ? i + n : i - n) * r, *RESTRICT other = right + p->col[q] * r;
        slopes[q] = (i < n ? -0.5 : 0.5) * dot(one, other, r);
    }
}

static void at_nonzeros(const Passage *p, int n, int r, const double *left, const double *right, double *slopes) {
    BY_WIDTH(nonzeros_by, r, p, n, left, right, slopes);
}

/* P += the slopes of one step's result. */
INLINE void add_seed(int n, const double *RESTRICT seed, double *RESTRICT P) {
    for (int j = 0, t = 0; j < n; ++j)
        for (int i = j; i < n; ++i, ++t) {
            P[i * n + j] += i == j ? seed[t] : 0.5 * seed[t];
            if (i != j) P[j * n + i] += 0.5 * seed[t];
        }
}

/* X^-1 P X^-T, symmetric. */
static void congruent(const Passage *p, int n, int k, double *RESTRICT P, double *RESTRICT spare) {
    const double *factor = p->factor + (size_t)k * n * n;
    const double *swaps = p->swaps + (size_t)k * n;
    divide(factor, swaps, n, n, P);
    turn(P, n, n, n, spare, n);
    divide(factor, swaps, n, n, spare);
    turn(spare, n, n, n, P, n);
    for (int i = 0; i < n * n; ++i) P[i] = 0.5 * (P[i] + spare[i]);
}

/* What follows has the slopes P as a matrix (few = 0) or as M C M' with few columns; M' (few x n) is kept. */
typedef struct {
    int few, any;
    double *P, *M, *C;
} Slopes;

static void write_out(Slopes *s, int n, double *RESTRICT P) {
    const int r = s->few;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j <= i; ++j) {
            double sum = 0.0;
            for (int a = 0; a < r; ++a)
                for (int b = 0; b < r; ++b) sum += s->M[a * n + i] * s->C[a * r + b] * s->M[b * n + j];
            P[i * n + j] = P[j * n + i] = sum;
        }
}

/* Whether some number is not zero; none where there are none. */
static int is_asked(const double *seed, int half) {
    int any = 0;
    for (int t = 0; seed && t < half && !any; t += 64)
        for (int i = t; i < half && i < t + 64; ++i) any |= seed[i] != 0.0;
    return any;
}

/* The slopes of one step's result join those of what comes after; `rows`: n to work in. */
static void join(Slopes *s, int n, int *RESTRICT rows, const double *RESTRICT seed) {
    const int half = n * (n + 1) / 2;
    if (!is_asked(seed, half)) return;
    if (!s->any) {
        int r = 0;
        memset(s->P, 0, sizeof(double) * n * n);
        for (int j = 0, t = 0; j < n; ++j)
            for (int i = j; i < n; ++i, ++t) s->P[i * n + j] = s->P[j * n + i] = i == j ? seed[t] : 0.5 * seed[t];
        memset(s->M, 0, sizeof(double) * n * n);
        for (int i = 0; i < n; ++i) {
            int used = 0;
            for (int j = 0; j < n && !used; ++j) used = s->P[i * n + j] != 0.0;
            if (used) rows[r++] = i;
        }
        s->any = 1;
        s->few = 3 * r > n ? 0 : r;
        if (!s->few) return;
        for (int a = 0; a < r; ++a) s->M[a * n + rows[a]] = 1.0;
        for (int a = 0; a < r; ++a)
            for (int b = 0; b < r; ++b) s->C[a * r + b] = s->P[rows[a] * n + rows[b]];
        return;
    }
    if (s->few) write_out(s, n, s->P), s->few = 0;
    add_seed(n, seed, s->P);
}

static void pack_slopes(Slopes *s, int n, double *RESTRICT spare, double *RESTRICT half) {
    double *P = s->P;
    if (!s->any) {
        memset(half, 0, sizeof(double) * n * (n + 1) / 2);
        return;
    }
    if (s->few) write_out(s, n, P = spare);
    for (int j = 0, t = 0; j < n; ++j)
        for (int i = j; i < n; ++i, ++t) half[t] = i == j ? P[i * n + j] : P[i * n + j] + P[j * n + i];
}

/* Slopes by H at one point, from its stage times M, (2n x r); weighted: as large. */
INLINE void slopes_by(
    const int r, const Passage *p, int n, const double *C, const double *y, double *RESTRICT weighted, double *out
) {
    for (int i = 0; i < 2 * n; ++i)
        for (int c = 0; c < r; ++c) {
            double sum = 0.0;
            for (int q = 0; q < r; ++q) sum += y[i * r + q] * C[q * r + c];
            weighted[i * r + c] = sum;
        }
    nonzeros_by(r, p, n, y, weighted, out);
}

static void slopes_few(const Passage *p, int n, int r, const double *C, const double *y, double *weighted, double *out) {
    BY_WIDTH(slopes_by, r, p, n, C, y, weighted, out);
}

/* Slopes before step k and by its H: few columns; `before`: half-vector there. */
INLINE void back_few(
    const Passage *p, int n, const int r, int k, Slopes *s, const double *before, double *spare, double *s1, double *s2
) {
    const size_t square = (size_t)n * n, tall = (size_t)2 * n * r, own = spot(p, k);
    double *y = spare, *weighted = y + 2 * tall, *E = p->work + 16 * square;
    divide_few(p->factor + own * square, p->swaps + own * n, n, r, s->M);
    const int steady = !p->full && is_steady(p, k);
    if (steady) {
        stacked(n, r, before, s->M, weighted, weighted + tall);
        few_stages(p, n, r, k, weighted, y, y + tall);
    } else if (!p->full) { /* all stages once more */
        spread(before, n, E);
        step(p, n, k, E);
    }
    const size_t place = p->full ? (size_t)k : 0;
    for (int stage = 0; stage < 2; ++stage, y += tall) {
        double *out = stage ? s2 : s1;
        if (!out) continue;
        if (!steady) product_turned((stage ? p->stage2 : p->stage1) + place * 2 * square, s->M, 2 * n, n, r, y);
        slopes_few(p, n, r, s->C, y, weighted, out);
    }
}

/* The same, faster where the columns are as few as they mostly are. */
static void back_few_of(
    const Passage *p, int n, int k, Slopes *s, const double *before, double *spare, double *s1, double *s2
) {
    if (s->few == 1)
        back_few(p, n, 1, k, s, before, spare, s1, s2);
    else if (s->few == 2)
        back_few(p, n, 2, k, s, before, spare, s1, s2);
    else
        back_few(p, n, s->few, k, s, before, spare, s1, s2);
}

/* The same with all of P. */
static void back_all(const Passage *p, int n, int k, Slopes *s, double *RESTRICT spare, double *s1, double *s2) {
    congruent(p, n, k, s->P, spare);
    for (int stage = 0; stage < 2; ++stage) {
        const double *Y = (stage ? p->stage2 : p->stage1) + (size_t)k * 2 * n * n;
        if (!(stage ? s2 : s1)) continue;
        product(Y, s->P, 2 * n, n, n, spare);
        at_nonzeros(p, n, n, spare, Y, stage ? s2 : s1);
    }
}

/* Half-vector of slopes by a symmetric (r x r) matrix: both places move with one entry. */
static void pack_noise(const double *RESTRICT slope, int r, double *RESTRICT half) {
    for (int j = 0, t = 0; j < r; ++j)
        for (int i = j; i < r; ++i, ++t) half[t] = i == j ? slope[i * r + j] : slope[i * r + j] + slope[j * r + i];
}

/* Slopes before a reading and by what tells of it: few columns, or all of P. */
static void back_reading(const Passage *p, int n, int j, Slopes *s, double *RESTRICT spare, double *by_told) {
    const int r = p->r, few = s->few;
    const size_t square = (size_t)n * n, tall = (size_t)r * n;
    const double *K = p->gain + j * tall, *A = p->keep + j * square;
    if (by_told) {
        double *fed = aside(p), *seen = fed + tall;
        double *P = s->P;
        if (few) write_out(s, n, P = spare);
        turned_product(K, P, r, n, n, fed); /* K' P+ */
        product(fed, p->reached + j * square, r, n, n, by_told);
        for (size_t i = 0; i < tall; ++i) by_told[i] *= -2.0;
        product(fed, K, r, n, r, seen);
        pack_noise(seen, r, by_told + tall);
    }
    if (few) {
        product(s->M, A, few, n, n, spare);
        memcpy(s->M, spare, sizeof(double) * n * few);
        return;
    }
    turned_product(A, s->P, n, n, n, spare);
    product(spare, A, n, n, n, s->P);
}

/* Slopes at the steps of a passage from its `first` half-vector on. */
static void back(
    const Passage *p, int n, const double *first, const double *seed, double *by_first, double *by_h1, double *by_h2,
    double *by_told, double *by_kicks
) {
    const size_t half = (size_t)n * (n + 1) / 2, nnz = p->nnz, tells = telling(p), square = (size_t)n * n;
    double *spare = p->work, *P = spare + 14 * square, *M = P + square, *C = M + square / 2;
    Slopes s = {0, 0, P, M, C};
    for (int at = p->count - 1; at >= 0; --at) {
        const int k = p->place[at];
        if (at_end(p, at)) {
            join(&s, n, p->chosen, seed + at / p->every * half);
            if (by_kicks) pack_slopes(&s, n, spare, by_kicks + at / p->every * half);
        }
        if (k < 0) {
            double *own = by_told ? by_told + (-1 - k) * tells : NULL;
            if (s.any)
                back_reading(p, n, -1 - k, &s, spare, own);
            else if (own)
                memset(own, 0, sizeof(double) * tells);
            continue;
        }
        double *s1 = by_h1 ? by_h1 + k * nnz : NULL, *s2 = by_h2 ? by_h2 + k * nnz : NULL;
        if (!s.any) {
            if (s1) memset(s1, 0, sizeof(double) * nnz);
            if (s2) memset(s2, 0, sizeof(double) * nnz);
            continue;
        }
        if (!s.few) {
            back_all(p, n, k, &s, spare, s1, s2);
            continue;
        }
        const double *before = at ? p->after + (at - 1) * half : first;
        back_few_of(p, n, k, &s, before, spare, s1, s2);
    }
    if (by_first) pack_slopes(&s, n, spare, by_first);
}
