/* See ex_y.h. */
#include "ex_y.h"

#include <math.h>
#include <string.h>

int ex_y_kf_core(const ex_y_real **arg, ex_y_real **res, int *iw, ex_y_real *w, int mem);

/* Whether all numbers are finite. */
static int all_finite(const ex_y_real *values, int count)
{
    int i;
    for (i = 0; i < count; ++i) {
        if (!isfinite(values[i])) {
            return 0;
        }
    }
    return 1;
}

int ex_y_kf(
    const ex_y_real x[EX_Y_KF_X],
    const ex_y_real P[EX_Y_KF_P_ROWS * EX_Y_KF_P_COLUMNS],
    const ex_y_real y[EX_Y_KF_Y],
    ex_y_real xn[EX_Y_KF_XN],
    ex_y_real Pn[EX_Y_KF_PN_ROWS * EX_Y_KF_PN_COLUMNS])
{
    const ex_y_real *arg_[3];
    ex_y_real *res_[2];
    int iw_[1];
    ex_y_real w_[1];
    ex_y_real out0_[2];
    ex_y_real out1_[4];
    arg_[0] = x;
    arg_[1] = P;
    arg_[2] = y;
    res_[0] = out0_;
    res_[1] = out1_;
    if (ex_y_kf_core(arg_, res_, iw_, w_, 0) != 0) {
        return EX_Y_FAILED;
    }
    if (!(all_finite(out0_, 2) && all_finite(out1_, 4))) {
        return EX_Y_RESULT_NOT_FINITE;
    }
    memcpy(xn, out0_, 2 * sizeof(xn[0]));
    memcpy(Pn, out1_, 4 * sizeof(Pn[0]));
    return EX_Y_OK;
}
