/*
 * Functions: kf.
 * Written by covocp 0.1.0 (CasADi 3.8.2) on 2026-11-28; real numbers are float.
 */

#ifndef EX_Y_H
#define EX_Y_H

#ifdef __cplusplus
extern "C" {
#endif

/* Every real number of this package. */
typedef float ex_y_real;

/* What the functions return. */
#define EX_Y_OK 0 /* as asked for */
#define EX_Y_RESULT_NOT_FINITE 9 /* a result would be NaN or infinite: the results were not written */
#define EX_Y_FAILED 10 /* the evaluation failed: nothing was written, or (solver) the plan made at the export is returned */

#define EX_Y_KF_X 2
#define EX_Y_KF_P_ROWS 2
#define EX_Y_KF_P_COLUMNS 2
#define EX_Y_KF_Y 2
#define EX_Y_KF_XN 2
#define EX_Y_KF_PN_ROWS 2
#define EX_Y_KF_PN_COLUMNS 2

/*
 * kf:(x[2],P[2x2],y[2])->(xn[2],Pn[2x2]) SXFunction
 *
 * x
 * P: 2 x 2, row by row
 * y
 * xn (result)
 * Pn (result): 2 x 2, row by row
 * Results may be written over arguments.
 * Returns: EX_Y_OK, EX_Y_RESULT_NOT_FINITE, EX_Y_FAILED.
 */
int ex_y_kf(
    const ex_y_real x[EX_Y_KF_X],
    const ex_y_real P[EX_Y_KF_P_ROWS * EX_Y_KF_P_COLUMNS],
    const ex_y_real y[EX_Y_KF_Y],
    ex_y_real xn[EX_Y_KF_XN],
    ex_y_real Pn[EX_Y_KF_PN_ROWS * EX_Y_KF_PN_COLUMNS]);

#ifdef __cplusplus
}
#endif

#endif /* EX_Y_H */
