/* Slopes of few entries where nothing is kept of the steps but the half-vectors that are wanted.
 *
 * Between these v = [M; E M] passes back by itself, v = D^-1 v+, and the stages Y M are had from it. With S the matrix of
 * the system, whose factors are made once more,
 *
 *     D = I + ((I - g H1) S^-1 (I - g H2) - I)/a,   D^-1 = -J D' J.
 *
 * What D v is off v+ is passed back too: so the errors of a step are those of a solution by D. Errors of E M against E
 * and M grow on the way back as those of variances fall on the way there: at the next half-vector they are measured.
 * Where they are no rounding, much is measured or a system is poor, the steps of the interval are taken once more and
 * kept, and its slopes are those of few.h.
 */

/* Errors of (E M)_i, against the square root of E_ii times M' E M, that are rounding. */
static const double ROUNDING = 1e-12;

/* S'^-1 B in place, few columns. */
INLINE void solve_turned_by(const int r, const Passage *p, int n, const double *factors, double *RESTRICT B) {
    const int m = 2 * n, filled = p->right[m];
    const double *lower = factors, *upper = lower + filled, *inverses = upper + filled;
    for (int i = 0; i < m; ++i) {
        double *own = B + p->order[i] * r;
        for (int c = 0; c < r; ++c) own[c] *= inverses[i];
        for (int q = p->right[i]; q < p->right[i + 1]; ++q)
            for (int c = 0; c < r; ++c) B[p->behind[q] * r + c] -= upper[q] * own[c];
    }
    for (int i = m - 1; i >= 0; --i) {
        const double *own = B + p->order[i] * r;
        for (int q = p->left[i]; q < p->left[i + 1]; ++q)
            for (int c = 0; c < r; ++c) B[p->before[q] * r + c] -= lower[q] * own[c];
    }
}

static void solve_few_turned(const Passage *p, int n, int r, const double *factors, double *B) {
    BY_WIDTH(solve_turned_by, r, p, n, factors, B);
}

/* B (2n x r) <- (I - g H)' A. */
INLINE void moves_turned_by(
    const int r, const Passage *p, int n, const double *h, const double *RESTRICT A, double *RESTRICT B
) {
    memcpy(B, A, sizeof(double) * 2 * n * r);
    for (int q = 0; q < p->nnz; ++q) {
        const double share = GAP * h[q];
        for (int c = 0; c < r; ++c) B[p->col[q] * r + c] -= share * A[p->row[q] * r + c];
    }
}

static void moved_by_turned(const Passage *p, int n, int r, const double *h, const double *A, double *B) {
    BY_WIDTH(moves_turned_by, r, p, n, h, A, B);
}

/* v += D^-1 w of step k, both (2n x r); spare: 6 n r. */
static void add_passed_back(
    const Passage *p, int n, const int r, int k, const double *RESTRICT w, double *spare, double *RESTRICT v
) {
    const int half = n * r;
    double *turned = spare, *one = turned + 2 * half, *other = one + 2 * half; /* of J w */
    for (int i = 0; i < half; ++i) turned[i] = w[half + i], turned[half + i] = -w[i];
    moved_by_turned(p, n, r, p->h1 + (size_t)k * p->nnz, turned, one);
    solve_few_turned(p, n, r, factors_of(p, k), one);
    moved_by_turned(p, n, r, p->h2 + (size_t)k * p->nnz, one, other);
    for (int i = 0; i < 2 * half; ++i) turned[i] += (other[i] - turned[i]) / SHARE;
    for (int i = 0; i < half; ++i) v[i] -= turned[half + i], v[half + i] += turned[i];
}

/* Step k back: v (2n x r) becomes what it was before it; slopes by H. spare: 14 n r. */
INLINE void back_alone(
    const Passage *p, int n, const int r, int k, const double *C, double *RESTRICT v, double *spare, double *s1, double *s2
) {
    const int tall = 2 * n * r;
    double *RESTRICT w = spare, *y1 = w + tall, *y2 = y1 + tall, *more = y2 + tall;
    memcpy(w, v, sizeof(double) * tall);
    memset(v, 0, sizeof(double) * tall);
    add_passed_back(p, n, r, k, w, more, v);
    few_stages(p, n, r, k, v, y1, y2);
    for (int i = 0; i < tall; ++i) w[i] -= v[i] + (y2[i] - y1[i]) / (2.0 * GAP);
    add_passed_back(p, n, r, k, w, more, v);
    few_stages(p, n, r, k, v, y1, y2);
    if (s1) slopes_few(p, n, r, C, y1, more, s1);
    if (s2) slopes_few(p, n, r, C, y2, more, s2);
}

/* Makes the systems beside that of step k triangular, unless they are. */
static void factorize_beside(const Passage *p, int k, int *ready) {
    const int first = k - k % p->lanes;
    if (*ready != first) factorize(p, *ready = first);
}

