/* What a passage works on, in memory that its caller provides. */
#include <math.h>
#include <stddef.h>
#include <string.h>

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

static const double GAP = 0.28867513459481287;
static const double SHARE = 0.5 - 2.0 * 0.28867513459481287;
/* Of information times variance in a step, above which the transition is made. */
static const double MUCH = 100.0;

/* Steps of a covariance and where their numbers lie.
 *
 * Everything whole is told by one array, `shape`: n, nonzeros of H, steps, r, and whether there is an order of
 * elimination; then, one after the other, the arrays below that are marked so.
 */
typedef struct {
    int n, nnz, count, r, moves, reads;
    int lean;         /* nothing is kept of the steps: no slopes */
    const int *place; /* of each step among those that move, or -1 - that among those that read; of shape */
    const int *row, *col; /* nonzeros of H, column by column; of shape */
    const int *begin, *across, *which; /* the same row by row: places, columns, positions among them; of shape */
    /* An order of elimination and the pattern it leads to, see sparse.h, of shape; NULL: rows are exchanged. Row i of
     * the factors has columns `before` it and `behind` it, from `left[i]` and `right[i]` on; `facing`: of each of the
     * former, the place of i behind it. */
    const int *order, *rank, *left, *right, *before, *facing, *behind;
    int *chosen;                  /* 2n to work in */
    const double *h1, *h2, *told; /* the point */
    double *after;                /* half-vectors there */
    double *stage1, *stage2;      /* of every step, 2n x n, row by row */
    double *factor, *swaps;       /* of every X', n x n, and the rows that were exchanged for each */
    double *gain, *keep, *inverse, *reached; /* of every reading: K, A, (M E M' + R)^-1, E+ */
    double *work, *sizes, *values; /* to work in; `sizes`: of the diagonal of a full system */
} Passage;

/* Numbers that tell of one reading. */
static size_t telling(const Passage *p) { return (size_t)p->r * p->n + (size_t)p->r * (p->r + 1) / 2; }

/* Tells a passage its shape. */
static void described(Passage *p, const int *shape) {
    const int filled = shape[4], m = 2 * shape[0];
    memset(p, 0, sizeof *p);
    p->n = shape[0], p->nnz = shape[1], p->count = shape[2], p->r = shape[3];
    p->place = shape + 5;
    for (int k = 0; k < p->count; ++k) p->place[k] < 0 ? ++p->reads : ++p->moves;
    p->row = p->place + p->count, p->col = p->row + p->nnz;
    p->begin = p->col + p->nnz, p->across = p->begin + m + 1, p->which = p->across + p->nnz;
    if (!filled) return;
    p->order = p->which + p->nnz, p->rank = p->order + m;
    p->left = p->rank + m, p->right = p->left + m + 1;
    p->before = p->right + m + 1, p->facing = p->before + p->right[m], p->behind = p->facing + p->right[m];
}

/* Gives a place to one array; `memory` NULL: counts only. */
static double *placed(double *memory, size_t *used, size_t count) {
    double *place = memory ? memory + *used : NULL;
    *used += count;
    return place;
}

/* Places for what is kept of the steps, from `memory` on; their number. */
static size_t keeps(Passage *p, double *memory) {
    const size_t n = p->n, square = n * n, steps = p->lean && p->moves ? 1 : (size_t)p->moves, reads = p->reads;
    size_t used = 0;
    p->after = placed(memory, &used, n * (n + 1) / 2 * p->count);
    p->stage1 = placed(memory, &used, steps * 2 * square), p->stage2 = placed(memory, &used, steps * 2 * square);
    p->factor = placed(memory, &used, steps * square), p->swaps = placed(memory, &used, steps * n);
    p->gain = placed(memory, &used, reads * p->r * n), p->keep = placed(memory, &used, reads * square);
    p->inverse = placed(memory, &used, reads * p->r * p->r), p->reached = placed(memory, &used, reads * square);
    return used;
}

/* Places to work in, from `memory` on; their number. */
static size_t works(Passage *p, double *memory) {
    const size_t n = p->n, r = p->r, filled = p->order ? (size_t)p->right[2 * n] : 0;
    size_t used = 0;
    p->work = placed(memory, &used, 17 * n * n + p->nnz + 4 * (r * r + r * n));
    p->sizes = placed(memory, &used, 2 * n);
    p->values = placed(memory, &used, p->order ? 6 * n + filled : 0);
    return used;
}
