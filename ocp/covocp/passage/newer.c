/* What computes once more, for processors with AVX2 and FMA: one library serves all machines. */
#include "library.h"

#if NEWER
#pragma GCC target("avx2,fma")
#define NAME(function) function##_newer
#include "calls.h"
#endif
