/* Tangents of the passage, and of its slopes. */
/* X' M = B solved in place, B (n x n); X' = P' L U. */
static void divide_transposed(const double *RESTRICT factor, const double *RESTRICT swaps, int n, double *RESTRICT B) {
    for (int k = 0; k < n; ++k) exchange(B, n, k, (int)swaps[k]);
    for (int first = 0, end; first < n; first = end) {
        end = first + PANEL < n ? first + PANEL : n;
        add_product(B + first * n, n, -1.0, factor + first * n, n, 1, B, n, end - first, first, n);
        for (int i = first + 1; i < end; ++i)
            add_rows(B + i * n, -1.0, factor + i * n + first, 1, B + first * n, n, i - first, n);
    }
    for (int end = n, first; end > 0; end = first) {
        first = end > PANEL ? end - PANEL : 0;
        add_product(B + first * n, n, -1.0, factor + first * n + end, n, 1, B + end * n, n, end - first, n - end, n);
        for (int i = end - 1; i >= first; --i) {
            double *RESTRICT own = B + i * n;
            add_rows(own, -1.0, factor + i * n + i + 1, 1, B + (i + 1) * n, n, end - 1 - i, n);
            const double inverse = 1.0 / factor[i * n + i];
            for (int c = 0; c < n; ++c) own[c] *= inverse;
        }
    }
}

/* product += share H Y of a matrix H by its nonzeros, Y (2n x n). */
static void add_sparse(
    const Passage *p, int n, double share, const double *RESTRICT h, const double *RESTRICT Y, double *RESTRICT product
) {
    for (int q = 0; q < p->nnz; ++q) {
        const double weight = share * h[q];
        double *RESTRICT own = product + p->row[q] * n;
        const double *RESTRICT other = Y + p->col[q] * n;
        for (int j = 0; j < n; ++j) own[j] += weight * other[j];
    }
}

/* [top; E], top the identity or zero. */
static void stack(int n, int identity, const double *RESTRICT E, double *RESTRICT Z) {
    memset(Z, 0, sizeof(double) * n * n);
    for (int i = 0; identity && i < n; ++i) Z[i * n + i] = 1.0;
    memcpy(Z + n * n, E, sizeof(double) * n * n);
}

/* The tangent of one step: dE becomes that after it; those of the stages and of X are kept. */
static void tangent_step(
    Kept *kept, int n, int k, const double *E, const double *next, const double *d1, const double *d2,
    double *RESTRICT dE, double *RESTRICT spare
) {
    const Passage *p = &kept->p;
    const int m = 2 * n, w = 3 * n;
    const double *h1 = p->h1 + (size_t)k * p->nnz, *h2 = p->h2 + (size_t)k * p->nnz;
    const double *RESTRICT Y1 = p->stage1 + (size_t)k * m * n;
    double *RESTRICT dY1 = kept->moved + (size_t)k * 5 * n * n, *RESTRICT dY2 = dY1 + m * n, *RESTRICT dX = dY2 + m * n;
    double *RESTRICT a = p->work, *RESTRICT Z = spare, *RESTRICT dZ = Z + m * n, *RESTRICT inner = dZ + m * n;
    double *RESTRICT right = inner + m * n;
    stack(n, 1, E, Z);
    stack(n, 0, dE, dZ);
    memcpy(right, dZ, sizeof(double) * m * n); /* the tangent of (I - g H2) Z0 - A Y1, Y1 held */
    add_sparse(p, n, -GAP, h2, dZ, right);
    add_sparse(p, n, -GAP, d2, Z, right);
    add_sparse(p, n, 0.25, d1, Y1, right);
    add_sparse(p, n, 0.25, d2, Y1, right);
    memset(inner, 0, sizeof(double) * m * n);
    add_sparse(p, n, 1.0, h1, Y1, inner);
    add_sparse(p, n, -1.0 / 12.0, d2, inner, right);
    memset(inner, 0, sizeof(double) * m * n);
    add_sparse(p, n, 1.0, d1, Y1, inner);
    add_sparse(p, n, -1.0 / 12.0, h2, inner, right);
    memcpy(dY1, right, sizeof(double) * m * n);
    if (is_steady(p, k))
        solve_sparse(p, n, k, n, dY1);
    else {
        solve_full(p, n, k, E, w, right, a);
        for (int i = 0; i < m; ++i) memcpy(dY1 + i * n, a + i * w + m, sizeof(double) * n);
    }
    memcpy(inner, dY1, sizeof(double) * m * n); /* dV = (dY1 - g (dH1 Y1 + H1 dY1) - dZ0)/a */
    add_sparse(p, n, -GAP, d1, Y1, inner);
    add_sparse(p, n, -GAP, h1, dY1, inner);
    for (int i = 0; i < m * n; ++i) inner[i] = (inner[i] - dZ[i]) / SHARE, dY2[i] = dY1[i] + 2.0 * GAP * inner[i];
    memcpy(dX, inner, sizeof(double) * n * n);
    product(next, dX, n, n, n, Z);
    for (int i = 0; i < n * n; ++i) Z[i] = dE[i] + inner[n * n + i] - Z[i]; /* dE+ X = dY - E+ dX, transposed */
    turn(Z, n, n, n, right, n);
    divide_transposed(p->factor + (size_t)k * n * n, p->swaps + (size_t)k * n, n, right);
    symmetric_part(right, n, n, Z, dE);
}