/* Whether v = [M; E M] holds, E by its half-vector; M' <- that of v. spare: 2 n. */
static int is_consistent(int n, int r, const double *half, const double *v, double *RESTRICT M, double *spare) {
    double *column = spare, *sizes = spare + n;
    for (int i = 0, t = 0; i < n; t += n - i, ++i) sizes[i] = half[t];
    for (int c = 0; c < r; ++c) {
        double *own = M + c * n, total = 0.0;
        for (int i = 0; i < n; ++i) own[i] = v[i * r + c];
        by_half(half, n, own, column);
        for (int i = 0; i < n; ++i) total += own[i] * column[i];
        for (int i = 0; i < n; ++i)
            if (!(fabs(v[(n + i) * r + c] - column[i]) <= ROUNDING * sqrt(fabs(sizes[i] * total)))) return 0;
    }
    return 1;
}

/* Slopes at the moves of one interval: half-vectors where it begins, where it ends, and what was added there, or NULL. */
typedef struct {
    int first; /* its first step */
    const double *begin, *end, *kick;
    double *by_h1, *by_h2, *by_told; /* of the whole passage; NULL: not wanted */
} Interval;

/* Where slopes of step k are; NULL: not wanted. */
INLINE double *slope_of(double *all, int k, size_t each) { return all ? all + (size_t)k * each : NULL; }

/* The interval back by its systems alone; M' stays where it is not consistent. Whether it is. */
INLINE int alone(const Passage *p, int n, const int r, const Interval *own, Slopes *s, double *spare, int *ready) {
    const int tall = 2 * n * r;
    double *v = spare, *more = v + tall;
    stacked(n, r, own->end, s->M, v, more);
    for (int c = 0; own->kick && c < r; ++c) {
        by_half(own->kick, n, s->M + c * n, more);
        for (int i = 0; i < n; ++i) v[(n + i) * r + c] -= more[i];
    }
    for (int at = own->first + p->every - 1; at >= own->first; --at) {
        const int k = p->place[at];
        factorize_beside(p, k, ready);
        back_alone(p, n, r, k, s->C, v, more, slope_of(own->by_h1, k, p->nnz), slope_of(own->by_h2, k, p->nnz));
    }
    if (!is_consistent(n, r, own->begin, v, more, more + n * r)) return 0;
    memcpy(s->M, more, sizeof(double) * n * r);
    return 1;
}

/* The same, faster where the columns are as few as they mostly are. */
static int alone_of(const Passage *p, int n, const Interval *own, Slopes *s, double *spare, int *ready) {
    if (s->few == 1) return alone(p, n, 1, own, s, spare, ready);
    if (s->few == 2) return alone(p, n, 2, own, s, spare, ready);
    return alone(p, n, s->few, own, s, spare, ready);
}

/* The interval back from its steps, which are taken once more. */
static void again(Passage *p, int n, const Interval *own, Slopes *s, double *spare, int *ready) {
    const size_t half = (size_t)n * (n + 1) / 2;
    double *E = p->work + 16 * (size_t)n * n;
    spread(own->begin, n, E);
    for (int j = 0; j < p->every; ++j) {
        const int at = own->first + j;
        half_of(E, n, p->inside + j * half);
        if (p->place[at] >= 0) factorize_beside(p, p->place[at], ready);
        passed_step(p, n, at, E);
    }
    for (int j = p->every - 1; j >= 0; --j) {
        const int k = p->place[own->first + j];
        if (k < 0) {
            back_reading(p, n, -1 - k, s, spare, slope_of(own->by_told, -1 - k, telling(p)));
            continue;
        }
        factorize_beside(p, k, ready);
        back_few_of(p, n, k, s, p->inside + j * half, spare, slope_of(own->by_h1, k, p->nnz),
                    slope_of(own->by_h2, k, p->nnz));
    }
}

/* No slopes at the steps of an interval after which nothing is asked. */
static void without(const Passage *p, const Interval *own) {
    for (int at = own->first; at < own->first + p->every; ++at) {
        const int k = p->place[at];
        const size_t each = k < 0 ? telling(p) : (size_t)p->nnz;
        double *ones[2] = {k < 0 ? slope_of(own->by_told, -1 - k, each) : slope_of(own->by_h1, k, each),
                           k < 0 ? NULL : slope_of(own->by_h2, k, each)};
        for (int i = 0; i < 2; ++i)
            if (ones[i]) memset(ones[i], 0, sizeof(double) * each);
    }
}

/* What `back` does, for slopes of few columns; kicks: that the passage was run with, NULL: none. */
static void back_thin(
    Passage *p, int n, const double *first, const double *kicks, const double *seed, double *by_first, double *by_h1,
    double *by_h2, double *by_told, double *by_kicks
) {
    const size_t half = (size_t)n * (n + 1) / 2, square = (size_t)n * n;
    double *spare = p->work, *P = spare + 14 * square, *M = P + square;
    Slopes s = {0, 0, P, M, M + square / 2};
    int ready = -1;
    for (int e = p->ends - 1; e >= 0; --e) {
        const Interval own = {e * p->every, e ? p->after + (e - 1) * half : first, p->after + e * half,
                              kicks ? kicks + e * half : NULL, by_h1, by_h2, by_told};
        join(&s, n, p->chosen, seed + e * half);
        if (by_kicks) pack_slopes(&s, n, spare, by_kicks + e * half);
        if (!s.any)
            without(p, &own);
        else if (p->hard[e] || !alone_of(p, n, &own, &s, spare, &ready))
            again(p, n, &own, &s, spare, &ready);
    }
    if (by_first) pack_slopes(&s, n, spare, by_first);
}
