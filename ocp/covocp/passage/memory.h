/* What a passage keeps, and the memory for it. */
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
    int lean; /* nothing is kept of the steps: no slopes */
    int r, moves, reads, *place; /* of each step among those that move, or -1 - that among those that read */
    int *row, *col;              /* nonzeros of H, column by column */
    int *begin, *across, *which; /* the same row by row: places, columns, positions among them */
    /* An order of elimination and the pattern it leads to, see sparse.h; NULL: rows are exchanged. Row i of the factors
     * has columns `before` it and `behind` it, from `left[i]` and `right[i]` on; `facing`: of each of the former, the
     * place of i behind it. */
    int *order, *rank, *left, *before, *facing, *right, *behind, *chosen;
    double *values;
    double *sizes; /* of the diagonal of a full system */
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

EXPORT void passage_free(Passage *p) {
    if (!p) return;
    void *owned[] = {p->row,   p->col,    p->begin,  p->across, p->which, p->first, p->h1,  p->h2,
                     p->kicks, p->after,  p->stage1, p->stage2, p->factor, p->swaps, p->exchanged,
                     p->work,  p->moved,  p->place,  p->told,   p->gain,  p->keep,  p->inverse, p->reached,
                     p->turned, p->direction, p->shifted, p->order, p->rank,  p->left,  p->before,  p->facing,
                     p->right,  p->behind, p->chosen,  p->values, p->sizes};
    for (size_t i = 0; i < sizeof owned / sizeof *owned; ++i) free(owned[i]);
    free(p);
}

static void *room(size_t count, size_t size) { return count > SIZE_MAX / size ? NULL : malloc(count ? count * size : 1); }

/* Numbers that tell of one reading. */
static size_t telling(const Passage *p) { return (size_t)p->r * p->n + (size_t)p->r * (p->r + 1) / 2; }

/* Keeps an order of elimination; 0 where there is no memory. */
static int ordered(Passage *p, const int *order, const int *right, const int *behind) {
    const int m = 2 * p->n, entries = right[m];
    const size_t w = sizeof(int);
    p->order = room(m, w), p->rank = room(m, w), p->chosen = room(m, w), p->left = room(m + 1, w), p->right = room(m + 1, w);
    p->before = room(entries, w), p->facing = room(entries, w), p->behind = room(entries, w);
    p->values = room((size_t)3 * m + entries, sizeof(double));
    if (!p->order || !p->rank || !p->chosen || !p->left || !p->right || !p->before || !p->facing || !p->behind || !p->values)
        return 0;
    memcpy(p->order, order, w * m);
    memcpy(p->right, right, w * (m + 1));
    memcpy(p->behind, behind, w * entries);
    memset(p->left, 0, w * (m + 1));
    for (int i = 0; i < m; ++i) p->rank[order[i]] = i;
    for (int q = 0; q < entries; ++q) ++p->left[behind[q] + 1];
    for (int i = 0; i < m; ++i) p->left[i + 1] += p->left[i];
    memcpy(p->chosen, p->left, w * m); /* where the next of each row goes */
    for (int i = 0; i < m; ++i)
        for (int q = right[i]; q < right[i + 1]; ++q) {
            const int place = p->chosen[behind[q]]++;
            p->before[place] = i, p->facing[place] = q;
        }
    return 1;
}

/* A passage of `count` steps of an n x n covariance, with the pattern of H; NULL where there is no memory.
 *
 * Steps with `read` read up to r rows, the others move; read is NULL where all of them do. `order`: of elimination, 2n
 * rows, `right` and `behind`: the pattern behind its diagonal, row by row, rising; NULL where rows are exchanged.
 * `lean`: for values alone.
 */
EXPORT Passage *passage_new(
    int n, int nnz, const int *row, const int *col, int count, int r, const int *read, const int *order,
    const int *right, const int *behind, int lean
) {
    Passage *p = calloc(1, sizeof *p);
    if (!p) return NULL;
    p->n = n, p->nnz = nnz, p->count = count, p->r = r, p->lean = lean;
    p->place = room(count, sizeof(int));
    if (!p->place) {
        passage_free(p);
        return NULL;
    }
    for (int k = 0; k < count; ++k) p->place[k] = read && read[k] ? -1 - p->reads++ : p->moves++;
    const size_t d = sizeof(double), all = (size_t)count, steps = (size_t)p->moves, reads = (size_t)p->reads;
    const size_t whole = lean && p->moves ? 1 : steps; /* steps of which all is kept */
    const size_t square = (size_t)n * n, half = square / 2 + n / 2 + 1, tall = (size_t)r * n, wide = (size_t)r * r;
    p->row = room(nnz, sizeof(int)), p->col = room(nnz, sizeof(int)), p->begin = room(2 * n + 1, sizeof(int));
    p->across = room(nnz, sizeof(int)), p->which = room(nnz, sizeof(int)), p->swaps = room(whole * n, sizeof(int));
    p->first = room(half, d), p->h1 = room(steps * nnz, d), p->h2 = room(steps * nnz, d);
    p->kicks = room(all * half, d), p->after = room(all * half, d), p->factor = room(whole * square, d);
    p->stage1 = room(whole * 2 * square, d), p->stage2 = room(whole * 2 * square, d), p->work = room(17 * square + nnz + 4 * (wide + tall), d);
    p->told = room(reads * telling(p), d), p->gain = room(reads * tall, d), p->keep = room(reads * square, d);
    p->inverse = room(reads * wide, d), p->reached = room(reads * square, d);
    p->exchanged = room(2 * n + r, sizeof(int)), p->sizes = room(2 * n, d);
    if (!p->row || !p->col || !p->begin || !p->across || !p->which || !p->swaps || !p->first || !p->h1 || !p->h2 ||
        !p->kicks || !p->after || !p->factor || !p->stage1 || !p->stage2 || !p->work || !p->exchanged || !p->sizes || !p->told ||
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
    if (order && !ordered(p, order, right, behind)) {
        passage_free(p);
        return NULL;
    }
    return p;
}
