/* The passage of a covariance through Gauss steps of its Riccati equation, and the exact slopes of what depends on it.
 *
 * E' = F E + E F' + Q - E W E is linear in Z = [X; Y], E = Y X^-1: Z' = H Z, H = [-F' W; Q F]. A step of the two-stage
 * Gauss method takes Z from [I; E] to [X; Y]. With H1, H2 = h H at its two points, g = sqrt(3)/6 and a = 1/2 - 2 g its
 * stages are
 *
 *     [(I - g H2)(I - g H1) - a/2 (H1 + H2)] Y1 = (I - g H2) Z0,   Z+ = Z0 + ((I - g H1) Y1 - Z0)/a,
 *     Y2 = Y1 + 2 g (Z+ - Z0).
 *
 * The method is symplectic and its own adjoint, so that no adjoint system has to be solved: with J = [0 I; -I 0]
 *
 *     dE+ = X^-T dE X^-1,   P = X^-1 P+ X^-T,   slope of tr(P+ E+) by H_i = -1/2 (J Y_i) P Y_i'.
 *
 * A cost on few entries of the last E has P = M C M' with few columns and a constant core C: M = X^-1 M+.
 *
 * How these slopes change along a direction (products with second derivatives) needs one more system a step, that of the
 * tangent of Y1. It holds, as the slopes do, where H and its direction have this form: Q and W symmetric.
 *
 * Some of the steps have no length: there something is read, r values M x with noise of variance R,
 *
 *     K = E M' (M E M' + R)^-1,   A = I - K M,   E+ = A E A' + K R K',   P = A' P+ A,
 *     slope by M = -2 K' P+ E+,   slope by R = K' P+ K,
 *
 * which needs no inverse of R and stays semidefinite however small it is. What is read at once is read one after the
 * other, a step each, r rows at most; rows without entries, of variance 1, read nothing.
 *
 * Half-vectors hold the lower triangle column by column. Slopes by a half-vector are those of its entries: both places
 * of a symmetric matrix move with one entry. The nonzeros of H come column by column, step after step; what is read
 * comes as the rows of M, then the half-vector of R, reading after reading.
 *
 * Nothing here is shared: each `Passage` is used by one thread at a time. It keeps the last point, so that slopes there
 * do not run the passage again.
 */
#define Py_LIMITED_API 0x030b0000
#include <Python.h>

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#define RESTRICT __restrict__
#elif defined(_MSC_VER)
#define INLINE static __forceinline
#define RESTRICT __restrict
#else
#define INLINE static inline
#define RESTRICT
#endif

/* One file for all machines: where the loader can choose, there is a second version for newer processors. */
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define VERSIONS __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define VERSIONS
#endif

static const double GAP = 0.28867513459481287;
static const double SHARE = 0.5 - 2.0 * 0.28867513459481287;
/* Of information times variance in a step, above which the transition is made. */
static const double MUCH = 100.0;

typedef struct {
    int n, nnz, count, known;
    int r, moves, reads, *place; /* of each step among those that move, or -1 - that among those that read */
    int *row, *col;              /* nonzeros of H, column by column */
    int *begin, *across, *which; /* the same row by row: places, columns, positions among them */
    double *first, *h1, *h2;     /* the last point */
    double *kicks;
    double *after;           /* half-vectors there */
    double *stage1, *stage2; /* of every step, 2n x n, row by row */
    double *factor;          /* of every X', n x n */
    int *swaps, *exchanged;
    double *work;
    double *moved; /* tangents of the stages and of X, of every step; NULL until they are asked for */
    double *told;  /* the last point */
    double *gain, *keep, *inverse, *reached; /* of every reading: K, A, (M E M' + R)^-1, E+ */
    double *turned; /* tangents of K, A, E+, of every reading, as `moved` */
    int along;      /* whether these are along the last direction: 1, or 2 with tangents of kicks */
    double *direction, *shifted; /* the last direction; the tangents of the half-vectors along it; as `moved` */
} Passage;

/* Of this source: VERSION in library.py, one more with every change of arguments or of their meaning. */
EXPORT int passage_version(void) { return 3; }

EXPORT void passage_free(Passage *p) {
    if (!p) return;
    void *owned[] = {p->row,   p->col,    p->begin,  p->across, p->which, p->first, p->h1,  p->h2,
                     p->kicks, p->after,  p->stage1, p->stage2, p->factor, p->swaps, p->exchanged,
                     p->work,  p->moved,  p->place,  p->told,   p->gain,  p->keep,  p->inverse, p->reached,
                     p->turned, p->direction, p->shifted};
    for (size_t i = 0; i < sizeof owned / sizeof *owned; ++i) free(owned[i]);
    free(p);
}

static void *room(size_t count, size_t size) { return count > SIZE_MAX / size ? NULL : malloc(count ? count * size : 1); }

/* Numbers that tell of one reading. */
static size_t telling(const Passage *p) { return (size_t)p->r * p->n + (size_t)p->r * (p->r + 1) / 2; }

/* A passage of `count` steps of an n x n covariance, with the pattern of H; NULL where there is no memory.
 *
 * Steps with `read` read up to r rows, the others move; read is NULL where all of them do.
 */