/* The tangent of what reading j does: dE becomes that after it; those of K, A and E+ are kept. */
static void tangent_reading(Kept *kept, int n, int j, const double *E, const double *d_told, double *RESTRICT dE) {
    const Passage *p = &kept->p;
    const int r = p->r;
    const size_t square = (size_t)n * n, tall = (size_t)r * n, wide = (size_t)r * r;
    const double *M = p->told + j * telling(p), *dM = d_told, *K = p->gain + j * tall, *A = p->keep + j * square;
    const double *after = p->reached + j * square, *S = p->inverse + j * wide;
    double *dK = kept->turned + j * (tall + 2 * square), *dA = dK + tall, *dAfter = dA + square;
    double *one = aside(p), *two = one + tall, *three = two + tall, *noise = three + tall, *other = noise + wide;
    double *spare = p->work, *more = spare + square;
    spread(d_told + tall, r, noise); /* dR */
    product(A, dE, n, n, n, spare);
    product_turned(spare, A, n, n, n, dAfter); /* A dE A' */
    product_turned(spare, M, n, n, r, one);    /* dK S = A dE M' + E+ dM' - K (dM E M' + dR) */
    product_turned(after, dM, n, n, r, two);
    for (size_t i = 0; i < tall; ++i) one[i] += two[i];
    product(dM, E, r, n, n, three);
    product_turned(three, M, r, n, r, other);
    for (size_t i = 0; i < wide; ++i) other[i] += noise[i];
    product(K, other, n, r, r, three);
    for (size_t i = 0; i < tall; ++i) one[i] -= three[i];
    product(one, S, n, r, r, dK);
    product(K, noise, n, r, r, one); /* K dR K' - K dM E+ and its transpose */
    product_turned(one, K, n, r, n, spare);
    product_turned(K, two, n, r, n, more);
    for (int i = 0; i < n; ++i)
        for (int c = 0; c < n; ++c)
            dAfter[i * n + c] += spare[i * n + c] - more[i * n + c] - more[c * n + i];
    product(dK, M, n, r, n, dA);
    product(K, dM, n, r, n, spare);
    for (size_t i = 0; i < square; ++i) dA[i] = -dA[i] - spare[i];
    for (int i = 0; i < n; ++i)
        for (int c = 0; c < n; ++c) dE[i * n + c] = 0.5 * (dAfter[i * n + c] + dAfter[c * n + i]);
    memcpy(dAfter, dE, sizeof(double) * square);
}

