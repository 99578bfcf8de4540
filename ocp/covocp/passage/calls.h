/* What computes, under names that the file including it gives: NAME(passage_forward), ... */
#include "memory.h"
#include "rows.h"
#include "sparse.h"
#include "forward.h"
#include "few.h"
#include "back.h"
#include "thin.h"
#include "kept.h"
#include "along.h"
#include "narrow.h"
#include "transitions.h"
#include "columns.h"

/* Half-vectors that are wanted, from the first one; kicks are added to them as they pass, NULL: none. */
EXPORT void NAME(passage_forward)(
    Kept *k, const double *first, const double *h1, const double *h2, const double *told, const double *kicks,
    double *after
) {
    const Passage *p = &k->p;
    run(k, p->n, first, h1, h2, told, kicks);
    const size_t half = (size_t)p->n * (p->n + 1) / 2, each = p->every / apart(p);
    for (size_t k = 0; after && k < (size_t)p->ends; ++k)
        memcpy(after + k * half, p->after + ((k + 1) * each - 1) * half, sizeof(double) * half);
}

/* Slopes of seed . after by the arguments; those that are NULL are left out. Nonzero without memory. */
EXPORT int NAME(passage_reverse)(
    Kept *k, const double *first, const double *h1, const double *h2, const double *told, const double *kicks,
    const double *seed, double *by_first, double *by_h1, double *by_h2, double *by_told, double *by_kicks
) {
    if (!is_few(&k->p, k->p.n, seed) && keep_stages(k)) return 1;
    run(k, k->p.n, first, h1, h2, told, kicks);
    if (k->p.thin)
        back_thin(&k->p, k->p.n, k->first, k->known == 2 ? k->kicks : NULL, seed, by_first, by_h1, by_h2, by_told, by_kicks);
    else
        back(&k->p, k->p.n, k->first, seed, by_first, by_h1, by_h2, by_told, by_kicks);
    return 0;
}

/* Tangents of `after`, and of the slopes that `passage_reverse` gives, along a direction; nonzero without memory.
 *
 * Results that are NULL are left out; seed is NULL where no slopes are wanted, tangents of kicks and seeds where they
 * are zero.
 */
EXPORT int NAME(passage_tangent)(
    Kept *k, const double *first, const double *h1, const double *h2, const double *told, const double *kicks,
    const double *seed, const double *d_first, const double *d_h1, const double *d_h2, const double *d_told,
    const double *d_kicks, const double *d_seed, double *d_after, double *d_by_first, double *d_by_h1,
    double *d_by_h2, double *d_by_told, double *d_by_kicks
) {
    const Passage *p = &k->p;
    const size_t square = (size_t)p->n * p->n, turned = (size_t)p->r * p->n + 2 * square;
    const size_t all = ((size_t)p->n * (p->n + 1) / 2) * p->ends, d = sizeof(double);
    if (seed && !d_after && !d_by_kicks && is_narrow(k, kicks, seed, d_kicks, d_seed)) {
        run(k, p->n, first, h1, h2, told, kicks);
        return narrow_second(k, p->n, seed, d_first, d_h1, d_h2, d_by_first, d_by_h1, d_by_h2);
    }
    if (!k->direction) {
        if (made(k, &k->direction, numbers(p))) return 1;
        memset(k->direction, 0, d * numbers(p)); /* compared before it is first written */
    }
    if (made(k, &k->moved, (size_t)p->moves * 5 * square) || made(k, &k->turned, (size_t)p->reads * turned) ||
        made(k, &k->shifted, all) || keep_stages(k))
        return 1;
    run(k, p->n, first, h1, h2, told, kicks);
    tangents(k, p->n, d_first, d_h1, d_h2, d_told, d_kicks);
    if (d_after) memcpy(d_after, k->shifted, d * all);
    if (seed) back_tangents(k, p->n, seed, d_seed, d_by_first, d_by_h1, d_by_h2, d_by_told, d_by_kicks);
    return 0;
}
