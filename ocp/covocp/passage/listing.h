/* The operations of a function of CasADi's scalars, found in the text in which CasADi keeps it.
 *
 * There every four bits are a letter, the lower ones of a byte first. Each operation is four whole numbers: its kind, its
 * register, and what it is made of, or its constant; of an input the register, the argument and the place there; of an
 * output the result, the register and the place there. That is no promise of CasADi's: what is found is kept only where
 * all kinds are known and all numbers in their ranges, and operations.py compares some with what CasADi tells of them.
 */

/* What is known of a function before: operations, registers, arguments, results and the heights of both, and of CasADi's
 * `most` numbers of operations which they are here (negative: unknown), and whether they have two arguments. */
typedef struct {
    int count, registers, arguments, results;
    const int *heights, *kinds, *pairs;
    int most;
} Listing;

/* Bytes of such a text; 0 where it is no such. */
static size_t decoded(const char *text, size_t length, unsigned char *bytes) {
    for (size_t i = 0; i < length; ++i)
        if (text[i] < 'a' || text[i] > 'p') return 0;
    for (size_t i = 0; i + 1 < length; i += 2)
        bytes[i / 2] = (unsigned char)((text[i] - 'a') | (text[i + 1] - 'a') << 4);
    return length / 2;
}

/* Whether a number is below another, and not negative. */
static int within(int number, int most) { return number >= 0 && number < most; }

/* One operation as in columns.h, from its record; whether it can be one. */
static int listed(const Listing *f, const unsigned char *record, int *own, double *constant) {
    int told[4];
    memcpy(told, record, sizeof told);
    const int kind = within(told[0], f->most) ? f->kinds[told[0]] : -1;
    if (kind < 0) return 0;
    *constant = 0.0;
    own[0] = kind;
    if (kind == OP_OUTPUT) {
        own[1] = told[2], own[2] = told[1], own[3] = told[3];
        return within(own[1], f->registers) && within(own[2], f->results) &&
               within(own[3], f->heights[f->arguments + own[2]]);
    }
    own[1] = told[2], own[2] = told[3], own[3] = told[1];
    if (kind == OP_INPUT)
        return within(own[1], f->arguments) && within(own[2], f->heights[own[1]]) && within(own[3], f->registers);
    if (kind == OP_CONST) memcpy(constant, record + 8, sizeof *constant), own[1] = 0;
    if (!f->pairs[kind]) own[2] = 0;
    return within(own[1], f->registers) && within(own[2], f->registers) && within(own[3], f->registers);
}

/* The operations of a function from its text, as `columns` takes them; where they begin in it, in bytes, negative: nowhere.
 *
 * known: operation `place` is an input, and this its record. after: from which byte on they are looked for. */
EXPORT long long operations(
    const char *text, size_t length, long long after, int place, const int *known, int count, int registers,
    int arguments, int results, const int *heights, const int *kinds, int most, const int *pairs, int *program,
    double *constants
) {
    enum { RECORD = 16 };
    const Listing f = {count, registers, arguments, results, heights, kinds, pairs, most};
    unsigned char *bytes = malloc(length / 2 + 1);
    const size_t all = bytes ? decoded(text, length, bytes) : 0, whole = (size_t)count * RECORD;
    const size_t first = (size_t)place * RECORD;
    long long found = -1;
    for (size_t start = (size_t)after; found < 0 && start + whole <= all; ++start) {
        if (memcmp(bytes + start + first, known, RECORD)) continue;
        int k = 0;
        while (k < count && listed(&f, bytes + start + (size_t)k * RECORD, program + 4 * k, constants + k)) ++k;
        if (k == count) found = (long long)start;
    }
    free(bytes);
    return found;
}
