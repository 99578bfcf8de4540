/* Small dense matrices, row by row. */
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

/* The same for two rows, own and next, of which each row of B is read once. */
INLINE void add_to_two(
    double *RESTRICT own, double *RESTRICT next, double sign, const double *share, const double *further, int step,
    const double *B, int wide, int rows, int columns
) {
    int j = 0;
    for (; j + 4 <= rows; j += 4) {
        const double a = sign * share[j * step], b = sign * share[(j + 1) * step], c = sign * share[(j + 2) * step],
                     d = sign * share[(j + 3) * step];
        const double e = sign * further[j * step], f = sign * further[(j + 1) * step],
                     g = sign * further[(j + 2) * step], h = sign * further[(j + 3) * step];
        if (a == 0.0 && b == 0.0 && c == 0.0 && d == 0.0 && e == 0.0 && f == 0.0 && g == 0.0 && h == 0.0) continue;
        const double *RESTRICT one = B + j * wide, *RESTRICT two = one + wide, *RESTRICT three = two + wide,
                     *RESTRICT four = three + wide;
        for (int i = 0; i < columns; ++i) {
            own[i] += (a * one[i] + b * two[i]) + (c * three[i] + d * four[i]);
            next[i] += (e * one[i] + f * two[i]) + (g * three[i] + h * four[i]);
        }
    }
    add_rows(own, sign, share + j * step, step, B + j * wide, wide, rows - j, columns);
    add_rows(next, sign, further + j * step, step, B + j * wide, wide, rows - j, columns);
}

#if defined(__AVX2__) && defined(__GNUC__)
#include <immintrin.h>
/* Rows and columns of a block of sums that stays in the registers of a processor with AVX2, columns of one row of them. */
enum { TALL = 4, BROAD = 8, BROADER = 16 };
typedef double Four __attribute__((vector_size(32), aligned(8), may_alias));
typedef long long Chosen __attribute__((vector_size(32)));

/* The first `count` of four numbers. */
INLINE __m256i first_of(int count) {
    const Chosen own = {-(count > 0), -(count > 1), -(count > 2), -(count > 3)};
    return (__m256i)own;
}

/* Four numbers; `some`: only those that are chosen, zero else. */
INLINE Four four(const double *from, const int some, __m256i chosen) {
    return some ? (Four)_mm256_maskload_pd(from, chosen) : *(const Four *)from;
}

INLINE void add_four(double *to, const int some, __m256i chosen, Four sum) {
    if (some)
        _mm256_maskstore_pd(to, chosen, (__m256d)(four(to, 1, chosen) + sum));
    else
        *(Four *)to += sum;
}

/* A block of C += sign A B, see `add_product`: of four columns, and four more unless `half`; the last ones `some`. */
INLINE void add_block(
    double *C, int wide, double sign, const double *A, int tall, int step, const double *B, int across, int inner,
    const int half, const int some, __m256i chosen
) {
    Four a = {0.0}, b = {0.0}, c = {0.0}, d = {0.0}, e = {0.0}, f = {0.0}, g = {0.0}, h = {0.0};
    for (int k = 0; k < inner; ++k, A += step, B += across) {
        const Four left = four(B, half && some, chosen);
        const double one = A[0], two = A[tall], three = A[2 * tall], four_ = A[3 * tall];
        a += one * left, c += two * left, e += three * left, g += four_ * left;
        if (half) continue;
        const Four right = four(B + 4, some, chosen);
        b += one * right, d += two * right, f += three * right, h += four_ * right;
    }
    const Four left[4] = {a, c, e, g}, right[4] = {b, d, f, h};
    for (int i = 0; i < 4; ++i, C += wide) {
        add_four(C, half && some, chosen, sign * left[i]);
        if (!half) add_four(C + 4, some, chosen, sign * right[i]);
    }
}

/* The first columns of own += sign (sum of shares of chosen rows of B): `fours` times four, at most four times; of the
 * last four `some`. */
