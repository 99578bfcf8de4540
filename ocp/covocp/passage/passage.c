/* The library of the passage: what Python calls. The derivations are in memory.h.
 *
 * Nothing here is shared: each `Kept` is used by one thread at a time. It keeps the last point, so that slopes there do
 * not run the passage again.
 */
#define Py_LIMITED_API 0x030b0000
#include <Python.h>

#include "library.h"

#ifdef __GLIBC__
#include <malloc.h>
#endif

#define NAME(function) function
#include "calls.h"
#include "places.h"
#include "written.h"
#include "listing.h"
#include "derived.h"

/* Of this source: VERSION in library.py, one more with every change of arguments or of their meaning. */
EXPORT int passage_version(void) { return 14; }

/* Whether this processor can take the functions whose names end in _newer. */
EXPORT int passage_newer(void) {
#if NEWER
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
    return 0;
#endif
}

EXPORT void passage_free(Kept *k) {
    if (!k) return;
    void *owned[] = {k->whole, k->reals, k->stages, k->moved, k->turned, k->direction, k->shifted, k->narrow, k->inverses};
    for (size_t i = 0; i < sizeof owned / sizeof *owned; ++i) free(owned[i]);
    free(k);
}

/* Intervals from which on it pays to keep nothing between them. */
enum { FEWEST_ENDS = 8 };

/* Tells a passage its shape, and what is kept of its steps: the factors of X' unless they have more than `most` numbers
 * together. */
static void described_for(Passage *p, const int *shape, int lean, size_t most) {
    described(p, shape);
    const int much = (double)p->moves * p->n * p->n > (double)most && p->ends >= FEWEST_ENDS;
    p->lean = lean, p->lanes = MOST_LANES;
    p->thin = !lean && p->order && much, p->brief = !lean && p->order && !much;
}

/* A passage of a shape of `length` numbers; NULL where there is no memory. `lean`: for values alone. */
EXPORT Kept *passage_new(const int *shape, int length, int lean, size_t most) {
    Kept *k = calloc(1, sizeof *k);
    if (!k) return NULL;
    Passage *p = &k->p;
    described_for(p, shape, lean, most);
    k->whole = room((size_t)length + counts(p, NULL), sizeof(int));
    if (!k->whole || made(k, &k->reals, stages(p, NULL) + keeps(p, NULL) + works(p, NULL) + numbers(p))) {
        passage_free(k);
        return NULL;
    }
    memcpy(k->whole, shape, sizeof(int) * length);
    described_for(p, k->whole, lean, most);
    counts(p, k->whole + length);
    const size_t half = (size_t)p->n * (p->n + 1) / 2, entries = copied_entries(p);
    double *at = k->reals + stages(p, k->reals); /* where `keep_stages` finds them */
    at += keeps(p, at);
    at += works(p, at);
    k->first = at, k->h1 = k->first + half, k->h2 = k->h1 + entries;
    k->told = k->h2 + entries, k->kicks = k->told + telling(p) * p->reads;
    p->h1 = k->h1, p->h2 = k->h2, p->told = k->told;
    if (!lean && !p->brief && !p->thin && keep_stages(k)) {
        passage_free(k);
        return NULL;
    }
    return k;
}

/* Bytes of such a passage before slopes or tangents ask for more. */
EXPORT size_t passage_bytes(const int *shape, int lean, size_t most) {
    Passage p;
    described_for(&p, shape, lean, most);
    p.full = !lean && !p.brief && !p.thin;
    return sizeof(double) * (stages(&p, NULL) + keeps(&p, NULL) + works(&p, NULL) + numbers(&p));
}

/* Bytes that it has now. */
EXPORT size_t passage_held(const Kept *k) { return k->held; }

/* Gives back to the system what the process has freed, where its C library would keep it. */
EXPORT void passage_trim(void) {
#ifdef __GLIBC__
    malloc_trim(0);
#endif
}

/* What exported code computes, by the same operations: not those for newer processors. */
EXPORT size_t exported_length(const int *shape, int of) { return written_length(shape, of); }

EXPORT void exported_forward(
    const int *shape, int *chosen, const double *first, const double *h1, const double *h2, double *result
) {
    written_forward(shape, chosen, first, h1, h2, result);
}

EXPORT void exported_slopes(
    const int *shape, int *chosen, const double *h1, const double *h2, const double *passed, const double *seed,
    double *result
) {
    written_slopes(shape, chosen, h1, h2, passed, seed, result);
}

/* Where the numbers of some buffers lie, None for none: each lives as long as the call of CasADi that it belongs to. */
static PyObject *addresses(PyObject *module, PyObject *buffers) {
    (void)module;
    const Py_ssize_t count = PyTuple_Size(buffers);
    PyObject *places = count < 0 ? NULL : PyTuple_New(count);
    for (Py_ssize_t i = 0; places && i < count; ++i) {
        PyObject *one = PyTuple_GetItem(buffers, i), *place = Py_None;
        Py_buffer view;
        if (one != Py_None) {
            if (PyObject_GetBuffer(one, &view, PyBUF_SIMPLE)) {
                Py_DECREF(places);
                return NULL;
            }
            place = PyLong_FromVoidPtr(view.buf);
            PyBuffer_Release(&view);
        } else
            Py_INCREF(place);
        if (!place || PyTuple_SetItem(places, i, place)) {
            Py_DECREF(places);
            return NULL;
        }
    }
    return places;
}

static PyMethodDef methods[] = {
    {"addresses", addresses, METH_O, "Where the numbers of a tuple of buffers lie; None stays None."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_passage", "The compiled passage of a covariance; called by its C names.", -1,
    methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__passage(void) { return PyModule_Create(&definition); }
