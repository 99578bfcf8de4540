/* Slopes through shooting segments of classical Runge-Kutta steps: of their ends, and of costs along them.
 *
 * A step y+ = y + (k1 + 2 k2 + 2 k3 + k4)/6 has k_i = h f at y, y + k1/2, y + k2/2, y + k3. With A_i the slopes of k_i by
 * y there and by what a whole interval takes, its controls and the duration, D = dy moves by K_i = A_i [D_i; I], D_1 = D,
 * D_2 = D + K_1/2, ...: a matrix with few nonzeros by one whose rows are short, in place of one scalar after the other.
 * Back go the slopes of one number by y, by the transposes. The last row of A_i are the slopes of h times the rate of a
 * cost, which only the way back reads.
 */

typedef struct {
    int rows, nnz, rest, steps; /* states; nonzeros of A, its columns past the states; steps of an interval */
    const int *row, *col;       /* of the nonzeros */
    /* Row by row: where rows begin, where those among the states end, their places, columns, and room for what is there. */
    int *begin, *among, *which, *across;
    double *shares;
} Steps;

/* The nonzeros of the states' rates row by row, in `memory` of 2 (rows + 1 + nnz) whole numbers. */
static void by_rows(Steps *s, int *memory) {
    int count = 0;
    s->begin = memory, s->among = s->begin + s->rows + 1, s->which = s->among + s->rows + 1, s->across = s->which + s->nnz;
    memset(memory, 0, sizeof(int) * 2 * (s->rows + 1));
    for (int q = 0; q < s->nnz; ++q)
        if (s->row[q] < s->rows) ++s->begin[s->row[q]];
    for (int i = 0; i <= s->rows; ++i) { /* where rows begin, twice */
        const int own = s->begin[i];
        s->begin[i] = s->among[i] = count, count += i < s->rows ? own : 0;
    }
    for (int rest = 0; rest < 2; ++rest) {
        for (int q = 0; q < s->nnz; ++q) { /* those among the states come first: columns rise */
            if (s->row[q] >= s->rows || (s->col[q] >= s->rows) != rest) continue;
            const int at = s->among[s->row[q]]++;
            s->which[at] = q, s->across[at] = s->col[q];
        }
        if (!rest) continue;
        for (int i = 0; i < s->rows; ++i)
            for (s->among[i] = s->begin[i]; s->among[i] < s->begin[i + 1] && s->across[s->among[i]] < s->rows;) ++s->among[i];
    }
}

/* Row i of K = A [D; I], I at the places of an interval's rest; the first `active` of `wide` columns. */
INLINE void row_of(
    const Steps *s, int i, const double *A, const int *places, const double *D, int active, int wide, double *own
) {
    const int first = s->begin[i], count = s->among[i] - first;
    for (int t = 0; t < count; ++t) s->shares[t] = A[s->which[first + t]];
    memset(own, 0, sizeof(double) * active);
    add_chosen(own, 1.0, s->shares, s->across + first, count, D, wide, active);
    for (int t = first + count; t < s->begin[i + 1]; ++t) own[places[s->across[t] - s->rows]] += A[s->which[t]];
}

