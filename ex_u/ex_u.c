/* See ex_u.h. */
#include "ex_u.h"

#include <math.h>
#include <string.h>

int ex_u_filter_core(const ex_u_real **arg, ex_u_real **res, int *iw, ex_u_real *w, int mem);

/* Whether all numbers are finite. */
static int all_finite(const ex_u_real *values, int count)
{
    int i;
    for (i = 0; i < count; ++i) {
        if (!isfinite(values[i])) {
            return 0;
        }
    }
    return 1;
}

int ex_u_filter(
    const ex_u_real x[EX_U_FILTER_X],
    const ex_u_real P[EX_U_FILTER_P_ROWS * EX_U_FILTER_P_COLUMNS],
    ex_u_real y,
    ex_u_real xn[EX_U_FILTER_XN],
    ex_u_real Pn[EX_U_FILTER_PN_ROWS * EX_U_FILTER_PN_COLUMNS])
{
    const ex_u_real *arg_[3];
    ex_u_real *res_[2];
    int iw_[1];
    ex_u_real w_[1];
    ex_u_real out0_[2];
    ex_u_real out1_[4];
    arg_[0] = x;
    arg_[1] = P;
    arg_[2] = &y;
    res_[0] = out0_;
    res_[1] = out1_;
    if (ex_u_filter_core(arg_, res_, iw_, w_, 0) != 0) {
        return EX_U_FAILED;
    }
    if (!(all_finite(out0_, 2) && all_finite(out1_, 4))) {
        return EX_U_RESULT_NOT_FINITE;
    }
    memcpy(xn, out0_, 2 * sizeof(xn[0]));
    memcpy(Pn, out1_, 4 * sizeof(Pn[0]));
    return EX_U_OK;
}