INLINE void add_fours(
    double *own, double sign, const double *share, const int *rows, int count, const double *B, int wide, const int fours,
    const int some, __m256i chosen
) {
    Four even[4] = {{0.0}}, odd[4] = {{0.0}};
    int j = 0;
    for (; j + 2 <= count; j += 2) {
        const double one = share[j], two = share[j + 1];
        const double *first = B + (size_t)rows[j] * wide, *second = B + (size_t)rows[j + 1] * wide;
        for (int f = 0; f < fours; ++f) {
            even[f] += one * four(first + 4 * f, some && f == fours - 1, chosen);
            odd[f] += two * four(second + 4 * f, some && f == fours - 1, chosen);
        }
    }
    if (j < count)
        for (int f = 0; f < fours; ++f)
            even[f] += share[j] * four(B + (size_t)rows[j] * wide + 4 * f, some && f == fours - 1, chosen);
    for (int f = 0; f < fours; ++f) add_four(own + 4 * f, some && f == fours - 1, chosen, sign * (even[f] + odd[f]));
}
#else
enum { TALL = 2 };
#endif

/* own += sign (sum of shares of chosen rows of B, which lie `wide` apart), four at a time. */
INLINE void add_chosen(
    double *RESTRICT own, double sign, const double *share, const int *rows, int count, const double *B, int wide,
    int columns
) {
#if defined(__AVX2__) && defined(__GNUC__)
    const __m256i all = first_of(4), chosen = first_of(columns % 4);
    for (; columns >= BROADER; columns -= BROADER, own += BROADER, B += BROADER)
        add_fours(own, sign, share, rows, count, B, wide, 4, 0, all);
    switch (columns) {
    case 0: return;
    case 4: add_fours(own, sign, share, rows, count, B, wide, 1, 0, all); return;
    case 8: add_fours(own, sign, share, rows, count, B, wide, 2, 0, all); return;
    case 12: add_fours(own, sign, share, rows, count, B, wide, 3, 0, all); return;
    default: break;
    }
    switch (columns / 4) {
    case 0: add_fours(own, sign, share, rows, count, B, wide, 1, 1, chosen); return;
    case 1: add_fours(own, sign, share, rows, count, B, wide, 2, 1, chosen); return;
    case 2: add_fours(own, sign, share, rows, count, B, wide, 3, 1, chosen); return;
    default: add_fours(own, sign, share, rows, count, B, wide, 4, 1, chosen); return;
    }
#else
    int j = 0;
    for (; j + 4 <= count; j += 4) {
        const double a = sign * share[j], b = sign * share[j + 1], c = sign * share[j + 2], d = sign * share[j + 3];
        const double *RESTRICT one = B + (size_t)rows[j] * wide, *RESTRICT two = B + (size_t)rows[j + 1] * wide,
                     *RESTRICT three = B + (size_t)rows[j + 2] * wide, *RESTRICT four = B + (size_t)rows[j + 3] * wide;
        for (int i = 0; i < columns; ++i) own[i] += (a * one[i] + b * two[i]) + (c * three[i] + d * four[i]);
    }
    for (; j < count; ++j) {
        const double a = sign * share[j];
        const double *RESTRICT one = B + (size_t)rows[j] * wide;
        for (int i = 0; i < columns; ++i) own[i] += a * one[i];
    }
#endif
}

/* C += sign A B, (rows x inner) (inner x columns): rows of C and of B lie `wide` and `across` apart, entries of A `tall`
 * down and `step` along. */