/* One step: D moves; K (a row), moved (twice D) and sum are spare. */
static void carry(
    const Steps *s, const double *A, const int *places, int active, int wide, double *D, double *RESTRICT K, double *moved,
    double *sum
) {
    static const double reach[4] = {0.5, 0.5, 1.0, 0.0}, weight[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    const size_t all = (size_t)s->rows * wide;
    for (int stage = 0; stage < 4; ++stage) {
        const double *from = stage ? moved + (stage % 2 ? 0 : all) : D;
        double *to = moved + (stage % 2 ? all : 0);
        for (int i = 0; i < s->rows; ++i) {
            const double *old = D + (size_t)i * wide, *before = (stage ? sum : D) + (size_t)i * wide;
            double *total = (stage < 3 ? sum : to) + (size_t)i * wide, *next = to + (size_t)i * wide;
            row_of(s, i, A + (size_t)stage * s->nnz, places, from, active, wide, K);
            for (int j = 0; j < active; ++j) total[j] = before[j] + weight[stage] * K[j];
            for (int j = 0; stage < 3 && j < active; ++j) next[j] = old[j] + reach[stage] * K[j];
        }
    }
    for (int i = 0; i < s->rows; ++i)
        memcpy(D + (size_t)i * wide, moved + all + (size_t)i * wide, sizeof(double) * active);
}

/* Slopes of the end of each segment by its start, and by the rest of its intervals.
 *
 * rows, nnz, row, col: of A, column by column; its columns past the states are `rest`. steps: of an interval. segments,
 * lengths: their intervals. places: of the rest of each interval, its columns in D, (intervals x rest). active: columns
 * of D that an interval and those before it reach. slopes: nonzeros of A, of each stage of each step. results: D of each
 * segment, column by column, as wide as the last of its intervals reaches. Nonzero without memory.
 */
EXPORT int NAME(transitions)(
    int rows, int nnz, const int *row, const int *col, int rest, int steps, int segments, const int *lengths,
    const int *places, const int *active, const double *slopes, double *results
) {
    Steps s = {rows, nnz, rest, steps, row, col, NULL, NULL, NULL, NULL, NULL};
    int widest = 0, interval = 0;
    for (int g = 0; g < segments; ++g) {
        interval += lengths[g];
        if (active[interval - 1] > widest) widest = active[interval - 1];
    }
    const size_t all = (size_t)rows * widest;
    double *D = room(4 * all + widest + nnz, sizeof(double)), *moved = D + all, *sum = moved + 2 * all, *K = sum + all;
    int *order = room(2 * ((size_t)rows + 1 + nnz), sizeof(int));
    if (!D || !order) {
        free(D), free(order);
        return 1;
    }
    by_rows(&s, order);
    s.shares = K + widest;
    interval = 0;
    for (int g = 0; g < segments; ++g) {
        const int wide = active[interval + lengths[g] - 1];
        memset(D, 0, sizeof(double) * rows * wide);
        for (int i = 0; i < rows; ++i) D[(size_t)i * wide + i] = 1.0;
        for (int k = 0; k < lengths[g]; ++k, ++interval)
            for (int j = 0; j < steps; ++j)
                carry(&s, slopes + ((size_t)interval * steps + j) * 4 * nnz, places + (size_t)interval * rest,
                      active[interval], wide, D, K, moved, sum);
        for (int j = 0; j < wide; ++j)
            for (int i = 0; i < rows; ++i) results[(size_t)j * rows + i] = D[(size_t)i * wide + j];
        results += (size_t)rows * wide;
    }
    free(D), free(order);
    return 0;
}

/* One step back: the slopes by its end become those by its start, those by the rest of its interval are added to `rest`.
 *
 * by_rate: of each k_i and of the rate of the cost; by_place: of where it is taken.
 */
static void carry_back(
    const Steps *s, const double *A, const int *places, double cost, double *RESTRICT slope, double *RESTRICT by_rate,
    double *RESTRICT by_place, double *RESTRICT rest
) {
    static const double reach[4] = {0.5, 0.5, 1.0, 0.0}, weight[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    double *RESTRICT sum = by_place + s->rows;
    memcpy(sum, slope, sizeof(double) * s->rows);
    for (int stage = 3; stage >= 0; --stage) {
        const double *RESTRICT own = A + (size_t)stage * s->nnz;
        for (int i = 0; i < s->rows; ++i)
            by_rate[i] = weight[stage] * slope[i] + (stage < 3 ? reach[stage] * by_place[i] : 0.0);
        by_rate[s->rows] = weight[stage] * cost;
        memset(by_place, 0, sizeof(double) * s->rows);
        for (int q = 0; q < s->nnz; ++q) {
            const double moved = own[q] * by_rate[s->row[q]];
            if (s->col[q] < s->rows)
                by_place[s->col[q]] += moved;
            else
                rest[places[s->col[q] - s->rows]] += moved;
        }
        for (int i = 0; i < s->rows; ++i) sum[i] += by_place[i];
    }
    memcpy(slope, sum, sizeof(double) * s->rows);
}

/* Slopes of a number by the start of each segment and by the rest of its intervals; nonzero without memory.
 *
 * As `transitions`; by_states: its slopes by the states after each step; by_costs: by the running cost of each interval.
 * results: of each segment, as wide as the last of its intervals reaches.
 */
EXPORT int NAME(passed_back)(
    int rows, int nnz, const int *row, const int *col, int rest, int steps, int segments, const int *lengths,
    const int *places, const int *active, const double *slopes, const double *by_states, const double *by_costs,
    double *results
) {
    const Steps s = {rows, nnz, rest, steps, row, col, NULL, NULL, NULL, NULL, NULL};
    double *slope = room(4 * (size_t)rows + 1, sizeof(double)), *by_rate = slope + rows, *by_place = by_rate + rows + 1;
    if (!slope) return 1;
    int interval = 0;
    for (int g = 0; g < segments; ++g) {
        const int end = interval + lengths[g], wide = active[end - 1];
        memset(results, 0, sizeof(double) * wide);
        memset(slope, 0, sizeof(double) * rows);
        for (int k = end - 1; k >= interval; --k)
            for (int j = steps - 1; j >= 0; --j) {
                const size_t step = (size_t)k * steps + j;
                for (int i = 0; i < rows; ++i) slope[i] += by_states[step * rows + i];
                carry_back(&s, slopes + step * 4 * nnz, places + (size_t)k * rest, by_costs[k], slope, by_rate, by_place,
                           results);
            }
        memcpy(results, slope, sizeof(double) * rows);
        results += wide;
        interval = end;
    }
    free(slope);
    return 0;
}