EXPORT Passage *passage_new(int n, int nnz, const int *row, const int *col, int count, int r, const int *read) {
    Passage *p = calloc(1, sizeof *p);
    if (!p) return NULL;
    p->n = n, p->nnz = nnz, p->count = count, p->r = r;
    p->place = room(count, sizeof(int));
    if (!p->place) {
        passage_free(p);
        return NULL;
    }
    for (int k = 0; k < count; ++k) p->place[k] = read && read[k] ? -1 - p->reads++ : p->moves++;
    const size_t d = sizeof(double), all = (size_t)count, steps = (size_t)p->moves, reads = (size_t)p->reads;
    const size_t square = (size_t)n * n, half = square / 2 + n / 2 + 1, tall = (size_t)r * n, wide = (size_t)r * r;
    p->row = room(nnz, sizeof(int)), p->col = room(nnz, sizeof(int)), p->begin = room(2 * n + 1, sizeof(int));
    p->across = room(nnz, sizeof(int)), p->which = room(nnz, sizeof(int)), p->swaps = room(steps * n, sizeof(int));
    p->first = room(half, d), p->h1 = room(steps * nnz, d), p->h2 = room(steps * nnz, d);
    p->kicks = room(all * half, d), p->after = room(all * half, d), p->factor = room(steps * square, d);
    p->stage1 = room(steps * 2 * square, d), p->stage2 = room(steps * 2 * square, d), p->work = room(17 * square + nnz + 4 * (wide + tall), d);
    p->told = room(reads * telling(p), d), p->gain = room(reads * tall, d), p->keep = room(reads * square, d);
    p->inverse = room(reads * wide, d), p->reached = room(reads * square, d);
    p->exchanged = room(2 * n + r, sizeof(int));
    if (!p->row || !p->col || !p->begin || !p->across || !p->which || !p->swaps || !p->first || !p->h1 || !p->h2 ||
        !p->kicks || !p->after || !p->factor || !p->stage1 || !p->stage2 || !p->work || !p->exchanged || !p->told ||
        !p->gain || !p->keep || !p->inverse || !p->reached) {
        passage_free(p);
        return NULL;
    }
    memcpy(p->row, row, sizeof(int) * nnz);
    memcpy(p->col, col, sizeof(int) * nnz);
    int t = 0;
    for (int r = 0; r < 2 * n; ++r) {
        p->begin[r] = t;
        for (int q = 0; q < nnz; ++q)
            if (row[q] == r) p->across[t] = col[q], p->which[t++] = q;
    }
    p->begin[2 * n] = t;
    return p;
}

/* own += sign (sum of share_j B_j) over some rows B_j of B, four at a time; shares lie `step` apart, rows `wide`. */
INLINE void add_rows(
    double *RESTRICT own, double sign, const double *share, int step, const double *B, int wide, int rows, int columns
) {
    int j = 0;
    for (; j + 4 <= rows; j += 4) {
        const double a = sign * share[j * step], b = sign * share[(j + 1) * step], c = sign * share[(j + 2) * step],
                     d = sign * share[(j + 3) * step];
        if (a == 0.0 && b == 0.0 && c == 0.0 && d == 0.0) continue;
        const double *RESTRICT one = B + j * wide, *RESTRICT two = one + wide, *RESTRICT three = two + wide,
                     *RESTRICT four = three + wide;
        for (int i = 0; i < columns; ++i) own[i] += (a * one[i] + b * two[i]) + (c * three[i] + d * four[i]);
    }
    for (; j < rows; ++j) {
        const double a = sign * share[j * step];
        if (a == 0.0) continue;
        const double *RESTRICT one = B + j * wide;
        for (int i = 0; i < columns; ++i) own[i] += a * one[i];
    }
}

/* Columns `begin` to `end` of m rows made triangular with partial pivoting of whole rows of w entries. */
INLINE void panel(double *RESTRICT a, int m, int w, int begin, int end, int *RESTRICT swaps) {
    for (int k = begin; k < end; ++k) {
        int pivot = k;
        double largest = fabs(a[k * w + k]);
        for (int i = k + 1; i < m; ++i) {
            const double size = fabs(a[i * w + k]);
            if (size > largest) largest = size, pivot = i;
        }
        swaps[k] = pivot;
        if (pivot != k)
            for (int j = 0; j < w; ++j) {
                const double kept = a[k * w + j];
                a[k * w + j] = a[pivot * w + j], a[pivot * w + j] = kept;
            }
        const double inverse = 1.0 / a[k * w + k];
        for (int i = k + 1; i < m; ++i) {
            double *own = a + i * w;
            if (own[k] == 0.0) continue;
            own[k] *= inverse;
            for (int j = k + 1; j < end; ++j) own[j] -= own[k] * a[k * w + j];
        }
    }
}

