/* A collision as CasADi's external function: (q, v[, feedforward], settings) -> outputs, all dense.

   All memory is the caller's work vector, so that threads do not meet. */

static void outputs_of(const Course *c, Work *w, double **res) {
  const State *y = &c->final;
  (void)y;
#ifdef OUT_impulse
  if (res[OUT_impulse]) *res[OUT_impulse] = c->impulse;
#endif
#ifdef OUT_peak_force
  if (res[OUT_peak_force]) *res[OUT_peak_force] = y->peak;
#endif
#ifdef OUT_duration
  if (res[OUT_duration]) *res[OUT_duration] = c->duration;
#endif
#ifdef OUT_separated
  if (res[OUT_separated]) *res[OUT_separated] = 1.0 - c->in_contact;
#endif
#ifdef OUT_energy
  double rest[NZ1] = {0};
  if (res[OUT_energy])
    *res[OUT_energy] =
        call(target_energy, y->target, w->data.target, 0) - call(target_energy, rest, w->data.target, 0);
#endif
#ifdef OUT_target_result
  if (res[OUT_target_result]) {
    const double *in[] = {y->target, w->data.target};
    target_result(in, &res[OUT_target_result], 0, 0, 0);
  }
#endif
#ifdef OUT_velocity
  if (res[OUT_velocity]) {
    double change[NV];
    velocity_change(&w->frozen, y->torque, y->impulse, y->time, change);
    FOR(i, NV) res[OUT_velocity][i] = c->v[i] + change[i];
  }
#endif
#ifdef OUT_configuration
  if (res[OUT_configuration]) {
    double way[NV];
    velocity_change(&w->frozen, y->torque2, y->impulse2, y->time * y->time / 2, way);
    FOR(i, NV) way[i] = c->v[i] * y->time + way[i];
    const double *in[] = {c->q, way};
    integrate(in, &res[OUT_configuration], 0, 0, 0);
  }
#endif
}

#define EXPORT __attribute__((visibility("default")))
typedef long long Int;

EXPORT int NAME(const double **arg, double **res, Int *iw, double *w, int mem) {
  Work *work = (Work *)(((size_t)w + 63) & ~(size_t)63);
  Course course;
  collide(arg, res, work, &course);
  outputs_of(&course, work, res);
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
  if (sz_w) *sz_w = sizeof(Work) / sizeof(double) + 8;
  return 0;
}
