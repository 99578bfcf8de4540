/* A passage that keeps its last point, in memory of its own. */
typedef struct {
    Passage p;
    int known;     /* whether there is a last point: 1, or 2 with kicks */
    int along;     /* whether the tangents are along the last direction: 1, or 2 with tangents of kicks */
    int *whole;    /* its shape, and to work in */
    double *reals; /* all of `p` but what is in `whole` and in `stages` */
    double *stages; /* of all steps; NULL until they are asked for */
    double *first, *h1, *h2, *told, *kicks; /* the last point; where it is thin h1 and h2 are the caller's, and known by */
    uint64_t digests[2][4];                 /* digests of them */
    double *moved;  /* tangents of the stages and of X, of every step; NULL until they are asked for */
    double *turned; /* tangents of K, A, E+, of every reading, as `moved` */
    double *direction, *shifted; /* the last direction; the tangents of the half-vectors along it; as `moved` */
    double *narrow; /* the last seed, and columns of all steps, see narrow.h; NULL until they are asked for */
    size_t narrowed; /* their numbers */
    double *inverses; /* of the systems of those steps that are not triangular by their nonzeros; as `narrow` */
    int seeded;      /* steps of which the columns are known; 0: of none */
    size_t held; /* bytes of all of these */
} Kept;

static void *room(size_t count, size_t size) { return count > SIZE_MAX / size ? NULL : malloc(count ? count * size : 1); }

/* Room for reals of `k` at a place where there is none yet; nonzero without memory. */
static int made(Kept *k, double **place, size_t count) {
    if (*place) return 0;
    *place = room(count, sizeof(double));
    if (*place) k->held += count * sizeof(double);
    return !*place;
}

/* Numbers of h H at one point that are copied. */
static size_t copied_entries(const Passage *p) { return p->thin ? 0 : (size_t)p->nnz * p->moves; }

/* Numbers of a point, with kicks. */
static size_t numbers(const Passage *p) {
    const size_t half = (size_t)p->n * (p->n + 1) / 2;
    return half + 2 * copied_entries(p) + telling(p) * p->reads + half * p->ends;
}

/* A digest of 256 bits: all of them are alike by chance for one pair of arrays among 10^77. Each number turns and multiplies
 * what is before it, so that changes of two of them (of signs, of entries that change places) do not cancel. */
static void digest(const double *numbers, size_t count, uint64_t *found) {
    static const uint64_t ODD = 0x9E3779B185EBCA87u, OTHER = 0xC2B2AE3D27D4EB4Fu;
    uint64_t own[4] = {ODD, OTHER, ODD ^ OTHER, count}, next[4];
    size_t i = 0;
    for (; i + 4 <= count; i += 4) {
        memcpy(next, numbers + i, sizeof next);
        for (int l = 0; l < 4; ++l) {
            own[l] += next[l] * OTHER;
            own[l] = (own[l] << 31 | own[l] >> 33) * ODD;
        }
    }
    memset(next, 0, sizeof next);
    memcpy(next, numbers + i, sizeof(double) * (count - i));
    for (int l = 0; l < 4; ++l) {
        own[l] += next[l] * OTHER;
        found[l] = (own[l] << 31 | own[l] >> 33) * ODD;
    }
}

/* Digests of the entries of h H at both points. */
static void digests_of(const Passage *p, const double *h1, const double *h2, uint64_t found[2][4]) {
    digest(h1, (size_t)p->nnz * p->moves, found[0]), digest(h2, (size_t)p->nnz * p->moves, found[1]);
}

/* Whether the passage at this point is known. */
static int here(
    const Kept *k, const double *first, const double *h1, const double *h2, const double *told, const double *kicks
) {
    const Passage *p = &k->p;
    const size_t half = sizeof(double) * p->n * (p->n + 1) / 2, all = sizeof(double) * copied_entries(p);
    if (!k->known || memcmp(k->first, first, half)) return 0;
    if (p->thin) {
        uint64_t own[2][4];
        digests_of(p, h1, h2, own);
        if (memcmp(own, k->digests, sizeof own)) return 0;
    }
    if (all && (memcmp(k->h1, h1, all) || memcmp(k->h2, h2, all))) return 0; /* none where all steps only read */
    if (p->reads && memcmp(k->told, told, sizeof(double) * telling(p) * p->reads)) return 0;
    return kicks ? !memcmp(k->kicks, kicks, half * p->ends) : k->known == 1;
}

/* Keep the stages of all steps from now on, where it was thin all that is kept of them; nonzero without memory. */
static int keep_stages(Kept *k) {
    Passage *p = &k->p, whole = *p;
    if (p->full) return 0;
    whole.full = 1, whole.thin = 0;
    const size_t entries = (size_t)p->nnz * p->moves, more = p->thin ? keeps(&whole, NULL) + 2 * entries : 0;
    if (made(k, &k->stages, stages(&whole, NULL) + more)) return 1;
    size_t used = stages(&whole, k->stages);
    if (p->thin) {
        used += keeps(&whole, k->stages + used);
        whole.h1 = k->h1 = k->stages + used, whole.h2 = k->h2 = k->h1 + entries;
    } else
        whole = *p, whole.full = 1, stages(&whole, k->stages);
    *p = whole;
    k->known = k->along = k->seeded = 0;
    return 0;
}

static void run(
    Kept *k, int n, const double *first, const double *h1, const double *h2, const double *told, const double *kicks
) {
    Passage *p = &k->p;
    const size_t half = (size_t)n * (n + 1) / 2, all = sizeof(double) * copied_entries(p);
    if (p->thin) p->h1 = h1, p->h2 = h2; /* they live as long as the call */
    if (here(k, first, h1, h2, told, kicks)) return;
    k->known = k->along = k->seeded = 0;
    if (p->thin) digests_of(p, h1, h2, k->digests);
    memcpy(k->first, first, sizeof(double) * half);
    if (all) memcpy(k->h1, h1, all), memcpy(k->h2, h2, all);
    if (p->reads) memcpy(k->told, told, sizeof(double) * telling(p) * p->reads);
    if (kicks) memcpy(k->kicks, kicks, sizeof(double) * half * p->ends);
    passes(p, n, first, kicks);
    k->known = kicks ? 2 : 1;
}

/* Whether seeds leave slopes of few columns, at whatever step: those of one half-vector, of few entries. */
static int is_few(const Passage *p, int n, const double *seed) {
    const int half = n * (n + 1) / 2;
    int found = 0;
    for (int e = 0; e < p->ends; ++e, seed += half) {
        if (!is_asked(seed, half)) continue;
        int rows = 0;
        for (int i = 0; i < n; ++i) {
            int any = 0;
            for (int j = 0; j < n && !any; ++j) {
                const int low = i > j ? i : j, high = i > j ? j : i;
                any = seed[high * (2 * n - high + 1) / 2 + low - high] != 0.0;
            }
            rows += any;
        }
        if (found++ || 3 * rows > n) return 0;
    }
    return 1;
}