/* The first m of w columns made triangular with partial pivoting (rows that were exchanged: swaps), the others solved. */
INLINE void eliminate(double *RESTRICT a, int m, int w, int *RESTRICT swaps) {
    for (int k = 0; k < m; k += 4) {
        const int end = k + 4 < m ? k + 4 : m;
        panel(a, m, w, k, end, swaps);
        for (int i = k + 1; i < m; ++i)
            add_rows(a + i * w + end, -1.0, a + i * w + k, 1, a + k * w + end, w, (i < end ? i : end) - k, w - end);
    }
    for (int k = m - 1; k >= 0; --k) {
        double *own = a + k * w;
        add_rows(own + m, -1.0, own + k + 1, 1, own + w + m, w, m - 1 - k, w - m);
        const double inverse = 1.0 / own[k];
        for (int j = m; j < w; ++j) own[j] *= inverse;
    }
}

/* Half-vector and square matrix. */
INLINE void spread(const double *RESTRICT half, int n, double *RESTRICT square) {
    for (int j = 0, t = 0; j < n; ++j)
        for (int i = j; i < n; ++i, ++t) square[i * n + j] = square[j * n + i] = half[t];
}

/* I - (H1 + H2)/4 + H2 H1/12 beside I - g H2 (2n columns), or beside (I - g H2) Z0 (n columns). */
INLINE void assemble(const Passage *p, int n, int k, const double *RESTRICT E, int w, double *RESTRICT a) {
    const int m = 2 * n, nnz = p->nnz, transition = w == 2 * m;
    const double *RESTRICT h1 = p->h1 + (size_t)k * nnz, *RESTRICT h2 = p->h2 + (size_t)k * nnz;
    memset(a, 0, sizeof(double) * m * w);
    for (int i = 0; i < m; ++i) a[i * w + i] = 1.0;
    for (int i = 0; i < (transition ? m : n); ++i) a[i * w + m + i] = 1.0;
    if (!transition)
        for (int i = 0; i < n; ++i) memcpy(a + (n + i) * w + m, E + i * n, sizeof(double) * n);
    for (int q = 0; q < nnz; ++q) {
        const int r = p->row[q], c = p->col[q];
        double *RESTRICT own = a + r * w;
        const double share = h2[q] / 12.0, moved = -GAP * h2[q];
        own[c] -= 0.25 * (h1[q] + h2[q]);
        for (int t = p->begin[c]; t < p->begin[c + 1]; ++t) own[p->across[t]] += share * h1[p->which[t]];
        if (transition || c < n)
            own[m + c] += moved;
        else
            for (int j = 0; j < n; ++j) own[m + j] += moved * E[(c - n) * n + j];
    }
}

/* V = ((I - g H1) Y1 - Z0)/a, of some columns. */
INLINE void change(
    const Passage *p, int n, int k, int columns, const double *RESTRICT Y1, const double *RESTRICT Z0, double *RESTRICT V
) {
    const double *RESTRICT h1 = p->h1 + (size_t)k * p->nnz;
    memcpy(V, Y1, sizeof(double) * 2 * n * columns);
    for (int q = 0; q < p->nnz; ++q) {
        const double share = -GAP * h1[q];
        double *RESTRICT own = V + p->row[q] * columns;
        const double *RESTRICT y = Y1 + p->col[q] * columns;
        for (int j = 0; j < columns; ++j) own[j] += share * y[j];
    }
    for (int i = 0; i < (Z0 ? n : 2 * n); ++i) V[i * columns + i] -= 1.0;
    if (Z0)
        for (int i = 0; i < n * n; ++i) V[n * n + i] -= Z0[i];
    for (int i = 0; i < 2 * n * columns; ++i) V[i] *= 1.0 / SHARE;
}

/* D [I; E] of a (2n x 2n) matrix. */
INLINE void applied(const double *RESTRICT D, const double *RESTRICT E, int n, double *RESTRICT product) {
    for (int i = 0; i < 2 * n; ++i) {
        double *RESTRICT own = product + i * n;
        memcpy(own, D + i * 2 * n, sizeof(double) * n);
        add_rows(own, 1.0, D + i * 2 * n + n, 1, E, n, n, n);
    }
}

/* Whether a step measures so much that the covariance loses most of its size: then rounding of E itself would count. */
static int measures_much(const Passage *p, int k, const double *E) {
    const double *h1 = p->h1 + (size_t)k * p->nnz, *h2 = p->h2 + (size_t)k * p->nnz;
    double information = 0.0, largest = 0.0;
    for (int q = 0; q < p->nnz; ++q)
        if (p->row[q] < p->n && p->col[q] >= p->n)
            information = fmax(information, fmax(fabs(h1[q]), fabs(h2[q])));
    for (int i = 0; i < p->n; ++i) largest = fmax(largest, E[i * p->n + i]);
    return information * largest > MUCH;
}

/* One step: E (n x n) becomes the one after it; what slopes need is kept.
 *
 * [I; E] goes through the step as it is. Where much is measured the transition D itself is made, from which E's rounding
 * is apart: the errors of D [I; E] stay in proportion to what they come from.
 */
