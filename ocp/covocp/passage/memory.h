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
 */
/* What a passage works on, in memory that its caller provides. */
#include <math.h>
#include <stddef.h>
#include <string.h>

/* What is always written in place: short, or faster where its sizes are known. The rest is left to the compiler. */
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

/* A function of r columns, its first argument, written out for one and for two of them, as there mostly are: once for
 * all that call it, in whose place it would be written out again and again. */
#define BY_WIDTH(function, r, ...) \
    do { \
        if ((r) == 1) \
            function(1, __VA_ARGS__); \
        else if ((r) == 2) \
            function(2, __VA_ARGS__); \
        else \
            function(r, __VA_ARGS__); \
    } while (0)

static const double GAP = 0.28867513459481287;
static const double SHARE = 0.5 - 2.0 * 0.28867513459481287;
/* Of information times variance in a step, above which the transition is made. */
static const double MUCH = 100.0;
/* Steps whose systems are made triangular side by side. */
enum { MOST_LANES = 8 };
/* Columns that are made triangular at a time, rows that are solved so. */
enum { PANEL = 8 };

/* Steps of a covariance and where their numbers lie.
 *
 * Everything whole is told by one array, `shape`: n, nonzeros of H, steps, r, whether there is an order of elimination,
 * and `every`; then, one after the other, the arrays below that are marked so.
 */
typedef struct {
    int n, nnz, count, r, moves, reads;
    int every, ends;  /* half-vectors are wanted, kicks and seeds given, after every so many steps: `ends` columns */
    int lean;         /* nothing is kept of the steps: no slopes */
    int lanes;        /* steps made triangular side by side: 1 or MOST_LANES */
    int full, brief;  /* the stages of all steps are kept; the factors of their systems, which for slopes of few entries
                       * suffice (few.h) */
    int thin;         /* nothing is kept of the steps but the half-vectors that are wanted (thin.h), see `described_for` */
    const int *place; /* of each step among those that move, or -1 - that among those that read; of shape */
    const int *row, *col; /* nonzeros of H, column by column; of shape */
    const int *begin, *across, *which; /* the same row by row: places, columns, positions among them; of shape */
    /* An order of elimination and the pattern it leads to, see `solve_sparse`, of shape; NULL: rows are exchanged. Row
     * order[i] of the factors has columns `before` it and `behind` it, from `left[i]` and `right[i]` on; `facing`: of each
     * of the former, its place behind that column. */
    const int *order, *rank, *left, *right, *before, *facing, *behind;
    int *chosen;                  /* 2n to work in */
    int *good;                    /* whether factors are, of as many steps as there are in `factors` */
    int *hard;                    /* where it is thin: the intervals between what is wanted whose steps are kept on the
                                   * way back */
    const double *h1, *h2, *told; /* the point */
    double *after;                /* half-vectors there, after all steps; where it is lean or thin those that are wanted */
    double *inside;               /* where it is thin: before each step of an interval */
    double *factors;              /* of the systems of all steps, or of those side by side */
    double *factor, *swaps;       /* of every X', n x n, and the rows that were exchanged for each; of one where it is lean,
                                   * of those of one interval where it is thin */
    double *stage1, *stage2;      /* of every step, 2n x n, row by row; of one unless all are kept */
    double *gain, *keep, *inverse, *reached; /* of every reading: K, A, (M E M' + R)^-1, E+ */
    double *work, *sizes, *values; /* to work in; `sizes`: of the diagonal of a full system */
    double *tall;                  /* to work in: some columns of a system, see `panel` */
} Passage;

/* Where the factors of X' of step k are among those that are kept. */
static size_t spot(const Passage *p, int k) { return p->lean ? 0 : (size_t)(p->thin ? k % p->every : k); }

/* After how many of the steps, each time, a half-vector is kept. */
static int apart(const Passage *p) { return p->lean || p->thin ? p->every : 1; }

/* Numbers that tell of one reading. */
static size_t telling(const Passage *p) { return (size_t)p->r * p->n + (size_t)p->r * (p->r + 1) / 2; }

/* Gives a place to one array; `memory` NULL: counts only. */
static double *placed(double *memory, size_t *used, size_t count) {
    double *place = memory ? memory + *used : NULL;
    *used += count;
    return place;
}

/* Places for the stages of all steps, or of one, from `memory` on; their number. */
static size_t stages(Passage *p, double *memory) {
    const size_t n = p->n, square = n * n, steps = p->full || !p->moves ? (size_t)p->moves : 1;
    size_t used = 0;
    p->stage1 = placed(memory, &used, steps * 2 * square), p->stage2 = placed(memory, &used, steps * 2 * square);
    return used;
}

/* Numbers of the factors of the system of one step: shares before the diagonal, entries behind it, inverses of the diagonal. */
static size_t factors_length(const Passage *p) { return p->order ? (size_t)2 * p->right[2 * p->n] + 2 * p->n : 0; }

/* Places for what is kept of the steps, from `memory` on; their number. */
static size_t keeps(Passage *p, double *memory) {
    const size_t n = p->n, square = n * n, reads = p->reads, half = n * (n + 1) / 2;
    const size_t steps = p->lean && p->moves ? 1 : (size_t)(p->thin ? p->every : p->moves);
    size_t used = 0;
    p->after = placed(memory, &used, half * (p->count / apart(p)));
    if (p->thin) p->inside = placed(memory, &used, half * p->every);
    p->factor = placed(memory, &used, steps * square), p->swaps = placed(memory, &used, steps * n);
    if (p->brief) p->factors = placed(memory, &used, (size_t)p->moves * factors_length(p));
    p->gain = placed(memory, &used, reads * p->r * n), p->keep = placed(memory, &used, reads * square);
    p->inverse = placed(memory, &used, reads * p->r * p->r), p->reached = placed(memory, &used, reads * square);
    return used;
}
