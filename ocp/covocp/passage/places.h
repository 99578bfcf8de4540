/* What tells a passage, and where its numbers lie in memory of the caller. */
/* Tells a passage its shape. */
static void described(Passage *p, const int *shape) {
    const int filled = shape[4], m = 2 * shape[0];
    memset(p, 0, sizeof *p);
    p->n = shape[0], p->nnz = shape[1], p->count = shape[2], p->r = shape[3];
    p->every = shape[5], p->ends = p->count / p->every;
    p->lanes = 1;
    p->place = shape + 6;
    for (int k = 0; k < p->count; ++k) p->place[k] < 0 ? ++p->reads : ++p->moves;
    p->row = p->place + p->count, p->col = p->row + p->nnz;
    p->begin = p->col + p->nnz, p->across = p->begin + m + 1, p->which = p->across + p->nnz;
    if (!filled) return;
    p->order = p->which + p->nnz, p->rank = p->order + m;
    p->left = p->rank + m, p->right = p->left + m + 1;
    p->before = p->right + m + 1, p->facing = p->before + p->right[m], p->behind = p->facing + p->right[m];
}

/* Whole numbers to work in, from `memory` on; their number. */
static size_t counts(Passage *p, int *memory) {
    const size_t m = 2 * (size_t)p->n, good = p->brief ? (size_t)p->moves : (size_t)p->lanes;
    p->chosen = memory;
    if (memory) p->good = memory + m;
    if (memory && p->thin) p->hard = p->good + good;
    return m + good + (p->thin ? (size_t)p->ends : 0);
}

/* Places to work in, from `memory` on; their number. */
static size_t works(Passage *p, double *memory) {
    const size_t n = p->n, r = p->r;
    size_t used = 0;
    p->work = placed(memory, &used, 17 * n * n + 4 * (r * r + r * n));
    p->sizes = placed(memory, &used, 2 * n);
    p->tall = placed(memory, &used, PANEL * (2 * n + r));
    if (!p->order) return used;
    p->values = placed(memory, &used, (2 * (size_t)p->nnz + 2 * n + factors_length(p)) * p->lanes);
    if (!p->brief) p->factors = placed(memory, &used, factors_length(p) * p->lanes);
    return used;
}
