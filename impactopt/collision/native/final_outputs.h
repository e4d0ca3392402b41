/* Outputs that depend on the final state; see collision/outputs.py. */

static void outputs_of(const Outcome *c, Work *w, double **res) {
  const State *y = &c->final;
  (void)y;
#ifdef OUT_impulse
  if (res[OUT_impulse]) *res[OUT_impulse] = c->impulse;
#endif
#ifdef OUT_step_error
  if (res[OUT_step_error]) *res[OUT_step_error] = y->error_estimate / fmax(c->impulse, 1e-300);
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
#if MOVES_TARGET
  if (res[OUT_energy]) FOR(k, 3) *res[OUT_energy] += c->tangential[k] * c->tangential[k] / (2 * w->data.mobility);
#endif
#endif
#ifdef OUT_tangential_velocity
  if (res[OUT_tangential_velocity]) FOR(k, 3) res[OUT_tangential_velocity][k] = c->tangential[k];
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
    velocity_change(&w->frozen, y->torque, y->impulse, SLIDING(y), y->time, change);
    FOR(i, NV) res[OUT_velocity][i] = c->v[i] + change[i];
  }
#endif
#ifdef OUT_configuration
  if (res[OUT_configuration]) {
    double displacement[NV];
    velocity_change(&w->frozen, y->torque2, y->impulse2, SLIDING2(y), y->time * y->time / 2, displacement);
    FOR(i, NV) displacement[i] = c->v[i] * y->time + displacement[i];
    const double *in[] = {c->q, displacement};
    integrate(in, &res[OUT_configuration], 0, 0, 0);
  }
#endif
}