INLINE void step(Passage *p, int n, int k, double *RESTRICT E) {
    const int m = 2 * n, transition = measures_much(p, k, E), columns = transition ? m : n, w = m + columns;
    double *RESTRICT a = p->work, *RESTRICT b = p->work + 8 * n * n, *RESTRICT D = p->work + 10 * n * n;
    double *RESTRICT Y1 = p->stage1 + (size_t)k * m * n, *RESTRICT Y2 = p->stage2 + (size_t)k * m * n;
    double *RESTRICT factor = p->factor + (size_t)k * n * n;
    int *swaps = p->swaps + (size_t)k * n, *exchanged = p->exchanged;
    assemble(p, n, k, E, w, a);
    eliminate(a, m, w, exchanged);
    double *RESTRICT stage = transition ? D : Y1;
    for (int i = 0; i < m; ++i) memcpy(stage + i * columns, a + i * w + m, sizeof(double) * columns);
    if (transition) { /* the second stage has the place of V meanwhile */
        change(p, n, k, m, D, NULL, a);
        applied(D, E, n, Y1);
        applied(a, E, n, Y2);
    } else
        change(p, n, k, n, Y1, E, Y2);
    /* X' E+ = Y', side by side */
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) {
            b[i * m + j] = Y2[j * n + i] + (i == j);
            b[i * m + n + j] = Y2[(n + j) * n + i] + E[j * n + i];
        }
    for (int i = 0; i < m * n; ++i) Y2[i] = Y1[i] + 2.0 * GAP * Y2[i];
    eliminate(b, n, m, swaps);
    for (int i = 0; i < n; ++i) memcpy(factor + i * n, b + i * m, sizeof(double) * n);
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) E[i * n + j] = 0.5 * (b[i * m + n + j] + b[j * m + n + i]);
}

/* A B, (rows x inner) (inner x columns). */
INLINE void product(
    const double *RESTRICT A, const double *RESTRICT B, int rows, int inner, int columns, double *RESTRICT result
) {
    memset(result, 0, sizeof(double) * rows * columns);
    for (int i = 0; i < rows; ++i) add_rows(result + i * columns, 1.0, A + i * inner, 1, B, columns, inner, columns);
}