/* Keep one part of a direction: whether it was the same before. */
static int same(double **kept, const double *given, size_t count) {
    double *own = *kept;
    *kept += count;
    if (!given || !memcmp(own, given, sizeof(double) * count)) return 1;
    memcpy(own, given, sizeof(double) * count);
    return 0;
}

/* Tangents along the passage, of the half-vectors after each step too; those along the last direction are known. */
static void tangents(
    Kept *kept, int n, const double *d_first, const double *d1, const double *d2, const double *d_told,
    const double *d_kicks
) {
    const Passage *p = &kept->p;
    const size_t half = (size_t)n * (n + 1) / 2, nnz = p->nnz;
    double *last = kept->direction, *d_after = kept->shifted;
    int known = kept->along == (d_kicks ? 2 : 1);
    known &= same(&last, d_first, half);
    known &= same(&last, d1, nnz * p->moves);
    known &= same(&last, d2, nnz * p->moves);
    known &= same(&last, d_told, telling(p) * p->reads);
    known &= same(&last, d_kicks, half * p->ends);
    if (known) return;
    kept->along = d_kicks ? 2 : 1;
    double *E = p->work + 14 * n * n, *next = p->work + 15 * n * n, *spare = p->work + 6 * n * n, *dE = p->work + 16 * n * n;
    spread(kept->first, n, E);
    spread(d_first, n, dE);
    for (int k = 0; k < p->count; ++k) {
        const double *after = p->after + k * half;
        const int wanted = at_end(p, k);
        const size_t column = k / p->every * half;
        spread(after, n, next);
        if (kept->known == 2 && wanted)
            for (int j = 0, t = 0; j < n; ++j)
                for (int i = j; i < n; ++i, ++t)
                    next[i * n + j] = next[j * n + i] = after[t] - kept->kicks[column + t];
        const int place = p->place[k];
        if (place < 0)
            tangent_reading(kept, n, -1 - place, E, d_told + (-1 - place) * telling(p), dE);
        else {
            if (!p->brief) factorize(p, place);
            tangent_step(kept, n, place, E, next, d1 + place * nnz, d2 + place * nnz, dE, spare);
        }
        spread(after, n, E);
        if (!wanted) continue;
        if (d_kicks)
            for (int j = 0, t = 0; j < n; ++j)
                for (int i = j; i < n; ++i, ++t) {
                    dE[i * n + j] += d_kicks[column + t];
                    if (i != j) dE[j * n + i] += d_kicks[column + t];
                }
        for (int j = 0, t = 0; j < n; ++j)
            for (int i = j; i < n; ++i, ++t) d_after[column + t] = dE[i * n + j];
    }
}

/* How the slopes at reading j move: P and dP become those before it. */
static void back_reading_tangent(
    const Kept *kept, int n, int j, double *RESTRICT P, double *RESTRICT dP, double *RESTRICT spare, double *d_by_told
) {
    const Passage *p = &kept->p;
    const int r = p->r;
    const size_t square = (size_t)n * n, tall = (size_t)r * n, wide = (size_t)r * r;
    const double *K = p->gain + j * tall, *A = p->keep + j * square, *after = p->reached + j * square;
    const double *dK = kept->turned + j * (tall + 2 * square), *dA = dK + tall, *dAfter = dA + square;
    double *more = spare + square;
    if (d_by_told) {
        double *fed = aside(p), *moved = fed + tall, *other = moved + tall, *noise = other + tall, *part = noise + wide;
        turned_product(K, P, r, n, n, fed); /* K' P+, and its tangent dK' P+ + K' dP+ */
        turned_product(dK, P, r, n, n, moved);
        turned_product(K, dP, r, n, n, other);
        for (size_t i = 0; i < tall; ++i) moved[i] += other[i];
        product(moved, K, r, n, r, noise);
        product(fed, dK, r, n, r, part);
        for (size_t i = 0; i < wide; ++i) noise[i] += part[i];
        pack_noise(noise, r, d_by_told + tall);
        product(moved, after, r, n, n, d_by_told);
        product(fed, dAfter, r, n, n, other);
        for (size_t i = 0; i < tall; ++i) d_by_told[i] = -2.0 * (d_by_told[i] + other[i]);
    }
    turned_product(A, dP, n, n, n, spare); /* A' dP+ A + A' P+ dA + its transpose */
    product(spare, A, n, n, n, dP);
    turned_product(A, P, n, n, n, spare);
    product(spare, dA, n, n, n, more);
    for (int i = 0; i < n; ++i)
        for (int c = 0; c < n; ++c) dP[i * n + c] += more[i * n + c] + more[c * n + i];
    product(spare, A, n, n, n, P);
}

