/* A passage that keeps its last point, in memory of its own. */
#include <stdint.h>
#include <stdlib.h>

typedef struct {
    Passage p;
    int known;     /* whether there is a last point: 1, or 2 with kicks */
    int along;     /* whether the tangents are along the last direction: 1, or 2 with tangents of kicks */
    int *whole;    /* its shape, and to work in */
    double *reals; /* all of `p` */
    double *first, *h1, *h2, *told, *kicks; /* the last point */
    double *moved;  /* tangents of the stages and of X, of every step; NULL until they are asked for */
    double *turned; /* tangents of K, A, E+, of every reading, as `moved` */
    double *direction, *shifted; /* the last direction; the tangents of the half-vectors along it; as `moved` */
} Kept;

static void *room(size_t count, size_t size) { return count > SIZE_MAX / size ? NULL : malloc(count ? count * size : 1); }

EXPORT void passage_free(Kept *k) {
    if (!k) return;
    void *owned[] = {k->whole, k->reals, k->moved, k->turned, k->direction, k->shifted};
    for (size_t i = 0; i < sizeof owned / sizeof *owned; ++i) free(owned[i]);
    free(k);
}

/* Numbers of a point, with kicks. */
static size_t numbers(const Passage *p) {
    const size_t half = (size_t)p->n * (p->n + 1) / 2;
    return half + 2 * (size_t)p->nnz * p->moves + telling(p) * p->reads + half * p->count;
}

/* A passage of a shape of `length` numbers; NULL where there is no memory. `lean`: for values alone. */
EXPORT Kept *passage_new(const int *shape, int length, int lean) {
    Kept *k = calloc(1, sizeof *k);
    if (!k) return NULL;
    k->whole = room((size_t)length + 2 * shape[0], sizeof(int));
    if (k->whole) {
        memcpy(k->whole, shape, sizeof(int) * length);
        described(&k->p, k->whole);
        k->p.chosen = k->whole + length;
        k->p.lean = lean;
        k->reals = room(keeps(&k->p, NULL) + works(&k->p, NULL) + numbers(&k->p), sizeof(double));
    }
    if (!k->reals) {
        passage_free(k);
        return NULL;
    }
    Passage *p = &k->p;
    const size_t half = (size_t)p->n * (p->n + 1) / 2, entries = (size_t)p->nnz * p->moves;
    double *at = k->reals + keeps(p, k->reals);
    at += works(p, at);
    k->first = at, k->h1 = k->first + half, k->h2 = k->h1 + entries;
    k->told = k->h2 + entries, k->kicks = k->told + telling(p) * p->reads;
    p->h1 = k->h1, p->h2 = k->h2, p->told = k->told;
    return k;
}

/* Bytes of such a passage, with its tangents unless it is for values alone. */
EXPORT size_t passage_bytes(const int *shape, int lean) {
    Passage p;
    described(&p, shape);
    p.lean = lean;
    const size_t n = p.n, square = n * n, own = keeps(&p, NULL) + works(&p, NULL) + numbers(&p);
    const size_t moved = 5 * square * p.moves + (p.r * n + 2 * square) * p.reads;
    return sizeof(double) * (own + (lean ? 0 : moved + numbers(&p) + n * (n + 1) / 2 * p.count));
}

/* Whether the passage at this point is known. */
static int here(
    const Kept *k, const double *first, const double *h1, const double *h2, const double *told, const double *kicks
) {
    const Passage *p = &k->p;
    const size_t half = sizeof(double) * p->n * (p->n + 1) / 2, all = sizeof(double) * (size_t)p->nnz * p->moves;
    if (!k->known || memcmp(k->first, first, half) || memcmp(k->h1, h1, all) || memcmp(k->h2, h2, all)) return 0;
    if (p->reads && memcmp(k->told, told, sizeof(double) * telling(p) * p->reads)) return 0;
    return kicks ? !memcmp(k->kicks, kicks, half * p->count) : k->known == 1;
}

INLINE void run(
    Kept *k, int n, const double *first, const double *h1, const double *h2, const double *told, const double *kicks
) {
    Passage *p = &k->p;
    const size_t half = (size_t)n * (n + 1) / 2, all = sizeof(double) * (size_t)p->nnz * p->moves;
    if (here(k, first, h1, h2, told, kicks)) return;
    k->known = k->along = 0;
    memcpy(k->first, first, sizeof(double) * half);
    memcpy(k->h1, h1, all);
    memcpy(k->h2, h2, all);
    if (p->reads) memcpy(k->told, told, sizeof(double) * telling(p) * p->reads);
    if (kicks) memcpy(k->kicks, kicks, sizeof(double) * half * p->count);
    passes(p, n, first, kicks);
    k->known = kicks ? 2 : 1;
}
