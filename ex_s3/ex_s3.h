/*
 * Functions: ex, lg, jl.
 * Written by covocp 0.1.0 (CasADi 3.8.2) on 2026-11-28; real numbers are float.
 */

#ifndef EX_S3_H
#define EX_S3_H

#ifdef __cplusplus
extern "C" {
#endif

/* Every real number of this package. */
typedef float ex_s3_real;

/* What the functions return. */
#define EX_S3_OK 0 /* as asked for */
#define EX_S3_RESULT_NOT_FINITE 9 /* a result would be NaN or infinite: the results were not written */
#define EX_S3_FAILED 10 /* the evaluation failed: nothing was written, or (solver) the plan made at the export is returned */

#define EX_S3_EX_PHI 3
#define EX_S3_EX_C_ROWS 3
#define EX_S3_EX_C_COLUMNS 3

/*
 * ex:(phi[3])->(C[3x3]) SXFunction
 *
 * phi
 * C (result): 3 x 3, row by row
 * Results may be written over arguments.
 * Returns: EX_S3_OK, EX_S3_RESULT_NOT_FINITE, EX_S3_FAILED.
 */
int ex_s3_ex(const ex_s3_real phi[EX_S3_EX_PHI], ex_s3_real C[EX_S3_EX_C_ROWS * EX_S3_EX_C_COLUMNS]);

#define EX_S3_LG_C_ROWS 3
#define EX_S3_LG_C_COLUMNS 3
#define EX_S3_LG_PHI 3

/*
 * lg:(C[3x3])->(phi[3]) SXFunction
 *
 * C: 3 x 3, row by row
 * phi (result)
 * Results may be written over arguments.
 * Returns: EX_S3_OK, EX_S3_RESULT_NOT_FINITE, EX_S3_FAILED.
 */
int ex_s3_lg(const ex_s3_real C[EX_S3_LG_C_ROWS * EX_S3_LG_C_COLUMNS], ex_s3_real phi[EX_S3_LG_PHI]);

#define EX_S3_JL_PHI 3
#define EX_S3_JL_J_ROWS 3
#define EX_S3_JL_J_COLUMNS 3

/*
 * jl:(phi[3])->(J[3x3]) SXFunction
 *
 * phi
 * J (result): 3 x 3, row by row
 * Results may be written over arguments.
 * Returns: EX_S3_OK, EX_S3_RESULT_NOT_FINITE, EX_S3_FAILED.
 */
int ex_s3_jl(const ex_s3_real phi[EX_S3_JL_PHI], ex_s3_real J[EX_S3_JL_J_ROWS * EX_S3_JL_J_COLUMNS]);

#ifdef __cplusplus
}
#endif

#endif /* EX_S3_H */