INLINE void add_product(
    double *RESTRICT C, int wide, double sign, const double *A, int tall, int step, const double *B, int across, int rows,
    int inner, int columns
) {
    int i = 0;
#if defined(__AVX2__) && defined(__GNUC__)
    const __m256i all = first_of(4), chosen = first_of(columns % 4);
#endif
    for (; i + TALL <= rows; i += TALL) {
        double *own = C + (size_t)i * wide;
        const double *share = A + (size_t)i * tall;
#if defined(__AVX2__) && defined(__GNUC__)
        int j = 0;
        for (; j + BROAD <= columns; j += BROAD)
            add_block(own + j, wide, sign, share, tall, step, B + j, across, inner, 0, 0, all);
        if (columns - j > 4)
            add_block(own + j, wide, sign, share, tall, step, B + j, across, inner, 0, 1, chosen);
        else if (columns - j == 4)
            add_block(own + j, wide, sign, share, tall, step, B + j, across, inner, 1, 0, all);
        else if (columns > j)
            add_block(own + j, wide, sign, share, tall, step, B + j, across, inner, 1, 1, chosen);
#else
        add_to_two(own, own + wide, sign, share, share + tall, step, B, across, inner, columns);
#endif
    }
    for (; i < rows; ++i)
        add_rows(C + (size_t)i * wide, sign, A + (size_t)i * tall, step, B, across, inner, columns);
}

#if defined(__AVX2__) && defined(__GNUC__)
/* B <- A' of four rows and columns. */
INLINE void turn_four(const double *A, int across, double *B, int wide) {
    const __m256d a = _mm256_loadu_pd(A), b = _mm256_loadu_pd(A + across), c = _mm256_loadu_pd(A + 2 * (size_t)across),
                  d = _mm256_loadu_pd(A + 3 * (size_t)across);
    const __m256d ab = _mm256_unpacklo_pd(a, b), ba = _mm256_unpackhi_pd(a, b);
    const __m256d cd = _mm256_unpacklo_pd(c, d), dc = _mm256_unpackhi_pd(c, d);
    _mm256_storeu_pd(B, _mm256_permute2f128_pd(ab, cd, 0x20));
    _mm256_storeu_pd(B + wide, _mm256_permute2f128_pd(ba, dc, 0x20));
    _mm256_storeu_pd(B + 2 * (size_t)wide, _mm256_permute2f128_pd(ab, cd, 0x31));
    _mm256_storeu_pd(B + 3 * (size_t)wide, _mm256_permute2f128_pd(ba, dc, 0x31));
}
#endif

/* B <- A', A (rows x columns): rows lie `across` and `wide` apart; squares of it at a time, which stay in the cache. */
static void turn(const double *RESTRICT A, int across, int rows, int columns, double *RESTRICT B, int wide) {
    enum { SIDE = 4 };
    for (int i = 0; i < rows; i += SIDE)
        for (int j = 0; j < columns; j += SIDE) {
            const int last = i + SIDE < rows ? i + SIDE : rows, end = j + SIDE < columns ? j + SIDE : columns;
#if defined(__AVX2__) && defined(__GNUC__)
            if (i + SIDE <= rows && j + SIDE <= columns) {
                turn_four(A + (size_t)i * across + j, across, B + (size_t)j * wide + i, wide);
                continue;
            }
#endif
            for (int c = j; c < end; ++c)
                for (int r = i; r < last; ++r) B[(size_t)c * wide + r] = A[(size_t)r * across + c];
        }
}

/* Two rows of w entries change places. */
INLINE void exchange(double *RESTRICT a, int w, int one, int other) {
    for (int j = 0; one != other && j < w; ++j) {
        const double kept = a[one * w + j];
        a[one * w + j] = a[other * w + j], a[other * w + j] = kept;
    }
}

/* Columns `begin` to `end` of m rows made triangular with partial pivoting of whole rows of w entries.
 *
 * In `tall` (m of each) they lie column after column: what is done to all rows below a pivot is side by side.
 */