/* a . b, in four sums that do not wait for one another. */
INLINE double dot(const double *RESTRICT a, const double *RESTRICT b, int size) {
    double sums[4] = {0.0, 0.0, 0.0, 0.0};
    int i = 0;
    for (; i + 4 <= size; i += 4)
        for (int k = 0; k < 4; ++k) sums[k] += a[i + k] * b[i + k];
    for (; i < size; ++i) sums[0] += a[i] * b[i];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

/* A B', (rows x inner) (columns x inner)'. */
INLINE void product_turned(
    const double *RESTRICT A, const double *RESTRICT B, int rows, int inner, int columns, double *RESTRICT result
) {
    for (int i = 0; i < rows; ++i)
        for (int c = 0; c < columns; ++c) result[i * columns + c] = dot(A + i * inner, B + c * inner, inner);
}

/* A' B, (inner x rows)' (inner x columns). */
INLINE void turned_product(
    const double *RESTRICT A, const double *RESTRICT B, int rows, int inner, int columns, double *RESTRICT result
) {
    memset(result, 0, sizeof(double) * rows * columns);
    for (int i = 0; i < rows; ++i) add_rows(result + i * columns, 1.0, A + i, rows, B, columns, inner, columns);
}

/* Where readings compute: past what steps use. */
static double *aside(const Passage *p) { return p->work + 17 * (size_t)p->n * p->n + p->nnz; }

/* What reading j does: E (n x n) becomes the one after it; what slopes need is kept. */
INLINE void reading(Passage *p, int n, int j, double *RESTRICT E) {
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
    eliminate(a, r, w, p->exchanged);
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

/* Whether the passage at this point is known. */
static int here(
    const Passage *p, const double *first, const double *h1, const double *h2, const double *told, const double *kicks
) {
    const size_t half = sizeof(double) * p->n * (p->n + 1) / 2, all = sizeof(double) * (size_t)p->nnz * p->moves;
    if (!p->known || memcmp(p->first, first, half) || memcmp(p->h1, h1, all) || memcmp(p->h2, h2, all)) return 0;
    if (p->reads && memcmp(p->told, told, sizeof(double) * telling(p) * p->reads)) return 0;
    return kicks ? !memcmp(p->kicks, kicks, half * p->count) : p->known == 1;
}

INLINE void run(
    Passage *p, int n, const double *first, const double *h1, const double *h2, const double *told, const double *kicks
) {
    const size_t half = (size_t)n * (n + 1) / 2, all = sizeof(double) * (size_t)p->nnz * p->moves;
    if (here(p, first, h1, h2, told, kicks)) return;
    p->known = p->along = 0;
    memcpy(p->first, first, sizeof(double) * half);
    memcpy(p->h1, h1, all);
    memcpy(p->h2, h2, all);
    if (p->reads) memcpy(p->told, told, sizeof(double) * telling(p) * p->reads);
    if (kicks) memcpy(p->kicks, kicks, sizeof(double) * half * p->count);
    double *E = p->work + 14 * n * n;
    spread(first, n, E);
    for (int k = 0; k < p->count; ++k) {
        const int place = p->place[k];
        if (place < 0)
            reading(p, n, -1 - place, E);
        else
            step(p, n, place, E);
        double *after = p->after + k * half;
        for (int j = 0, t = 0; j < n; ++j)
            for (int i = j; i < n; ++i, ++t) after[t] = E[i * n + j];
        if (!kicks) continue;
        for (size_t t = 0; t < half; ++t) after[t] += kicks[k * half + t];
        spread(after, n, E);
    }
    p->known = kicks ? 2 : 1;
}

/* M <- X^-1 M, M (n x r) row by row; X' = P' L U. */
INLINE void divide(const double *RESTRICT factor, const int *RESTRICT swaps, int n, int r, double *RESTRICT M) {
    for (int i = 0; i < n; ++i) {
        const double inverse = 1.0 / factor[i * n + i];
        double *RESTRICT own = M + i * r;
        add_rows(own, -1.0, factor + i, n, M, r, i, r);
        for (int c = 0; c < r; ++c) own[c] *= inverse;
    }
    for (int i = n - 2; i >= 0; --i)
        add_rows(M + i * r, -1.0, factor + (i + 1) * n + i, n, M + (i + 1) * r, r, n - 1 - i, r);
    for (int k = n - 1; k >= 0; --k)
        if (swaps[k] != k)
            for (int c = 0; c < r; ++c) {
                const double kept = M[k * r + c];
                M[k * r + c] = M[swaps[k] * r + c], M[swaps[k] * r + c] = kept;
            }
}

/* -1/2 (J left) right' at the nonzeros, both (2n x r). */
INLINE void at_nonzeros(
    const Passage *p, int n, int r, const double *RESTRICT left, const double *RESTRICT right, double *RESTRICT slopes
) {
    for (int q = 0; q < p->nnz; ++q) {
        const int i = p->row[q];
        const double *RESTRICT one = left + (i < n ? i + n : i - n) * r, *RESTRICT other = right + p->col[q] * r;
        slopes[q] = (i < n ? -0.5 : 0.5) * dot(one, other, r);
    }
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
INLINE void congruent(Passage *p, int n, int k, double *RESTRICT P, double *RESTRICT spare) {
    const double *factor = p->factor + (size_t)k * n * n;
    const int *swaps = p->swaps + (size_t)k * n;
    divide(factor, swaps, n, n, P);
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) spare[i * n + j] = P[j * n + i];
    divide(factor, swaps, n, n, spare);
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) P[i * n + j] = 0.5 * (spare[i * n + j] + spare[j * n + i]);
}

/* What follows has the slopes P as a matrix (few = 0) or as M C M' with few columns. */
typedef struct {
    int few, any;
    double *P, *M, *C;
} Slopes;

INLINE void write_out(Slopes *s, int n, double *RESTRICT P) {
    const int r = s->few;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j <= i; ++j) {
            double sum = 0.0;
            for (int a = 0; a < r; ++a)
                for (int b = 0; b < r; ++b) sum += s->M[i * r + a] * s->C[a * r + b] * s->M[j * r + b];
            P[i * n + j] = P[j * n + i] = sum;
        }
}

/* The slopes of one step's result join those of what comes after. */
INLINE void join(Slopes *s, int n, const double *RESTRICT seed) {
    const int half = n * (n + 1) / 2;
    int asked = 0;
    for (int t = 0; t < half && !asked; ++t) asked = seed[t] != 0.0;
    if (!asked) return;
    if (!s->any) {
        int r = 0, *rows = (int *)s->C;
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
        for (int a = 0; a < r; ++a) s->M[rows[a] * r + a] = 1.0;
        double *core = s->C + n; /* past the rows */
        for (int a = 0; a < r; ++a)
            for (int b = 0; b < r; ++b) core[a * r + b] = s->P[rows[a] * n + rows[b]];
        memmove(s->C, core, sizeof(double) * r * r);
        return;
    }
    if (s->few) write_out(s, n, s->P), s->few = 0;
    add_seed(n, seed, s->P);
}

INLINE void pack_slopes(Slopes *s, int n, double *RESTRICT spare, double *RESTRICT half) {
    double *P = s->P;
    if (!s->any) {
        memset(half, 0, sizeof(double) * n * (n + 1) / 2);
        return;
    }
    if (s->few) write_out(s, n, P = spare);
    for (int j = 0, t = 0; j < n; ++j)
        for (int i = j; i < n; ++i, ++t) half[t] = i == j ? P[i * n + j] : P[i * n + j] + P[j * n + i];
}

/* Slopes before a step and by its H: few columns. */
INLINE void back_few(Passage *p, int n, int r, int k, Slopes *s, double *RESTRICT spare, double *s1, double *s2) {
    double *RESTRICT y = spare, *RESTRICT weighted = spare + 2 * n * r;
    divide(p->factor + (size_t)k * n * n, p->swaps + (size_t)k * n, n, r, s->M);
    for (int stage = 0; stage < 2; ++stage) {
        double *out = stage ? s2 : s1;
        if (!out) continue;
        product((stage ? p->stage2 : p->stage1) + (size_t)k * 2 * n * n, s->M, 2 * n, n, r, y);
        for (int i = 0; i < 2 * n; ++i)
            for (int c = 0; c < r; ++c) {
                double sum = 0.0;
                for (int q = 0; q < r; ++q) sum += y[i * r + q] * s->C[q * r + c];
                weighted[i * r + c] = sum;
            }
        at_nonzeros(p, n, r, y, weighted, out);
    }
}

