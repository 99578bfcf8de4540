/* See ex_s3.h. */
#include "ex_s3.h"

#include <math.h>
#include <string.h>

int ex_s3_ex_core(const ex_s3_real **arg, ex_s3_real **res, int *iw, ex_s3_real *w, int mem);
int ex_s3_lg_core(const ex_s3_real **arg, ex_s3_real **res, int *iw, ex_s3_real *w, int mem);
int ex_s3_jl_core(const ex_s3_real **arg, ex_s3_real **res, int *iw, ex_s3_real *w, int mem);

/* Whether all numbers are finite. */
static int all_finite(const ex_s3_real *values, int count)
{
    int i;
    for (i = 0; i < count; ++i) {
        if (!isfinite(values[i])) {
            return 0;
        }
    }
    return 1;
}

int ex_s3_ex(const ex_s3_real phi[EX_S3_EX_PHI], ex_s3_real C[EX_S3_EX_C_ROWS * EX_S3_EX_C_COLUMNS])
{
    const ex_s3_real *arg_[1];
    ex_s3_real *res_[1];
    int iw_[1];
    ex_s3_real w_[1];
    ex_s3_real out0_[9];
    arg_[0] = phi;
    res_[0] = out0_;
    if (ex_s3_ex_core(arg_, res_, iw_, w_, 0) != 0) {
        return EX_S3_FAILED;
    }
    if (!(all_finite(out0_, 9))) {
        return EX_S3_RESULT_NOT_FINITE;
    }
    memcpy(C, out0_, 9 * sizeof(C[0]));
    return EX_S3_OK;
}

int ex_s3_lg(const ex_s3_real C[EX_S3_LG_C_ROWS * EX_S3_LG_C_COLUMNS], ex_s3_real phi[EX_S3_LG_PHI])
{
    const ex_s3_real *arg_[1];
    ex_s3_real *res_[1];
    int iw_[1];
    ex_s3_real w_[1];
    ex_s3_real out0_[3];
    arg_[0] = C;
    res_[0] = out0_;
    if (ex_s3_lg_core(arg_, res_, iw_, w_, 0) != 0) {
        return EX_S3_FAILED;
    }
    if (!(all_finite(out0_, 3))) {
        return EX_S3_RESULT_NOT_FINITE;
    }
    memcpy(phi, out0_, 3 * sizeof(phi[0]));
    return EX_S3_OK;
}

int ex_s3_jl(const ex_s3_real phi[EX_S3_JL_PHI], ex_s3_real J[EX_S3_JL_J_ROWS * EX_S3_JL_J_COLUMNS])
{
    const ex_s3_real *arg_[1];
    ex_s3_real *res_[1];
    int iw_[1];
    ex_s3_real w_[1];
    ex_s3_real out0_[9];
    arg_[0] = phi;
    res_[0] = out0_;
    if (ex_s3_jl_core(arg_, res_, iw_, w_, 0) != 0) {
        return EX_S3_FAILED;
    }
    if (!(all_finite(out0_, 9))) {
        return EX_S3_RESULT_NOT_FINITE;
    }
    memcpy(J, out0_, 9 * sizeof(J[0]));
    return EX_S3_OK;
}
