/* CasADi's interface of external functions. All memory is in the caller's work vector, so that calls from several
   threads are safe.

   One library has one of these functions under NAME, with the same inputs in the same order: q, v[, feedforward] and
   the settings (NAMES_IN, SHAPES_IN).

     collision           values of the requested outputs (collision.c); collision_batch runs many (batch.c)
     collision_gradient  adjoint: a scalar output, d/dq (nv), d/dv (nv) (gradient.c); a null result is not computed
     collision_jacobian  tangents: of each output its value, d/dq and d/dv (entries, nv)[, d/dfeedforward (entries, n)]
                         (jacobian.c); likewise
     collision_differences  of each output d/d of some inputs (entries, numbers) (differences.c); likewise

   Derivatives by q are in the basis of v: d/dq (nv) is its tangent map's transposed times them. Wrapped as one
   differentiable function: collision/derivatives.py. */

#ifndef WORK_TYPE
#define WORK_TYPE Work
#endif
#define EXPORT __attribute__((visibility("default")))
typedef long long Int;

/* Whether an input has a NaN. Comparisons with NaN are false, so that a collision might end before it begins. */
static int has_nan(const double **arg) {
  FOR(k, N_IN) {
    if (!arg[k]) continue;
    FOR(i, SHAPES_IN[k][0] * SHAPES_IN[k][1]) if (arg[k][i] != arg[k][i]) return 1;
  }
  return 0;
}

EXPORT int NAME(const double **arg, double **res, Int *iw, double *w, int mem) {
  WORK_TYPE *work = (WORK_TYPE *)(((size_t)w + 63) & ~(size_t)63);
  if (!has_nan(arg)) {
    evaluate(arg, res, work);
    /* every kind of work begins with that of a collision */
    if (!((const Work *)work)->frozen.ill_conditioned) return 0;
  }
  fill_with_nan(res);
  return 0;
}
EXPORT void OF_NAME(incref)(void) {}
EXPORT void OF_NAME(decref)(void) {}
EXPORT int OF_NAME(alloc_mem)(void) { return 0; }
EXPORT int OF_NAME(init_mem)(int mem) { return 0; }
EXPORT void OF_NAME(free_mem)(int mem) {}
EXPORT int OF_NAME(checkout)(void) { return 0; }
EXPORT void OF_NAME(release)(int mem) {}
EXPORT Int OF_NAME(n_in)(void) { return N_IN; }
EXPORT Int OF_NAME(n_out)(void) { return N_OUT; }
EXPORT const char *OF_NAME(name_in)(Int i) { return i >= 0 && i < N_IN ? NAMES_IN[i] : 0; }
EXPORT const char *OF_NAME(name_out)(Int i) { return i >= 0 && i < N_OUT ? NAMES_OUT[i] : 0; }
EXPORT const Int *OF_NAME(sparsity_in)(Int i) { return i >= 0 && i < N_IN ? SHAPES_IN[i] : 0; }
EXPORT const Int *OF_NAME(sparsity_out)(Int i) { return i >= 0 && i < N_OUT ? SHAPES_OUT[i] : 0; }
EXPORT int OF_NAME(work)(Int *sz_arg, Int *sz_res, Int *sz_iw, Int *sz_w) {
  if (sz_arg) *sz_arg = N_IN;
  if (sz_res) *sz_res = N_OUT;
  if (sz_iw) *sz_iw = 0;
  if (sz_w) *sz_w = sizeof(WORK_TYPE) / sizeof(double) + 8;
  return 0;
}