/* The same with all of P. */
INLINE void back_all(Passage *p, int n, int k, Slopes *s, double *RESTRICT spare, double *s1, double *s2) {
    congruent(p, n, k, s->P, spare);
    for (int stage = 0; stage < 2; ++stage) {
        const double *Y = (stage ? p->stage2 : p->stage1) + (size_t)k * 2 * n * n;
        if (!(stage ? s2 : s1)) continue;
        product(Y, s->P, 2 * n, n, n, spare);
        at_nonzeros(p, n, n, spare, Y, stage ? s2 : s1);
    }
}

/* Half-vector of slopes by a symmetric (r x r) matrix: both places move with one entry. */
INLINE void pack_noise(const double *RESTRICT slope, int r, double *RESTRICT half) {
    for (int j = 0, t = 0; j < r; ++j)
        for (int i = j; i < r; ++i, ++t) half[t] = i == j ? slope[i * r + j] : slope[i * r + j] + slope[j * r + i];
}

/* Slopes before a reading and by what tells of it: few columns, or all of P. */
INLINE void back_reading(Passage *p, int n, int j, Slopes *s, double *RESTRICT spare, double *by_told) {
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
        turned_product(A, s->M, n, n, few, spare);
        memcpy(s->M, spare, sizeof(double) * n * few);
        return;
    }
    turned_product(A, s->P, n, n, n, spare);
    product(spare, A, n, n, n, s->P);
}

INLINE void back(
    Passage *p, int n, const double *seed, double *by_first, double *by_h1, double *by_h2, double *by_told,
    double *by_kicks
) {
    const size_t half = (size_t)n * (n + 1) / 2, nnz = p->nnz, tells = telling(p);
    double *spare = p->work + 5 * n * n;
    Slopes s = {0, 0, p->work, p->work + n * n, p->work + 2 * n * n};
    for (int at = p->count - 1; at >= 0; --at) {
        const int k = p->place[at];
        join(&s, n, seed + at * half);
        if (by_kicks) pack_slopes(&s, n, spare, by_kicks + at * half);
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
        } else if (!s.few)
            back_all(p, n, k, &s, spare, s1, s2);
        else if (s.few == 1)
            back_few(p, n, 1, k, &s, spare, s1, s2);
        else if (s.few == 2)
            back_few(p, n, 2, k, &s, spare, s1, s2);
        else
            back_few(p, n, s.few, k, &s, spare, s1, s2);
    }
    if (by_first) pack_slopes(&s, n, spare, by_first);
}

/* X' M = B solved in place, B (n x n); X' = P' L U. */
INLINE void divide_transposed(const double *RESTRICT factor, const int *RESTRICT swaps, int n, double *RESTRICT B) {
    for (int k = 0; k < n; ++k) {
        if (swaps[k] != k)
            for (int c = 0; c < n; ++c) {
                const double kept = B[k * n + c];
                B[k * n + c] = B[swaps[k] * n + c], B[swaps[k] * n + c] = kept;
            }
    }
    for (int i = 1; i < n; ++i) add_rows(B + i * n, -1.0, factor + i * n, 1, B, n, i, n);
    for (int i = n - 1; i >= 0; --i) {
        double *RESTRICT own = B + i * n;
        add_rows(own, -1.0, factor + i * n + i + 1, 1, B + (i + 1) * n, n, n - 1 - i, n);
        const double inverse = 1.0 / factor[i * n + i];
        for (int c = 0; c < n; ++c) own[c] *= inverse;
    }
}