INLINE void panel(
    double *RESTRICT a, int m, int w, int begin, int end, double *RESTRICT swaps, double *RESTRICT tall
) {
    const int rows = m - begin, columns = end - begin;
    double *corner = a + (size_t)begin * w + begin;
    turn(corner, w, rows, columns, tall, rows);
    for (int k = 0; k < columns; ++k) {
        double *RESTRICT own = tall + (size_t)k * rows;
        int pivot = k;
        double largest = fabs(own[k]);
        for (int i = k + 1; i < rows; ++i) {
            const double size = fabs(own[i]);
            if (size > largest) largest = size, pivot = i;
        }
        if (swaps) swaps[begin + k] = begin + pivot;
        exchange(a, w, begin + k, begin + pivot);
        for (int j = 0; pivot != k && j < columns; ++j) {
            double *RESTRICT column = tall + (size_t)j * rows;
            const double kept = column[k];
            column[k] = column[pivot], column[pivot] = kept;
        }
        const double inverse = 1.0 / own[k];
        for (int i = k + 1; i < rows; ++i) own[i] *= inverse;
        for (int j = k + 1; j < columns; ++j) {
            double *RESTRICT other = tall + (size_t)j * rows;
            const double share = other[k];
            for (int i = k + 1; i < rows; ++i) other[i] -= own[i] * share;
        }
    }
    turn(tall, rows, columns, rows, corner, w);
}

/* The columns past the first m solved, which are triangular, two rows at a time from the last on. */
INLINE void solve_upper(double *RESTRICT a, int m, int w) {
    for (int k = m - 1; k >= 0; k -= 2) {
        const int below = m - 1 - k, columns = w - m;
        double *own = a + k * w, *next = k ? own - w : own;
        const double *done = below ? own + w + m : own;
        if (k)
            add_to_two(own + m, next + m, -1.0, own + k + 1, next + k + 1, 1, done, w, below, columns);
        else
            add_rows(own + m, -1.0, own + 1, 1, done, w, below, columns);
        const double inverse = 1.0 / own[k];
        for (int j = m; j < w; ++j) own[j] *= inverse;
        if (!k) return;
        const double share = next[k], other = 1.0 / next[k - 1];
        for (int j = m; j < w; ++j) next[j] = (next[j] - share * own[j]) * other;
    }
}

/* Rows below which they are solved in pairs. */
enum { FEW_ROWS = 20 };

/* The same, some rows at a time where blocks of sums are faster; `lower`: of each row no more than up to its diagonal. */
INLINE void solve_blocks(double *RESTRICT a, int m, int w, const int lower) {
    for (int end = m, begin; end > 0; end = begin) {
        const int columns = lower ? end : w - m;
        begin = end > PANEL ? end - PANEL : 0;
        double *first = a + begin * w, *done = a + end * w + m;
        add_product(first + m, w, -1.0, first + end, w, 1, done, w, end - begin, m - end, columns);
        for (int k = end - 1; k >= begin; --k) {
            double *RESTRICT own = a + k * w;
            add_rows(own + m, -1.0, own + k + 1, 1, own + w + m, w, end - 1 - k, columns);
            const double inverse = 1.0 / own[k];
            for (int j = m; j < m + columns; ++j) own[j] *= inverse;
        }
    }
}

/* What is left of `m` rows that were made triangular. */
INLINE void solve_rest(double *RESTRICT a, int m, int w) {
    if (TALL > 2 && m >= FEW_ROWS)
        solve_blocks(a, m, w, 0);
    else
        solve_upper(a, m, w);
}

/* The first m of w columns made triangular with partial pivoting (rows that were exchanged: swaps, unless NULL); `tall`:
 * PANEL times m to work in. */
INLINE void make_triangular(double *RESTRICT a, int m, int w, double *RESTRICT swaps, double *RESTRICT tall) {
    for (int k = 0; k < m; k += PANEL) {
        const int end = k + PANEL < m ? k + PANEL : m;
        panel(a, m, w, k, end, swaps, tall);
        for (int i = k + 1; i < end; ++i)
            add_rows(a + i * w + end, -1.0, a + i * w + k, 1, a + k * w + end, w, i - k, w - end);
        add_product(a + end * w + end, w, -1.0, a + end * w + k, w, 1, a + k * w + end, w, m - end, end - k, w - end);
    }
}

/* The same, and the other columns solved. */
static void eliminate(double *RESTRICT a, int m, int w, double *RESTRICT swaps, double *RESTRICT tall) {
    make_triangular(a, m, w, swaps, tall);
    solve_rest(a, m, w);
}

