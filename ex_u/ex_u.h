/*
 * Functions: filter.
 * Written by covocp 0.1.0 (CasADi 3.8.2) on 2026-11-28; real numbers are float.
 */

#ifndef EX_U_H
#define EX_U_H

#ifdef __cplusplus
extern "C" {
#endif

/* Every real number of this package. */
typedef float ex_u_real;

/* What the functions return. */
#define EX_U_OK 0 /* as asked for */
#define EX_U_RESULT_NOT_FINITE 9 /* a result would be NaN or infinite: the results were not written */
#define EX_U_FAILED 10 /* the evaluation failed: nothing was written, or (solver) the plan made at the export is returned */

#define EX_U_FILTER_X 2
#define EX_U_FILTER_P_ROWS 2
#define EX_U_FILTER_P_COLUMNS 2
#define EX_U_FILTER_XN 2
#define EX_U_FILTER_PN_ROWS 2
#define EX_U_FILTER_PN_COLUMNS 2

/*
 * filter:(x[2],P[2x2],y)->(xn[2],Pn[2x2]) SXFunction
 *
 * x
 * P: 2 x 2, row by row
 * y
 * xn (result)
 * Pn (result): 2 x 2, row by row
 * Results may be written over arguments.
 * Returns: EX_U_OK, EX_U_RESULT_NOT_FINITE, EX_U_FAILED.
 */
int ex_u_filter(
    const ex_u_real x[EX_U_FILTER_X],
    const ex_u_real P[EX_U_FILTER_P_ROWS * EX_U_FILTER_P_COLUMNS],
    ex_u_real y,
    ex_u_real xn[EX_U_FILTER_XN],
    ex_u_real Pn[EX_U_FILTER_PN_ROWS * EX_U_FILTER_PN_COLUMNS]);

#ifdef __cplusplus
}
#endif

#endif /* EX_U_H */