/* Slopes and their tangents: P and dP, or P = M C M' and dP = dM C M' + M C dM' with few columns; dM' (few x n) is kept. */
typedef struct {
    Slopes s;
    double *dP, *dM;
} Moved;

static void write_out_tangent(const Moved *v, int n, double *RESTRICT dP) {
    const int r = v->s.few;
    const double *C = v->s.C;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j <= i; ++j) {
            double sum = 0.0;
            for (int a = 0; a < r; ++a)
                for (int b = 0; b < r; ++b) {
                    const double *M = v->s.M + b * n, *one = v->s.M + a * n, *dM = v->dM + a * n;
                    sum += C[a * r + b] * (dM[i] * M[j] + one[i] * v->dM[b * n + j]);
                }
            dP[i * n + j] = dP[j * n + i] = sum;
        }
}

/* All of P and dP from here on. */
static void write_both(Moved *v, int n) {
    if (!v->s.few) return;
    write_out(&v->s, n, v->s.P);
    write_out_tangent(v, n, v->dP);
    v->s.few = 0;
}

/* `join` with tangents of the seeds. */
static void join_tangents(Moved *v, int n, int *rows, const double *seed, const double *d_seed) {
    const int half = n * (n + 1) / 2;
    const size_t square = sizeof(double) * n * n;
    const int moved = is_asked(d_seed, half);
    if (!moved && !is_asked(seed, half)) return;
    if (!v->s.any) {
        memset(v->dP, 0, square), memset(v->dM, 0, square), memset(v->s.P, 0, square);
        if (!moved) {
            join(&v->s, n, rows, seed);
            return;
        }
        v->s.any = 1;
    }
    write_both(v, n);
    add_seed(n, seed, v->s.P);
    if (moved) add_seed(n, d_seed, v->dP);
}

/* Tangents of slopes before a step and by its H: few columns. */
static void few_tangents(const Kept *kept, int n, int k, Moved *v, double *RESTRICT spare, double *out1, double *out2) {
    const Passage *p = &kept->p;
    const int r = v->s.few, m = 2 * n;
    const double *factor = p->factor + (size_t)k * n * n, *swaps = p->swaps + (size_t)k * n, *C = v->s.C;
    const double *moved = kept->moved + (size_t)k * 5 * n * n, *dX = moved + 2 * m * n;
    double *M = v->s.M, *dM = v->dM, *y = spare, *dy = y + m * r, *weighted = dy + m * r, *turned = weighted + m * r;
    divide_few(factor, swaps, n, r, M);
    for (int c = 0; c < r; ++c)
        for (int i = 0; i < n; ++i) dM[c * n + i] -= dot(dX + (size_t)i * n, M + c * n, n); /* X dM = dM+ - dX M */
    divide_few(factor, swaps, n, r, dM);
    for (int stage = 0; stage < 2; ++stage) {
        const double *Y = (stage ? p->stage2 : p->stage1) + (size_t)k * m * n, *dY = moved + stage * m * n;
        double *out = stage ? out2 : out1, *other = turned + m * r;
        if (!out) continue;
        product_turned(Y, M, m, n, r, y);
        product_turned(dY, M, m, n, r, dy);
        product_turned(Y, dM, m, n, r, weighted);
        for (int i = 0; i < m * r; ++i) dy[i] += weighted[i];
        product(y, C, m, r, r, weighted);
        product(dy, C, m, r, r, turned);
        at_nonzeros(p, n, r, dy, weighted, out);
        at_nonzeros(p, n, r, y, turned, other);
        for (int q = 0; q < p->nnz; ++q) out[q] += other[q];
    }
}

