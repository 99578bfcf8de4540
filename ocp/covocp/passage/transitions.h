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
} Steps;

/* K = A [D; I], I at the places of an interval's rest; the first `active` of `wide` columns. */
static void slopes_of(
    const Steps *s, const double *RESTRICT A, const int *places, const double *D, int active, int wide,
    double *RESTRICT K
) {
    for (int i = 0; i < s->rows; ++i) memset(K + (size_t)i * wide, 0, sizeof(double) * active);
    for (int q = 0; q < s->nnz; ++q) {
        if (s->row[q] >= s->rows) continue;
        double *RESTRICT own = K + (size_t)s->row[q] * wide;
        if (s->col[q] >= s->rows) {
            own[places[s->col[q] - s->rows]] += A[q];
            continue;
        }
        const double *RESTRICT other = D + (size_t)s->col[q] * wide;
        const double share = A[q];
        for (int j = 0; j < active; ++j) own[j] += share * other[j];
    }
}

/* One step: D moves; K and moved are spare. */
static void carry(
    const Steps *s, const double *A, const int *places, int active, int wide, double *RESTRICT D, double *RESTRICT K,
    double *RESTRICT moved, double *RESTRICT sum
) {
    static const double reach[4] = {0.5, 0.5, 1.0, 0.0}, weight[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    for (int stage = 0; stage < 4; ++stage) {
        slopes_of(s, A + (size_t)stage * s->nnz, places, stage ? moved : D, active, wide, K);
        for (int i = 0; i < s->rows; ++i) {
            const size_t at = (size_t)i * wide;
            for (int j = 0; j < active; ++j) {
                sum[at + j] = (stage ? sum[at + j] : D[at + j]) + weight[stage] * K[at + j];
                moved[at + j] = D[at + j] + reach[stage] * K[at + j];
            }
        }
    }
    for (int i = 0; i < s->rows; ++i) memcpy(D + (size_t)i * wide, sum + (size_t)i * wide, sizeof(double) * active);
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
    const Steps s = {rows, nnz, rest, steps, row, col};
    int widest = 0, interval = 0;
    for (int g = 0; g < segments; ++g) {
        interval += lengths[g];
        if (active[interval - 1] > widest) widest = active[interval - 1];
    }
    const size_t all = (size_t)rows * widest;
    double *D = room(4 * all, sizeof(double)), *K = D + all, *moved = K + all, *sum = moved + all;
    if (!D) return 1;
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
    free(D);
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
    const Steps s = {rows, nnz, rest, steps, row, col};
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
