/* What both files of the library begin with. */
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Whether there is a second version of what computes, for newer processors (newer.c). */
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define NEWER 1
#else
#define NEWER 0
#endif