/* The same with all of P. */
static void all_tangents(const Kept *kept, int n, int k, Moved *v, double *RESTRICT spare, double *out1, double *out2) {
    const Passage *p = &kept->p;
    const int m = 2 * n;
    const double *moved = kept->moved + (size_t)k * 5 * n * n, *dX = moved + 2 * m * n;
    double *P = v->s.P, *dP = v->dP, *left = spare + m * n, *other = left + m * n, *K = left;
    congruent(p, n, k, P, spare);
    congruent(p, n, k, dP, spare);
    memcpy(K, dX, sizeof(double) * n * n); /* dP -= X^-1 dX P and its transpose */
    divide(p->factor + (size_t)k * n * n, p->swaps + (size_t)k * n, n, n, K);
    product(K, P, n, n, n, spare);
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) dP[i * n + j] -= spare[i * n + j] + spare[j * n + i];
    for (int stage = 0; stage < 2; ++stage) {
        const double *Y = (stage ? p->stage2 : p->stage1) + (size_t)k * m * n, *dY = moved + stage * m * n;
        double *out = stage ? out2 : out1;
        if (!out) continue;
        product(dY, P, m, n, n, left);
        product(Y, dP, m, n, n, spare);
        for (int i = 0; i < m * n; ++i) left[i] += spare[i];
        at_nonzeros(p, n, n, left, Y, out);
        product(Y, P, m, n, n, left);
        at_nonzeros(p, n, n, left, dY, other);
        for (int q = 0; q < p->nnz; ++q) out[q] += other[q];
    }
}

/* Half-vector of the tangents of the slopes. */
static void pack_tangents(const Moved *v, int n, double *RESTRICT spare, double *RESTRICT half) {
    Slopes s = {0, v->s.any, v->s.few ? spare : v->dP, NULL, NULL};
    if (v->s.any && v->s.few) write_out_tangent(v, n, spare);
    pack_slopes(&s, n, spare, half);
}

/* How the slopes of `back` move along the tangents. */
static void back_tangents(
    const Kept *kept, int n, const double *seed, const double *d_seed, double *d_by_first, double *d_by_h1, double *d_by_h2,
    double *d_by_told, double *d_by_kicks
) {
    const Passage *p = &kept->p;
    const size_t square = (size_t)n * n, half = (size_t)n * (n + 1) / 2, nnz = p->nnz, tells = telling(p);
    double *work = p->work, *spare = work + 2 * square;
    Moved v = {{0, 0, work, work + 11 * square, work + 12 * square}, work + square, work + 13 * square};
    for (int at = p->count - 1; at >= 0; --at) {
        const int k = p->place[at];
        const size_t column = at / p->every * half;
        if (at_end(p, at)) {
            join_tangents(&v, n, p->chosen, seed + column, d_seed ? d_seed + column : NULL);
            if (d_by_kicks) pack_tangents(&v, n, spare, d_by_kicks + column);
        }
        if (k < 0) {
            double *own = d_by_told ? d_by_told + (-1 - k) * tells : NULL;
            write_both(&v, n);
            if (v.s.any)
                back_reading_tangent(kept, n, -1 - k, v.s.P, v.dP, spare, own);
            else if (own)
                memset(own, 0, sizeof(double) * tells);
            continue;
        }
        double *out1 = d_by_h1 ? d_by_h1 + k * nnz : NULL, *out2 = d_by_h2 ? d_by_h2 + k * nnz : NULL;
        if (!v.s.any) {
            if (out1) memset(out1, 0, sizeof(double) * nnz);
            if (out2) memset(out2, 0, sizeof(double) * nnz);
        } else
            (v.s.few ? few_tangents : all_tangents)(kept, n, k, &v, spare, out1, out2);
    }
    if (d_by_first) pack_tangents(&v, n, spare, d_by_first);
}