/* product += share H Y of a matrix H by its nonzeros, Y (2n x n). */
INLINE void add_sparse(
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
INLINE void stack(int n, int identity, const double *RESTRICT E, double *RESTRICT Z) {
    memset(Z, 0, sizeof(double) * n * n);
    for (int i = 0; identity && i < n; ++i) Z[i * n + i] = 1.0;
    memcpy(Z + n * n, E, sizeof(double) * n * n);
}

/* The tangent of one step: dE becomes that after it; those of the stages and of X are kept. */
INLINE void tangent_step(
    Passage *p, int n, int k, const double *E, const double *next, const double *d1, const double *d2,
    double *RESTRICT dE, double *RESTRICT spare
) {
    const int m = 2 * n, w = 3 * n;
    const double *h1 = p->h1 + (size_t)k * p->nnz, *h2 = p->h2 + (size_t)k * p->nnz;
    const double *RESTRICT Y1 = p->stage1 + (size_t)k * m * n;
    double *RESTRICT dY1 = p->moved + (size_t)k * 5 * n * n, *RESTRICT dY2 = dY1 + m * n, *RESTRICT dX = dY2 + m * n;
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
    assemble(p, n, k, E, w, a);
    for (int i = 0; i < m; ++i) memcpy(a + i * w + m, right + i * n, sizeof(double) * n);
    eliminate(a, m, w, p->exchanged);
    for (int i = 0; i < m; ++i) memcpy(dY1 + i * n, a + i * w + m, sizeof(double) * n);
    memcpy(inner, dY1, sizeof(double) * m * n); /* dV = (dY1 - g (dH1 Y1 + H1 dY1) - dZ0)/a */
    add_sparse(p, n, -GAP, d1, Y1, inner);
    add_sparse(p, n, -GAP, h1, dY1, inner);
    for (int i = 0; i < m * n; ++i) inner[i] = (inner[i] - dZ[i]) / SHARE, dY2[i] = dY1[i] + 2.0 * GAP * inner[i];
    memcpy(dX, inner, sizeof(double) * n * n);
    product(next, dX, n, n, n, Z);
    for (int i = 0; i < n; ++i) /* dE+ X = dY - E+ dX, transposed */
        for (int j = 0; j < n; ++j) right[j * n + i] = dE[i * n + j] + inner[(n + i) * n + j] - Z[i * n + j];
    divide_transposed(p->factor + (size_t)k * n * n, p->swaps + (size_t)k * n, n, right);
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) dE[i * n + j] = 0.5 * (right[i * n + j] + right[j * n + i]);
}