/* Smallest share of a pivot in the sum of the sizes it was made of, without exchanges of rows. */
static const double STEADY = 0.03;

/* The same without exchanges; 0 where a pivot is a small remainder of what it was summed from (`sizes`, of the diagonal).
 *
 * Which rows are exchanged depends on their units; whether a pivot is good does not where the matrix is that of the
 * identity and what moves entries of one unit to those of another.
 */
static int eliminate_steady(double *RESTRICT a, int m, int w, double *RESTRICT sizes) {
    for (int k = 0; k < m; k += PANEL) {
        const int end = k + PANEL < m ? k + PANEL : m;
        for (int c = k; c < end; ++c) {
            const double *RESTRICT first = a + c * w;
            if (!(fabs(first[c]) >= STEADY * sizes[c])) return 0; /* NaN neither */
            const double inverse = 1.0 / first[c];
            for (int i = c + 1; i < m; ++i) {
                double *RESTRICT own = a + i * w;
                if (own[c] == 0.0) continue;
                own[c] *= inverse;
                for (int j = c + 1; j < end; ++j) own[j] -= own[c] * first[j];
                if (i < end) sizes[i] += fabs(own[c] * first[i]);
            }
        }
        for (int i = k + 1; i < end; ++i)
            add_rows(a + i * w + end, -1.0, a + i * w + k, 1, a + k * w + end, w, i - k, w - end);
        for (int i = end; i < m; ++i)
            for (int c = k; c < end; ++c) sizes[i] += fabs(a[i * w + c] * a[c * w + i]);
        add_product(a + end * w + end, w, -1.0, a + end * w + k, w, 1, a + k * w + end, w, m - end, end - k, w - end);
    }
    solve_rest(a, m, w);
    return 1;
}

/* Half-vector and square matrix. */
INLINE void spread(const double *RESTRICT half, int n, double *RESTRICT square) {
    for (int j = 0, t = 0; j < n; ++j)
        for (int i = j; i < n; ++i, ++t) square[i * n + j] = square[j * n + i] = half[t];
}

/* S <- half of A + A' (n x n), rows of A `across` apart; B: n x n to work in. */
static void symmetric_part(const double *RESTRICT A, int across, int n, double *RESTRICT B, double *RESTRICT S) {
    turn(A, across, n, n, B, n);
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) S[i * n + j] = 0.5 * (A[(size_t)i * across + j] + B[i * n + j]);
}

/* The symmetric S (n x n) that solves the system a (n x 2n), which is made triangular as in `eliminate`. */
static void eliminate_symmetric(
    double *RESTRICT a, int n, double *RESTRICT swaps, double *RESTRICT tall, double *RESTRICT spare, double *RESTRICT S
) {
    const int w = 2 * n;
    make_triangular(a, n, w, swaps, tall);
    if (TALL == 2 || n < FEW_ROWS) {
        solve_upper(a, n, w);
        symmetric_part(a + n, w, n, spare, S);
        return;
    }
    solve_blocks(a, n, w, 1);
    turn(a + n, w, n, n, S, n);
    for (int i = 0; i < n; ++i) memcpy(S + (size_t)i * n, a + (size_t)i * w + n, sizeof(double) * (i + 1));
}

/* A B, (rows x inner) (inner x columns). */
static void product(
    const double *RESTRICT A, const double *RESTRICT B, int rows, int inner, int columns, double *RESTRICT result
) {
    memset(result, 0, sizeof(double) * rows * columns);
    add_product(result, columns, 1.0, A, inner, 1, B, columns, rows, inner, columns);
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
static void turned_product(
    const double *RESTRICT A, const double *RESTRICT B, int rows, int inner, int columns, double *RESTRICT result
) {
    memset(result, 0, sizeof(double) * rows * columns);
    add_product(result, columns, 1.0, A, 1, rows, B, columns, rows, inner, columns);
}