/* The tangent of what reading j does: dE becomes that after it; those of K, A and E+ are kept. */
INLINE void tangent_reading(Passage *p, int n, int j, const double *E, const double *d_told, double *RESTRICT dE) {
    const int r = p->r;
    const size_t square = (size_t)n * n, tall = (size_t)r * n, wide = (size_t)r * r;
    const double *M = p->told + j * telling(p), *dM = d_told, *K = p->gain + j * tall, *A = p->keep + j * square;
    const double *after = p->reached + j * square, *S = p->inverse + j * wide;
    double *dK = p->turned + j * (tall + 2 * square), *dA = dK + tall, *dAfter = dA + square;
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
INLINE void tangents(
    Passage *p, int n, const double *d_first, const double *d1, const double *d2, const double *d_told,
    const double *d_kicks
) {
    const size_t half = (size_t)n * (n + 1) / 2, nnz = p->nnz;
    double *kept = p->direction, *d_after = p->shifted;
    int known = p->along == (d_kicks ? 2 : 1);
    known &= same(&kept, d_first, half);
    known &= same(&kept, d1, nnz * p->moves);
    known &= same(&kept, d2, nnz * p->moves);
    known &= same(&kept, d_told, telling(p) * p->reads);
    known &= same(&kept, d_kicks, half * p->count);
    if (known) return;
    p->along = d_kicks ? 2 : 1;
    double *E = p->work + 14 * n * n, *next = p->work + 15 * n * n, *spare = p->work + 6 * n * n, *dE = p->work + 16 * n * n;
    spread(p->first, n, E);
    spread(d_first, n, dE);
    for (int k = 0; k < p->count; ++k) {
        const double *after = p->after + k * half;
        spread(after, n, next);
        if (p->known == 2)
            for (int j = 0, t = 0; j < n; ++j)
                for (int i = j; i < n; ++i, ++t) next[i * n + j] = next[j * n + i] = after[t] - p->kicks[k * half + t];
        const int place = p->place[k];
        if (place < 0)
            tangent_reading(p, n, -1 - place, E, d_told + (-1 - place) * telling(p), dE);
        else
            tangent_step(p, n, place, E, next, d1 + place * nnz, d2 + place * nnz, dE, spare);
        spread(after, n, E);
        if (d_kicks)
            for (int j = 0, t = 0; j < n; ++j)
                for (int i = j; i < n; ++i, ++t) {
                    dE[i * n + j] += d_kicks[k * half + t];
                    if (i != j) dE[j * n + i] += d_kicks[k * half + t];
                }
        for (int j = 0, t = 0; j < n; ++j)
            for (int i = j; i < n; ++i, ++t) d_after[k * half + t] = dE[i * n + j];
    }
}

/* How the slopes at reading j move: P and dP become those before it. */
INLINE void back_reading_tangent(
    Passage *p, int n, int j, double *RESTRICT P, double *RESTRICT dP, double *RESTRICT spare, double *d_by_told
) {
    const int r = p->r;
    const size_t square = (size_t)n * n, tall = (size_t)r * n, wide = (size_t)r * r;
    const double *K = p->gain + j * tall, *A = p->keep + j * square, *after = p->reached + j * square;
    const double *dK = p->turned + j * (tall + 2 * square), *dA = dK + tall, *dAfter = dA + square;
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

/* How the slopes of `back` move along the tangents. */
INLINE void back_tangents(
    Passage *p, int n, const double *seed, const double *d_seed, double *d_by_first, double *d_by_h1, double *d_by_h2,
    double *d_by_told, double *d_by_kicks
) {
    const size_t half = (size_t)n * (n + 1) / 2, nnz = p->nnz;
    const int m = 2 * n;
    double *P = p->work, *dP = P + n * n, *K = dP + n * n, *spare = K + n * n, *left = spare + m * n, *other = left + m * n;
    memset(P, 0, sizeof(double) * 2 * n * n);
    for (int at = p->count - 1; at >= 0; --at) {
        const int k = p->place[at];
        add_seed(n, seed + at * half, P);
        if (d_seed) add_seed(n, d_seed + at * half, dP);
        Slopes s = {0, 1, dP, NULL, NULL};
        if (d_by_kicks) pack_slopes(&s, n, spare, d_by_kicks + at * half);
        if (k < 0) {
            back_reading_tangent(p, n, -1 - k, P, dP, spare, d_by_told ? d_by_told + (-1 - k) * telling(p) : NULL);
            continue;
        }
        const double *moved = p->moved + (size_t)k * 5 * n * n, *dX = moved + 2 * m * n;
        congruent(p, n, k, P, spare);
        congruent(p, n, k, dP, spare);
        memcpy(K, dX, sizeof(double) * n * n); /* dP -= X^-1 dX P and its transpose */
        divide(p->factor + (size_t)k * n * n, p->swaps + (size_t)k * n, n, n, K);
        product(K, P, n, n, n, spare);
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j) dP[i * n + j] -= spare[i * n + j] + spare[j * n + i];
        for (int stage = 0; stage < 2; ++stage) {
            const double *Y = (stage ? p->stage2 : p->stage1) + (size_t)k * m * n, *dY = moved + stage * m * n;
            double *out = stage ? d_by_h2 : d_by_h1;
            if (!out) continue;
            product(dY, P, m, n, n, left);
            product(Y, dP, m, n, n, spare);
            for (int i = 0; i < m * n; ++i) left[i] += spare[i];
            at_nonzeros(p, n, n, left, Y, out + k * nnz);
            product(Y, P, m, n, n, left);
            at_nonzeros(p, n, n, left, dY, other);
            for (size_t q = 0; q < nnz; ++q) out[k * nnz + q] += other[q];
        }
    }
    Slopes s = {0, 1, dP, NULL, NULL};
    if (d_by_first) pack_slopes(&s, n, spare, d_by_first);
}

/* Half-vectors after each step, from the first one; kicks are added to them as they pass, NULL: none. */
EXPORT VERSIONS void passage_forward(
    Passage *p, const double *first, const double *h1, const double *h2, const double *told, const double *kicks,
    double *after
) {
    run(p, p->n, first, h1, h2, told, kicks);
    if (after) memcpy(after, p->after, sizeof(double) * ((size_t)p->n * (p->n + 1) / 2) * p->count);
}

/* Slopes of seed . after by the arguments; those that are NULL are left out. */
EXPORT VERSIONS void passage_reverse(
    Passage *p, const double *first, const double *h1, const double *h2, const double *told, const double *kicks,
    const double *seed, double *by_first, double *by_h1, double *by_h2, double *by_told, double *by_kicks
) {
    run(p, p->n, first, h1, h2, told, kicks);
    back(p, p->n, seed, by_first, by_h1, by_h2, by_told, by_kicks);
}

/* Tangents of `after`, and of the slopes that `passage_reverse` gives, along a direction; nonzero without memory.
 *
 * Results that are NULL are left out; seed is NULL where no slopes are wanted, tangents of kicks and seeds where they
 * are zero.
 */
EXPORT VERSIONS int passage_tangent(
    Passage *p, const double *first, const double *h1, const double *h2, const double *told, const double *kicks,
    const double *seed, const double *d_first, const double *d_h1, const double *d_h2, const double *d_told,
    const double *d_kicks, const double *d_seed, double *d_after, double *d_by_first, double *d_by_h1,
    double *d_by_h2, double *d_by_told, double *d_by_kicks
) {
    const size_t square = (size_t)p->n * p->n, turned = (size_t)p->r * p->n + 2 * square;
    const size_t half = square / 2 + p->n / 2 + 1, all = half * p->count, d = sizeof(double);
    const size_t point = half + all + 2 * (size_t)p->nnz * p->moves + telling(p) * p->reads;
    if (!p->moved) p->moved = room((size_t)p->moves * 5 * square, d);
    if (!p->turned) p->turned = room((size_t)p->reads * turned, d);
    if (!p->direction) p->direction = calloc(point, d); /* compared before it is first written */
    if (!p->shifted) p->shifted = room(all, d);
    if (!p->moved || !p->turned || !p->direction || !p->shifted) return 1;
    run(p, p->n, first, h1, h2, told, kicks);
    tangents(p, p->n, d_first, d_h1, d_h2, d_told, d_kicks);
    if (d_after) memcpy(d_after, p->shifted, d * ((size_t)p->n * (p->n + 1) / 2) * p->count);
    if (seed) back_tangents(p, p->n, seed, d_seed, d_by_first, d_by_h1, d_by_h2, d_by_told, d_by_kicks);
    return 0;
}

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_passage", "The compiled passage of a covariance; called by its C names.", -1,
    NULL, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__passage(void) { return PyModule_Create(&definition); }
